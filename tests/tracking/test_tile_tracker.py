"""Test a stream that moves from one tile of an atlas to another, and through places
outside of all tiles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tiny_world import write_stereo_recording
from topoloc.apps.cli import main
from topoloc.atlas.editing import create_atlas, new_tiles
from topoloc.errors import QueryError
from topoloc.geometry.alignment import translation_error
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc.tracking.tracker import Tracker

STEP_NS = 100_000_000


@pytest.fixture(scope="module")
def rooms(
    tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[StereoFrame]]:
    """Return an atlas of two rooms, and a walk through both."""
    folder = tmp_path_factory.mktemp("rooms")
    other = write_stereo_recording(
        folder / "other", seed=1, indices=np.arange(0.0, 6.0, 0.5).tolist()
    )
    for name, recording in (("room", tiny_recording), ("other", other)):
        build_map(open_sequence(str(recording)), BuildConfig(other_kinds=())).save(
            folder / f"{name}.topo"
        )
    create_atlas(
        str(folder / "campus"), new_tiles([str(folder / "room.topo"), str(folder / "other.topo")])
    )
    walk = [open_sequence(str(tiny_recording))[k] for k in range(5)] + [
        open_sequence(str(other))[k] for k in range(5)
    ]
    return folder / "campus", walk


@pytest.fixture
def tracker(rooms: tuple[Path, list[StereoFrame]]) -> Tracker:
    return Tracker(Localizer(rooms[0]))


def test_a_walk_is_followed_from_tile_to_tile(
    rooms: tuple[Path, list[StereoFrame]], tracker: Tracker
):
    walk = rooms[1]
    nothing = np.random.default_rng(3).integers(0, 255, walk[0].image.shape, dtype=np.uint8)
    lost = tracker.process(nothing, walk[0].camera, 0)
    assert lost.state == "lost"
    t_ns, tiles = 20 * STEP_NS, []
    for k, frame in enumerate(walk):
        t_ns += STEP_NS if k != 5 else 20 * STEP_NS  # the door takes a while
        answer = tracker.process(frame.image, frame.camera, t_ns)
        assert isinstance(answer.result, Localization)
        assert frame.world_from_cam is not None
        assert translation_error(answer.result.world_from_cam, frame.world_from_cam) < 0.05
        tiles.append(answer.result.provenance.tile)
    assert tiles == 5 * ["room"] + 5 * ["other"]
    missed = tracker.process_missing(t_ns + STEP_NS, NotLocalized("unreadable"))
    assert missed.state == "predicted"
    assert missed.result.provenance.tile == "other"
    with pytest.raises(QueryError, match="goes backwards"):
        tracker.process(walk[0].image, walk[0].camera, t_ns)


def test_the_atlas_is_not_searched_again_at_once(
    rooms: tuple[Path, list[StereoFrame]], tracker: Tracker, monkeypatch: pytest.MonkeyPatch
):
    """A refusal by an atlas takes far longer than a tracked image."""
    walk, asked = rooms[1], []
    localize = Localizer.localize
    monkeypatch.setattr(
        Localizer,
        "localize",
        lambda *args, **kwargs: asked.append(1) or localize(*args, **kwargs),
    )
    nothing = np.random.default_rng(3).integers(0, 255, walk[0].image.shape, dtype=np.uint8)
    tracker.process(walk[0].image, walk[0].camera, 0)
    states = [
        tracker.process(
            nothing if k % 2 else nothing.T.copy().reshape(nothing.shape),
            walk[0].camera,
            k * STEP_NS,
        ).state
        for k in range(1, 15)
    ]
    assert "localized" not in states
    assert len(asked) == 2


def test_the_map_is_released(rooms: tuple[Path, list[StereoFrame]], tracker: Tracker):
    walk = rooms[1]
    tracker.process(walk[0].image, walk[0].camera, 0)
    maps = tracker.localizer._tiles._maps  # pyright: ignore
    opened = maps._entries["room"].opened
    assert opened.num_users == 1
    tracker.close()
    assert opened.num_users == 0


def test_follow_takes_an_atlas(
    rooms: tuple[Path, list[StereoFrame]], tiny_recording: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["follow", str(rooms[0]), f"{tiny_recording}@0:3"]) == 0
    answers = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {(answer["tile"], answer["localized"]) for answer in answers} == {("room", True)}
