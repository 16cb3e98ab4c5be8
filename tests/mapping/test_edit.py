"""Test edits of a map file: all or nothing, with a history, one at a time, and
byte-identical after undo."""

from __future__ import annotations

import errno
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
from topoloc.mapping.edit import (
    edit_map,
    read_history,
    undo_edit,
)
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.storage.kept_files import _digest_of as of, find_kept_files, keep_file


@pytest.fixture
def map_file(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


def _names(path: Path) -> list[str]:
    return sorted(one.name for one in path.parent.iterdir())


def _without_a_node(path: Path, changes: dict | None = None) -> None:
    """Remove a node and its data, and change the template of another."""
    with edit_map(path) as edit:
        topomap, gone = edit.topomap, edit.topomap.summaries[-1].node_id
        first, *rest = list(topomap.nodes)[:-1]
        nodes = [replace(first, template=first.template_image + b"\0"), *rest]
        layers = {
            kind: replace(layer, nodes=nodes if kind == topomap.kind else list(layer.nodes)[:-1])
            for kind, layer in topomap.layers.items()
        }
        changed = replace(
            topomap,
            summaries=list(topomap.summaries)[:-1],
            layers=layers,
            edges=[edge for edge in topomap.edges if gone not in (edge.source_id, edge.target_id)],
            place_images=[image for image in topomap.place_images if image.node_id != gone],
            repetitions=None,
        )
        edit.commit(changed, f"drop node {gone}", changes)


def test_edits_are_undone_byte_identically_the_last_one_first(map_file: Path):
    files = [map_file.read_bytes()]
    for k in range(3):
        _without_a_node(map_file, {"nodes": -1, "why": "a test"})
        files.append(map_file.read_bytes())
        assert len(find_kept_files(map_file)) == k + 1
        assert find_map_damage(map_file) == []
    with TopoMetricMap.load(map_file) as topomap:
        assert [edit.edit_id for edit in topomap.edits] == [1, 2, 3, 4]
        assert topomap.edits[1].changes == {"nodes": -1, "why": "a test"}
    for before in reversed(files[:-1]):
        assert undo_edit(map_file).name.startswith("drop node")
        assert map_file.read_bytes() == before
    assert _names(map_file) == ["room.topo"]
    with pytest.raises(MapError, match="nothing to undo: it is as built"):
        undo_edit(map_file)


def test_the_file_before_an_edit_is_kept_as_a_link(map_file: Path):
    status = map_file.stat()
    _without_a_node(map_file)
    (kept,) = find_kept_files(map_file)
    assert kept.stat().st_ino == status.st_ino
    undo_edit(map_file)
    assert map_file.stat().st_ino == status.st_ino


def test_without_hard_links_the_file_is_copied(map_file: Path, monkeypatch: pytest.MonkeyPatch):
    before = map_file.read_bytes()

    def no_links(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_links)
    _without_a_node(map_file)
    undo_edit(map_file)
    assert map_file.read_bytes() == before
    assert _names(map_file) == ["room.topo"]


def test_the_oldest_files_go_beyond_the_limit(map_file: Path, monkeypatch: pytest.MonkeyPatch):
    for limit, num_kept in ((2.5 * map_file.stat().st_size, 2), (1, 1)):
        monkeypatch.setattr("topoloc.mapping.storage.kept_files._MAX_BYTES", limit)
        for k in range(3):
            with edit_map(map_file) as edit:
                edit.commit(edit.topomap, f"edit {k}")
        assert len(find_kept_files(map_file)) == num_kept
        assert len(_names(map_file)) == 1 + num_kept


def test_a_map_of_an_older_schema_is_restored_completely(map_file: Path, tmp_path: Path):
    old = tmp_path / "old.topo"
    with TopoMetricMap.load(map_file) as topomap:
        write_schema_1(topomap, old)
    before = old.read_bytes()
    _without_a_node(old)
    assert old.read_bytes() != before
    undo_edit(old)
    assert old.read_bytes() == before


def test_without_its_kept_file_a_map_stays_as_it_is(map_file: Path):
    _without_a_node(map_file)
    edited, (kept,) = map_file.read_bytes(), find_kept_files(map_file)
    kept.unlink()
    with pytest.raises(MapError, match=r"the file before 'drop node .*' is not kept"):
        undo_edit(map_file)
    assert map_file.read_bytes() == edited


def test_an_undo_file_of_row_differences_is_refused(tmp_path: Path):
    folder = Path(__file__).parents[1] / "fixtures" / "aea690a"
    for name in ("pruned.topo", "pruned.topo.undo"):
        shutil.copy(folder / name, tmp_path)
    path = tmp_path / "pruned.topo"
    assert not any(edit["undoable"] for edit in read_history(path))
    with pytest.raises(MapError, match=r"pruned\.topo\.undo is of an older topoloc"):
        undo_edit(path)
    before = path.read_bytes()
    assert before == (folder / "pruned.topo").read_bytes()
    with edit_map(path) as edit:
        edit.commit(edit.topomap, "note")
    undo_edit(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("seed", range(8))
def test_a_damaged_kept_file_is_refused(map_file: Path, seed: int):
    _without_a_node(map_file)
    edited, (kept,) = map_file.read_bytes(), find_kept_files(map_file)
    data = bytearray(kept.read_bytes())
    rng = np.random.default_rng(seed)
    if seed % 2:
        data[rng.integers(len(data))] ^= 1 + seed
    else:
        del data[rng.integers(len(data)) :]
    kept.write_bytes(data)
    with pytest.raises(MapError, match=r"room\.topo\.undo-.* is damaged"):
        undo_edit(map_file)
    assert map_file.read_bytes() == edited
    with pytest.warns(UserWarning, match=r"no earlier edit can be undone: .* is damaged"):
        assert not any(edit["undoable"] for edit in read_history(map_file))
    with pytest.warns(UserWarning, match=r"no earlier edit can be undone: .* is damaged.* Remove"):
        _without_a_node(map_file)
    undo_edit(map_file)
    assert map_file.read_bytes() == edited


def test_an_edit_reads_one_of_the_older_kept_files(map_file: Path, monkeypatch: pytest.MonkeyPatch):
    """All kept files together may have 1 GB. `history` reads all of them, and `undo` reads only
    the restored one."""
    for _ in range(4):
        _without_a_node(map_file)
    kept, read = find_kept_files(map_file), list[Path]()
    kept[2].write_bytes(kept[2].read_bytes()[:-1])
    with monkeypatch.context() as patched:
        digests = "topoloc.mapping.storage.kept_files._digest_of"
        patched.setattr(digests, lambda one: read.append(one) or of(one))
        _without_a_node(map_file)
    assert [one for one in read if one in kept] == [kept[0]]
    with pytest.warns(UserWarning, match=f"{kept[2].name} is damaged"):
        assert sum(edit["undoable"] for edit in read_history(map_file)) == 3
    for _ in range(3):
        undo_edit(map_file)
    before = map_file.read_bytes()
    with pytest.raises(MapError, match=f"{kept[2].name} is damaged"):
        undo_edit(map_file)
    assert map_file.read_bytes() == before


def test_a_kept_file_of_another_map_is_not_used(map_file: Path):
    before = map_file.read_bytes()
    _without_a_node(map_file)
    (kept,) = find_kept_files(map_file)
    stale = kept.read_bytes()
    undo_edit(map_file)
    kept.write_bytes(stale)  # as a process leaves it that was killed before it renamed the map
    assert find_kept_files(map_file) == []
    with edit_map(map_file) as edit:
        edit.commit(edit.topomap, "note")
    (kept,) = find_kept_files(map_file)
    assert _names(map_file) == ["room.topo", kept.name]
    undo_edit(map_file)
    assert map_file.read_bytes() == before


def test_a_map_that_is_replaced_during_an_edit_stays(map_file: Path, tmp_path: Path):
    other = Path(shutil.copy(map_file, tmp_path / "other.topo"))
    _without_a_node(other)
    data = other.read_bytes()
    with edit_map(map_file) as edit:
        os.replace(other, map_file)
        with pytest.raises(MapError, match="was replaced during the edit"):
            edit.commit(edit.topomap, "nothing")
    assert map_file.read_bytes() == data
    assert find_kept_files(map_file) == []


@pytest.mark.parametrize("function", ["link", "replace"])
def test_an_edit_that_cannot_be_written_changes_nothing(
    map_file: Path, monkeypatch: pytest.MonkeyPatch, function: str
):
    before = map_file.read_bytes()

    def is_full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    _without_a_node(map_file)
    after, names = map_file.read_bytes(), _names(map_file)
    with monkeypatch.context() as patched:
        patched.setattr(os, function, is_full)
        patched.setattr(shutil, "copyfile", is_full)
        with pytest.raises(MapError, match="No space left"):
            _without_a_node(map_file)
        if function == "replace":
            with pytest.raises(MapError, match="No space left"):
                undo_edit(map_file)
    assert (map_file.read_bytes(), _names(map_file)) == (after, names)
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
    assert _names(map_file) == ["room.topo"]


@pytest.mark.skipif(os.name == "nt", reason="no such permissions")
def test_a_map_that_is_read_only_is_not_replaced(map_file: Path):
    before = map_file.read_bytes()
    map_file.chmod(0o444)
    with pytest.raises(MapError, match="read-only"):
        _without_a_node(map_file)
    assert map_file.read_bytes() == before


@pytest.mark.parametrize("kills", [2, pytest.param(20, marks=pytest.mark.slow)])
def test_killed_at_any_moment_the_map_is_whole(map_file: Path, kills: int):
    script = Path(__file__).parents[2] / "benchmarks" / "kill_edits.py"
    ended = subprocess.run(
        [sys.executable, script, map_file, "--kills", str(kills), "--within", "0.6"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert f"{kills} kills" in ended.stdout
    assert "0 times broken, 0 times something left" in ended.stdout


def test_a_map_that_is_replaced_while_the_edit_is_written_stays(
    map_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    other = Path(shutil.copy(map_file, tmp_path / "other.topo"))
    _without_a_node(other)
    data = other.read_bytes()
    for kept in find_kept_files(other):
        kept.unlink()

    def keep_slowly(path: Path, changed: Path) -> Path:
        kept = keep_file(path, changed)
        os.replace(other, path)
        return kept

    monkeypatch.setattr("topoloc.mapping.storage.map_writing.keep_file", keep_slowly)
    with (
        edit_map(map_file) as edit,
        pytest.raises(MapError, match="was replaced during the edit"),
    ):
        edit.commit(edit.topomap, "nothing")
    assert map_file.read_bytes() == data
    assert _names(map_file) == ["room.topo"]


def test_a_map_is_saved_over_one_after_its_edit(map_file: Path):
    waited, done = threading.Event(), list[str]()

    def save(topomap: TopoMetricMap) -> None:
        topomap.save(map_file, waited.set)
        done.append("saved")

    with TopoMetricMap.load(map_file) as other:
        thread = threading.Thread(target=save, args=(other,))
        with edit_map(map_file) as edit:
            thread.start()
            assert waited.wait(20)
            edit.commit(edit.topomap, "first")
            done.append("edited")
            edited = map_file.read_bytes()
        thread.join(60)
    assert done == ["edited", "saved"]
    assert map_file.read_bytes() != edited
    with edit_map(map_file) as edit, pytest.raises(MapError, match="edited by this thread"):
        edit.topomap.save(map_file)


@pytest.mark.parametrize("length", [200, 201, 216, 255])
def test_maps_of_long_names_are_edited(map_file: Path, length: int):
    path = map_file.rename(map_file.with_name("x" * (length - 5) + ".topo"))
    before = path.read_bytes()
    _without_a_node(path)
    assert len(find_kept_files(path)) == 1
    undo_edit(path)
    assert path.read_bytes() == before
    assert _names(path) == [path.name]
