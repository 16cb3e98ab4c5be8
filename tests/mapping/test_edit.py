"""Edits of a map file: all or nothing, with a history, one at a time, taken back to the byte."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from schema_1 import write_schema_1

from topoloc import TopoMetricMap
from topoloc.errors import MapError
from topoloc.mapping.edit import count_undoable_edits, edit_map, undo_edit
from topoloc.mapping.integrity_check import find_map_damage


@pytest.fixture
def map_file(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


def _without_a_node(path: Path, changes: dict | None = None) -> None:
    """A node with all that is of it goes, another one's template changes."""
    with edit_map(path) as edit:
        topomap, gone = edit.topomap, edit.topomap.summaries[-1].node_id
        first, *rest = list(topomap.nodes)[:-1]
        changed = replace(
            topomap,
            summaries=list(topomap.summaries)[:-1],
            nodes=[replace(first, template_jpeg=first.template_jpeg + b"\0"), *rest],
            other_kinds={kind: list(nodes)[:-1] for kind, nodes in topomap.other_kinds.items()},
            edges=[edge for edge in topomap.edges if gone not in (edge.source_id, edge.target_id)],
            place_images=[image for image in topomap.place_images if image.node_id != gone],
            repetitions=None,
        )
        edit.commit(changed, f"drop node {gone}", changes)


def test_edits_are_taken_back_to_the_byte_the_last_one_first(map_file: Path):
    files = [map_file.read_bytes()]
    for k in range(3):
        _without_a_node(map_file, {"nodes": -1, "why": "a test"})
        files.append(map_file.read_bytes())
        assert count_undoable_edits(map_file) == k + 1
        assert find_map_damage(map_file) == []
    with TopoMetricMap.load(map_file) as topomap:
        assert [edit.edit_id for edit in topomap.edits] == [1, 2, 3, 4]
        assert topomap.edits[1].changes == {"nodes": -1, "why": "a test"}
    for before in reversed(files[:-1]):
        assert undo_edit(map_file).name.startswith("drop node")
        assert map_file.read_bytes() == before
    assert [path.name for path in map_file.parent.iterdir()] == ["room.topo"]
    with pytest.raises(MapError, match="nothing to undo: it is as built"):
        undo_edit(map_file)


def test_what_an_undo_takes_is_small(map_file: Path):
    _without_a_node(map_file)
    with TopoMetricMap.load(map_file) as topomap:
        num_nodes = len(topomap.summaries)
    assert (
        map_file.parent / "room.topo.undo"
    ).stat().st_size < 4 * map_file.stat().st_size / num_nodes + 20_000


def test_a_map_of_an_older_schema_is_taken_back_whole(map_file: Path, tmp_path: Path):
    old = tmp_path / "old.topo"
    with TopoMetricMap.load(map_file) as topomap:
        write_schema_1(topomap, old)
    before = old.read_bytes()
    _without_a_node(old)
    assert old.read_bytes() != before
    undo_edit(old)
    assert old.read_bytes() == before


def test_without_its_undo_file_a_map_stays_as_it_is(map_file: Path):
    _without_a_node(map_file)
    edited, log = map_file.read_bytes(), map_file.parent / "room.topo.undo"
    log.write_bytes(b"not ours" * 1000)
    with pytest.raises(MapError, match="move it away"):
        undo_edit(map_file)
    log.unlink()
    with pytest.raises(MapError, match=r"what was before 'drop node .*' is not kept"):
        undo_edit(map_file)
    assert map_file.read_bytes() == edited


@pytest.mark.parametrize("seed", range(8))
def test_a_damaged_undo_file_never_damages_the_map(map_file: Path, seed: int):
    _without_a_node(map_file)
    edited, log = map_file.read_bytes(), map_file.parent / "room.topo.undo"
    before = (data := bytearray(log.read_bytes()))[:]
    for at in np.random.default_rng(seed).integers(100, len(data), 60):
        data[at] ^= 1 + seed
    log.write_bytes(data)
    try:
        undo_edit(map_file)
    except MapError:
        assert map_file.read_bytes() == edited
    assert find_map_damage(map_file) == []
    assert bytes(before) != bytes(data)


def test_an_entry_for_another_file_is_not_used(map_file: Path):
    _without_a_node(map_file)
    stale = (map_file.parent / "room.topo.undo").read_bytes()
    undo_edit(map_file)
    (map_file.parent / "room.topo.undo").write_bytes(
        stale
    )  # as a process leaves it that was killed before the map was renamed
    assert count_undoable_edits(map_file) == 0
    before = map_file.read_bytes()
    _without_a_node(map_file)
    assert count_undoable_edits(map_file) == 1
    undo_edit(map_file)
    assert map_file.read_bytes() == before


def test_the_second_edit_waits_for_the_first(map_file: Path):
    waited, done = threading.Event(), list[str]()

    def second() -> None:
        with edit_map(map_file, waited.set) as edit:
            done.append("second begins")
            edit.commit(edit.topomap, "second")

    thread = threading.Thread(target=second)
    with edit_map(map_file) as edit:
        thread.start()
        assert waited.wait(20)
        edit.commit(edit.topomap, "first")
        done.append("first is done")
    thread.join(60)
    assert done == ["first is done", "second begins"]
    with TopoMetricMap.load(map_file) as topomap:
        assert [edit.name for edit in topomap.edits][-2:] == ["first", "second"]


def test_nothing_is_left_of_an_edit_that_fails(map_file: Path):
    before = map_file.read_bytes()

    class Broken(list):
        def __iter__(self):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), edit_map(map_file) as edit:
        edit.commit(replace(edit.topomap, place_images=Broken()), "broken")
    assert map_file.read_bytes() == before
    assert [path.name for path in map_file.parent.iterdir()] == ["room.topo"]


@pytest.mark.skipif(os.name == "nt", reason="no such permissions")
def test_a_map_that_is_read_only_is_not_replaced(map_file: Path):
    before = map_file.read_bytes()
    map_file.chmod(0o444)
    with pytest.raises(MapError, match="read-only"):
        _without_a_node(map_file)
    assert map_file.read_bytes() == before


def test_killed_at_any_moment_the_map_is_whole(map_file: Path):
    script = Path(__file__).parents[2] / "benchmarks" / "kill_edits.py"
    ended = subprocess.run(
        [sys.executable, script, map_file, "--kills", "6", "--within", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "6 kills" in ended.stdout
    assert "0 times broken, 0 times something left" in ended.stdout
