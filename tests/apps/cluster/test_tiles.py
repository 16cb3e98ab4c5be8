"""Test the conversion of recordings to tiles without a cluster."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from topoloc.apps.cluster.tiles import TileJob, TileTask, derive_tile_ids
from topoloc.atlas.atlas import Atlas
from topoloc.errors import AtlasError, RecordingError
from topoloc.mapping.topomap import TopoMetricMap


@dataclass(frozen=True)
class Copied:
    """Return an existing map instead of building one. If `fails` is set, raise it."""

    path: str
    digits: str = "ab"
    fails: Exception | None = None

    def make(self, progress: object) -> tuple[TopoMetricMap, list[str]]:
        print("something to know", file=sys.stderr)
        if self.fails is not None:
            raise self.fails
        return TopoMetricMap.load(self.path), ["truth"]

    def digest(self) -> str:
        return self.digits * 32


def _nothing(stage: str, done: int, total: int) -> None:
    pass


@pytest.fixture
def job(room_map: Path) -> TileJob:
    return TileJob("walks/room", "room", "room", Copied(str(room_map)))


@pytest.mark.parametrize(
    ("recordings", "ids"),
    [
        (["walks/hall", "/data/yard/"], ["hall", "yard"]),
        (
            ["hall@0:50", "hall@50:100,120:130", "hall@0::2"],
            ["hall_0-50", "hall_50-100-120-130", "hall_0--2"],
        ),
        (["hall@0-59/100"], ["hall_0-59-100"]),
        (["monday/hall", "tuesday/hall", "yard"], ["monday_hall", "tuesday_hall", "yard"]),
        (["hall", "monday/hall"], ["hall", "monday_hall"]),
        (["me@home/hall"], ["hall"]),
        (["walks/_große Halle!.bag"], ["gro-e-Halle-.bag"]),
        (["."], ["recording"]),
    ],
)
def test_tiles_are_called_as_their_recordings(recordings: list[str], ids: list[str]):
    assert derive_tile_ids(recordings) == ids


@pytest.mark.parametrize(
    "recordings", [["hall", "yard", "hall"], ["hall", "./hall"], ["a b", "a+b"]]
)
def test_a_recording_that_is_named_twice(recordings: list[str]):
    with pytest.raises(AtlasError, match="given twice"):
        derive_tile_ids(recordings)


def test_a_tile_is_made_once(job: TileJob, room_map: Path, tmp_path: Path):
    where = str(tmp_path / "campus")
    made = TileTask(job, where, False).run(_nothing)
    assert (made.state, made.reason, made.notes, made.tile_id) == (
        "built",
        None,
        ("something to know",),
        "room",
    )
    atlas = Atlas.open(where)
    tile = atlas.tile("room")
    assert atlas.map_path(tile).stat().st_size == made.num_bytes
    assert (tile.recipe, tile.num_nodes) == (job.digest(), made.num_nodes)
    before = (tmp_path / "campus" / "atlas.json").read_bytes()
    fails = replace(job, maker=replace(job.maker, fails=AssertionError("made twice")))
    again = TileTask(fails, where, False).run(_nothing)
    assert (again.state, again.notes, again.num_nodes) == ("there", (), made.num_nodes)
    assert (tmp_path / "campus" / "atlas.json").read_bytes() == before


def test_a_tile_of_other_settings_is_replaced_only_on_request(job: TileJob, tmp_path: Path):
    where = str(tmp_path / "campus")
    TileTask(job, where, False).run(_nothing)
    otherwise = replace(job, maker=replace(job.maker, digits="cd"))
    refused = TileTask(otherwise, where, False).run(_nothing)
    assert refused.state == "failed"
    assert "--replace" in (refused.reason or "")
    assert Atlas.read_manifest(where).by_id["room"].recipe == job.digest()
    assert TileTask(otherwise, where, True).run(_nothing).state == "built"
    assert Atlas.read_manifest(where).by_id["room"].recipe == otherwise.digest()
    elsewhere = replace(otherwise, world="campus")
    assert TileTask(elsewhere, where, True).run(_nothing).state == "built"
    assert Atlas.read_manifest(where).by_id["room"].world == "campus"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RecordingError("room: no pictures"), "room: no pictures"),
        (MemoryError(), "out of memory"),
        (ZeroDivisionError("in a bug"), "ZeroDivisionError: in a bug"),
    ],
)
def test_a_failure_has_a_reason_and_leaves_nothing(
    job: TileJob, error: Exception, reason: str, tmp_path: Path
):
    fails = replace(job, maker=replace(job.maker, fails=error))
    failed = TileTask(fails, str(tmp_path / "campus"), False).run(_nothing)
    assert (failed.state, failed.reason, failed.num_bytes) == ("failed", reason, 0)
    assert any("Traceback" in note for note in failed.notes) == isinstance(error, ZeroDivisionError)
    assert list(tmp_path.iterdir()) == []


def test_nothing_stays_in_the_folder_for_temporary_files(
    job: TileJob, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    scratch = tmp_path / "scratch"
    left = scratch / "topoloc-tile-0123abcd"
    left.mkdir(parents=True)
    (left / "tile.topo").write_bytes(b"of a worker that was killed")
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    assert TileTask(job, str(tmp_path / "campus"), False).run(_nothing).state == "built"
    assert list(scratch.iterdir()) == []
