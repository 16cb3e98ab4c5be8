"""Check that a power cut at any moment of an edit or undo leaves the map before or after it.

The file operations are recorded. Then each possible state of the disk after a crash is made. A file
has its last synchronized content. Of the name changes since the last synchronization of the folder,
all or some are lost.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from topoloc.errors import MapError
from topoloc.mapping.edit import edit_map, undo_edit
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.storage.kept_files import find_kept_files


@dataclass
class Disk:
    """Hold the synchronized state of the disk: `names` to inodes, and the content of inodes.
    `pending` are name changes that are not synchronized."""

    names: dict[str, int]
    contents: dict[int, bytes]
    pending: list[tuple[Any, ...]] = field(default_factory=list)
    states: list[dict[str, bytes]] = field(default_factory=list)

    def note(self) -> None:
        """Add the states in which a crash may leave the folder now."""
        count = len(self.pending)
        chosen = [range(k) for k in range(count + 1)] + [[k] for k in range(count)]
        for rows in chosen:
            names = dict(self.names)
            for row in rows:
                _apply(names, *self.pending[row])
            state = {name: self.contents.get(inode, b"") for name, inode in names.items()}
            if state not in self.states:
                self.states.append(state)


def _apply(names: dict[str, int], change: str, source: str, target: str, inode: int) -> None:
    if change == "remove":
        names.pop(source, None)
    else:
        names[target] = inode
        if change == "replace":
            names.pop(source, None)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch, room_map: Path, tmp_path: Path) -> Disk:
    """Return a folder with one map. Its file operations are recorded from now on."""
    folder = tmp_path / "maps"
    folder.mkdir()
    path = Path(shutil.copy(room_map, folder / "room.topo"))
    recorded = Disk({path.name: path.stat().st_ino}, {path.stat().st_ino: path.read_bytes()})
    real = {name: getattr(os, name) for name in ("open", "link", "replace", "unlink", "fsync")}

    def change(kind: str, source: Any, target: Any = "") -> None:
        if Path(source).parent == folder:
            inode = os.stat(source).st_ino if kind != "remove" else 0
            recorded.pending.append((kind, Path(source).name, Path(target).name, inode))

    def opened(path: Any, flags: int, *rest: Any, **named: Any) -> int:
        descriptor = real["open"](path, flags, *rest, **named)
        if flags & os.O_CREAT and Path(path).parent == folder:
            change("create", path, path)
            recorded.note()
        return descriptor

    def link(source: Any, target: Any) -> None:
        change("link", source, target)
        real["link"](source, target)
        recorded.note()

    def replace(source: Any, target: Any) -> None:
        change("replace", source, target)
        real["replace"](source, target)
        recorded.note()

    def unlink(path: Any, **named: Any) -> None:
        real["unlink"](path, **named)
        change("remove", path)
        recorded.note()

    def fsync(descriptor: int) -> None:
        real["fsync"](descriptor)
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        if path == folder:
            for one in recorded.pending:
                _apply(recorded.names, *one)
            recorded.pending.clear()
        elif path.parent == folder:
            recorded.contents[path.stat().st_ino] = path.read_bytes()
        recorded.note()

    for name, function in {
        "open": opened,
        "link": link,
        "replace": replace,
        "unlink": unlink,
        "fsync": fsync,
    }.items():
        monkeypatch.setattr(os, name, function)
    return recorded


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="no list of open files")
def test_a_power_cut_leaves_the_map_before_or_after_an_edit(
    disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path, files = tmp_path / "maps" / "room.topo", list[bytes]()
    files.append(path.read_bytes())
    for name in ("first", "second"):
        with edit_map(path) as edit:
            edit.commit(edit.topomap, name)
        files.append(path.read_bytes())
    undo_edit(path)
    assert disk.pending == [], "the undo itself is on the disk"
    monkeypatch.undo()
    assert path.read_bytes() == files[1]
    assert len(disk.states) > 10
    for number, state in enumerate(disk.states):
        folder = tmp_path / f"crash-{number}"
        folder.mkdir()
        for name, content in state.items():
            (folder / name).write_bytes(content)
        assert state["room.topo"] in files
        left = folder / "room.topo"
        assert find_map_damage(left) == []
        for before in reversed(files[: files.index(state["room.topo"])]):
            assert find_kept_files(left), sorted(state)
            undo_edit(left)
            assert left.read_bytes() == before
        with pytest.raises(MapError, match="nothing to undo"):
            undo_edit(left)
