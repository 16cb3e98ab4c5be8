"""Test the files of the index: they are made once, follow changes of the atlas, and are
rebuilt if damaged."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from topoloc.atlas import descriptor_shard, index_files
from topoloc.atlas.descriptor_shard import DescriptorShard
from topoloc.atlas.index import AtlasIndex, GlobalDescriptors
from topoloc.atlas.index_files import open_index
from topoloc.atlas.manifest import PlacesFile, StoredFile, Tile
from topoloc.errors import AtlasError
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

PLACES_A_TILE = 60


@dataclass(eq=False)
class Campus:
    """Hold an atlas with random global descriptors, and record which tiles'
    descriptors are read."""

    folder: Path
    vectors: dict[str, np.ndarray] = field(default_factory=dict)
    read: list[str] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))

    def add(self, *names: str) -> None:
        centres = self.rng.standard_normal((len(names), 1, 128))
        rows = centres + 0.7 * self.rng.standard_normal((len(names), PLACES_A_TILE, 128))
        for name, one in zip(names, rows, strict=True):
            self.vectors[name] = (
                (one / np.linalg.norm(one, axis=1, keepdims=True))
                .astype(np.float16)
                .astype(np.float32)
            )

    def open(self) -> AtlasIndex:
        vocabulary, tiles = shared_vocabulary("surf"), []
        assert vocabulary is not None
        for name, rows in sorted(self.vectors.items()):
            stored = StoredFile(f"tiles/{name}.places", f"{abs(hash(rows.tobytes())):064x}", 1)
            versions = {"surf": vocabulary.version}
            tiles.append(
                Tile(
                    name,
                    stored,
                    PlacesFile(stored.name, stored.sha256, 1, versions),
                    "0" * 16,
                    1,
                    ("surf",),
                    len(rows),
                    (),
                    300.0,
                    np.zeros((2, 3)),
                    name,
                    None,
                    None,
                    None,
                )
            )
        self.read.clear()
        return open_index(tiles, self._read, self.folder)

    def _read(self, tile: Tile) -> GlobalDescriptors:
        self.read.append(tile.tile_id)
        if tile.tile_id == "broken":
            raise AtlasError("broken is damaged")
        return {"surf": self.vectors[tile.tile_id]}

    def check(self, opened: AtlasIndex) -> None:
        """Check that an image of one of its places finds each tile, with the right similarity."""
        for name, rows in self.vectors.items():
            asked = rows[7] + 0.03 * self.rng.standard_normal(128).astype(np.float32)
            asked /= np.linalg.norm(asked)
            best = {
                other: float((of_other @ asked).max()) for other, of_other in self.vectors.items()
            }
            ranked = opened.rank({"surf": asked}, 3)
            assert [one for one, _ in ranked] == sorted(best, key=lambda one: -best[one])[:3], name
            assert [likeness for _, likeness in ranked] == pytest.approx(
                [best[one] for one, _ in ranked], abs=1e-3
            )

    @property
    def files(self) -> list[Path]:
        return sorted(self.folder.glob("*"))


@pytest.fixture
def campus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Campus:
    """Return twelve tiles. More than 500 places make a shard, which holds at most 900."""
    monkeypatch.setattr(index_files, "MAX_EXACT_DESCRIPTORS", 500)
    monkeypatch.setattr(index_files, "SHARD_DESCRIPTORS", 900)
    monkeypatch.setattr(descriptor_shard, "MAX_ROWS_COMPARED", 100)
    made = Campus(tmp_path / "index")
    made.add(*(f"t{number:02d}" for number in range(12)))
    return made


def test_an_index_is_made_once(campus: Campus):
    first = campus.open()
    campus.check(first)
    assert len(campus.read) == 12
    (file,) = campus.files
    before, data = file.stat().st_ino, file.read_bytes()
    again = campus.open()
    campus.check(again)
    assert (campus.read, again.notes, campus.files[0].stat().st_ino) == ([], [], before)
    file.unlink()
    campus.open()
    assert (
        file.read_bytes() == data
    )  # so it does not matter which of two processes is the last to write it


def test_few_tiles_that_come_are_compared_and_many_become_a_shard(campus: Campus):
    campus.open()
    campus.add("new0", "new1")
    opened = campus.open()
    assert campus.read == ["new0", "new1"]
    assert len(campus.files) == 1
    campus.check(opened)
    campus.add(*(f"many{number}" for number in range(10)))
    campus.check(campus.open())
    assert len(campus.files) == 2  # the first one was more than half full
    campus.open()
    assert campus.read == []


def test_a_small_shard_is_merged_with_new_tiles(campus: Campus, monkeypatch: pytest.MonkeyPatch):
    campus.open()
    monkeypatch.setattr(index_files, "SHARD_DESCRIPTORS", 10_000)
    campus.add(*(f"many{number}" for number in range(10)))
    campus.check(campus.open())
    assert sorted(campus.read) == [f"many{number}" for number in range(10)]
    assert sorted(len(DescriptorShard.open(path).vectors) for path in campus.files) == [
        720,
        1320,
    ]  # the smaller may be open elsewhere
    long_ago = time.time() - 2 * 86_400
    for path in campus.files:
        os.utime(path, (long_ago, long_ago))
    campus.check(campus.open())
    assert [len(DescriptorShard.open(path).vectors) for path in campus.files] == [1320]


def test_tiles_that_are_removed_or_replaced_are_not_named(campus: Campus):
    campus.open()
    del campus.vectors["t03"]
    gone = campus.vectors["t05"][7]
    campus.add("t05")
    opened = campus.open()
    assert campus.read == ["t05"]
    campus.check(opened)
    assert opened.rank({"surf": gone}, 1)[0][1] < 0.9
    for number in range(6, 10):
        del campus.vectors[f"t{number:02d}"]
    campus.check(campus.open())  # more than a quarter is gone
    assert len(campus.read) == 7


def test_only_tiles_in_the_given_set_are_ranked(campus: Campus):
    opened = campus.open()
    for among in ({"t01"}, {"t01", "t02", "t07"}, set(campus.vectors) - {"t04"}, set()):
        asked = campus.vectors["t04"][3]
        best = {name: float((campus.vectors[name] @ asked).max()) for name in among}
        ranked = opened.rank({"surf": asked}, 2, among)
        assert [name for name, _ in ranked] == sorted(best, key=lambda one: -best[one])[:2]


@pytest.mark.parametrize("damage", ["short", "rotten", "empty", "text", "rotten header"])
def test_a_damaged_file_is_made_anew_with_one_note(campus: Campus, damage: str):
    campus.open()
    (file,) = campus.files
    data = bytearray(file.read_bytes())
    data[{"rotten": len(data) // 2, "rotten header": 70}.get(damage, 0)] ^= 0x10
    file.write_bytes(
        {"short": bytes(data[:-100]), "empty": b"", "text": b"no index\n" * 99}.get(
            damage, bytes(data)
        )
    )
    opened = campus.open()
    assert len(opened.notes) == 1
    assert "missing or damaged" in opened.notes[0]
    campus.check(opened)
    assert campus.open().notes == []
    assert campus.read == []


def test_without_a_writable_folder_the_index_stays_in_memory(campus: Campus):
    campus.folder.parent.joinpath("file").write_bytes(b"")
    campus.folder = campus.folder.parent / "file" / "index"
    opened = campus.open()
    assert len(opened.notes) == 1
    assert "stays in memory" in opened.notes[0]
    campus.check(opened)


def test_a_tile_that_cannot_be_read_is_a_problem_until_it_can(campus: Campus):
    campus.add("broken")
    opened = campus.open()
    assert opened.problems == {"broken": "broken is damaged"}
    assert "broken" not in dict(opened.rank({"surf": campus.vectors["broken"][0]}, 99))
    assert campus.open().problems == opened.problems
    assert campus.read == ["broken"]
