"""Test the demo's recordings: rendered in order, resumed after a stop, and images
without content."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc.demo.recordings import ROLES, SHIPPED, find_missing_recordings
from topoloc.errors import TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import open_sequence
from topoloc_worlds import demo_recordings
from topoloc_worlds.demo_recordings import RECORDINGS, draw_pictures_of_nothing, render_recordings
from topoloc_worlds.rendering.renderer import RenderConfig
from topoloc_worlds.routes import frame_poses, plan_route
from topoloc_worlds.worlds import find_world


@pytest.mark.slow  # the light of two conditions is traced
def test_rendering_resumes_after_a_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("mitsuba")
    small = Camera.pinhole(32, 20, 19.0, 19.0, 15.5, 9.5)
    tiny = [
        replace(
            recording,
            config=replace(
                recording.config,
                camera=small,
                route=replace(recording.config.route, num_frames=1),
                render=RenderConfig.draft(),
            ),
        )
        for recording in (RECORDINGS[0], RECORDINGS[3])
    ]
    monkeypatch.setattr(demo_recordings, "RECORDINGS", tuple(tiny))
    assert find_missing_recordings(tmp_path) == list(ROLES)
    told: list[tuple[str, int, int]] = []
    render_recordings(tmp_path, lambda *step: told.append(step))
    frames = [step for step in told if "light" not in step[0]]
    assert frames == [
        (f"rendering {name}", done, 1) for name in ("map lap1", "night") for done in (0, 1)
    ]
    assert set(ROLES) - set(find_missing_recordings(tmp_path)) == {
        "map_lap1",
        "night",
        "pictures_of_nothing",
    }
    pair, single = (open_sequence(tmp_path / recording.name)[0] for recording in tiny)
    assert pair.rig is not None
    assert single.right is None
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.jpg")}
    told.clear()
    render_recordings(tmp_path, lambda *step: told.append(step))
    assert told == [("rendering map lap1", 1, 1), ("rendering night", 1, 1)]
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.jpg")} == before


def test_queries_take_other_paths_than_mapping():
    """No query image may repeat a mapping frame."""
    lab = find_world("lab")
    walks = {
        r.name: frame_poses(plan_route(lab.loop, lab.camera_height, r.config.route))
        for r in RECORDINGS
        if r.world == "lab"
    }
    mapped = np.array(
        [pose.translation for name in ("map_lap1", "map_lap2") for pose in walks[name]]
    )
    for name in ("day", "night", "other_camera"):
        nearest = [np.linalg.norm(mapped - pose.translation, axis=1).min() for pose in walks[name]]
        assert np.median(nearest) > 0.02
        assert np.max(nearest) < 0.5, "but it is the same way"


def test_pictures_of_nothing_open_as_a_recording(tmp_path: Path):
    draw_pictures_of_nothing(tmp_path / "nothing")
    sequence = open_sequence(tmp_path / "nothing")
    assert sequence.names == ["black.png", "clouds.png", "noise.png", "stripes.png", "white.png"]
    frames = [sequence[i] for i in range(len(sequence))]
    assert all(frame.camera is not None for frame in frames)
    assert [int(frame.image.std()) > 20 for frame in frames] == [False, True, True, True, False]
    before = [frame.image.tobytes() for frame in frames]
    shipped = open_sequence(SHIPPED / "pictures_of_nothing")
    assert [shipped[i].image.tobytes() for i in range(len(shipped))] == before


def test_every_recording_is_made_and_has_its_use():
    assert [*(recording.name for recording in RECORDINGS), "pictures_of_nothing"] == list(ROLES)
    assert set(ROLES.values()) == {"map", "queries", "elsewhere"}


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path):
    (tmp_path / "file").write_text("")
    for write in (draw_pictures_of_nothing, render_recordings):
        with pytest.raises(TopolocError, match="cannot write"):
            write(tmp_path / "file" / "below")
