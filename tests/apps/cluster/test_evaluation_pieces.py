"""Check that an evaluation on two nodes has the figures, texts and failures of the
plain command."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dying_piece import DyingPiece

from built_room import unseen_views, write_pictures
from topoloc.apps.cli import main
from topoloc.apps.cli.queries import remote_queries
from topoloc.apps.cli.queries.remote_queries import Piece, QueryRecording, RemoteMap
from topoloc.atlas.editing import create_atlas, new_tiles
from topoloc.errors import MapError, MissingExtraError, RecordingError, TrajectoryError
from topoloc.evaluation.metrics import summarize
from topoloc.localization.localizer import Localizer
from topoloc.mapping.topomap import TopoMetricMap

Complaint = Callable[..., str]


@pytest.fixture
def queried_map(room_map: Path, queries: Path, tmp_path: Path) -> Path:
    """Return a folder with `room.topo`, images of the room and of `elsewhere`, which a
    test may damage."""
    shutil.copy(room_map, tmp_path / "room.topo")
    shutil.copytree(queries, tmp_path / "pictures")
    write_pictures(tmp_path / "elsewhere", unseen_views(seed=1, step=4.0))
    return tmp_path


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: _timeless(one)
            for key, one in value.items()
            if key not in ("times_ms", "median_times_ms")
        }
    return [_timeless(one) for one in value] if isinstance(value, list) else value


def _evaluated(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[Any, str]:
    """Return the JSON without times, and the standard error."""
    capsys.readouterr()
    assert main(["evaluate", *map(str, args), "--json", "-"]) == 0
    printed = capsys.readouterr()
    return _timeless(json.loads(printed.out)), printed.err


def test_equal_figures_although_workers_die(
    cluster: Any,
    queried_map: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    """Relative paths start at the folder of the command. The report reads its images
    on the driver."""
    monkeypatch.setattr(remote_queries, "MAX_IMAGES", 2)
    monkeypatch.setattr(remote_queries, "Piece", DyingPiece)
    monkeypatch.chdir(queried_map)
    args = ("room.topo", "pictures", "--elsewhere", "elsewhere")
    alone = _evaluated(capsys, *args)
    assert alone[0]["num_localized"] == len(unseen_views())
    assert alone[0]["num_elsewhere"] > 0
    assert _evaluated(capsys, *args, "--report", "page.html", "--ray", cluster.address) == alone
    assert (
        len(list(queried_map.glob("*.begun-*")))
        == len(list(queried_map.glob("pictures.begun-*")))
        + len(list(queried_map.glob("elsewhere.begun-*")))
        >= 3
    )
    assert (queried_map / "page.html").read_text().count("<article>") > 0


def test_an_atlas_and_a_tile_that_cannot_be_read(
    cluster: Any, queried_map: Path, walks: list[Path], capsys: pytest.CaptureFixture[str]
):
    """The fault of a tile is printed once, even if several pieces find it."""
    assert main(["build", str(walks[0]), str(queried_map / "other.topo")]) == 0
    campus = queried_map / "campus"
    create_atlas(
        str(campus), new_tiles([str(queried_map / "room.topo"), str(queried_map / "other.topo")])
    )
    args = (
        campus,
        queried_map / "pictures",
        "--elsewhere",
        queried_map / "elsewhere",
        "--tile",
        "room",
    )
    assert _evaluated(capsys, *args, "--ray", cluster.address) == _evaluated(capsys, *args)
    (rotten,) = (campus / "tiles").glob("other-*.topo")
    rotten.write_bytes(b"rotten")
    alone = _evaluated(capsys, *args)
    assert alone[1].startswith("warning: tile other is not searched: ")
    assert alone[1].count("\n") == 1
    assert _evaluated(capsys, *args, "--ray", cluster.address) == alone


def test_failures_are_those_of_the_plain_command(
    cluster: Any, queried_map: Path, complaint: Complaint
):
    for picture in (queried_map / "pictures").glob("view[0-9]*.png"):
        if picture.name != "view00.png":  # most of them: a few are left out
            picture.write_bytes(b"no picture")
    for args in (
        (queried_map / "pictures",),
        (queried_map / "nowhere",),
        (queried_map / "pictures" / "view00.png",),
    ):
        alone = complaint("evaluate", queried_map / "room.topo", *args)
        assert (
            complaint("evaluate", queried_map / "room.topo", *args, "--ray", cluster.address)
            == alone
        )


def test_against_itself_refuses_a_cluster(room_map: Path, complaint: Complaint):
    assert "without --ray" in complaint(
        "evaluate", room_map, "--against-itself", "--ray", "local", status=2
    )


@pytest.fixture
def piece(queried_map: Path) -> Piece:
    """Return all images of the room as one piece that is sent to a machine."""
    topomap = TopoMetricMap.load(queried_map / "room.topo")
    recording = QueryRecording(str(queried_map / "pictures"), label="walk")
    sent = RemoteMap.from_localizer(Localizer(topomap), "", None)
    (piece,) = remote_queries._split(sent, recording, recording.open())
    return piece


def _silent(stage: str, done: int, total: int) -> None:
    pass


def test_a_piece_travels_small_and_answers_as_here(piece: Piece, queries: Path):
    packed = pickle.dumps(piece)
    outcome = pickle.dumps(pickle.loads(packed).run(_silent))
    assert len(packed) < 20_000
    assert len(outcome) < 20_000 * len(piece.frames)
    evaluation = summarize(pickle.loads(outcome).answers)
    assert evaluation["num_localized"] == len(unseen_views())
    assert evaluation["median_translation_m"] < 0.01


def test_another_map_in_its_place_is_refused(piece: Piece, queried_map: Path):
    packed = pickle.dumps(piece)
    with TopoMetricMap.load(queried_map / "room.topo") as topomap:
        replace(topomap, length_m=3.0).save(queried_map / "new.topo")
    os.replace(queried_map / "new.topo", queried_map / "room.topo")
    with pytest.raises(MapError, match="was replaced since"):
        pickle.loads(packed).run(_silent)


def test_another_recording_in_its_place_is_refused(piece: Piece, queried_map: Path):
    (queried_map / "pictures" / "view00.png").rename(queried_map / "pictures" / "a.png")
    with pytest.raises((RecordingError, TrajectoryError)):
        piece.run(_silent)
    (queried_map / "pictures" / "a.png").unlink()
    with pytest.raises((RecordingError, TrajectoryError)):
        piece.run(_silent)


def test_a_machine_without_the_same_features_does_not_answer(piece: Piece):
    other = replace(piece, queried_map=replace(piece.queried_map, kinds=frozenset()))
    with pytest.raises(
        MissingExtraError, match="has what features surf need, unlike the machine that asks"
    ):
        other.run(_silent)


@pytest.mark.parametrize("count", [1, 3, 4, 7])
def test_pieces_are_of_about_one_size(piece: Piece, count: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(remote_queries, "MAX_IMAGES", 3)
    monkeypatch.setattr(QueryRecording, "frames", lambda *_: [k % 2 for k in range(count)])
    parts = remote_queries._split(piece.queried_map, piece.recording, piece.recording.open())
    sizes = [len(one.frames) for one in parts]
    assert sum(sizes) == count
    assert max(sizes) <= 3
    assert max(sizes) - min(sizes) <= 1
