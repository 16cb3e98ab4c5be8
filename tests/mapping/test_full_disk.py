"""Check that an edit or undo is complete or changes nothing on a full disk or with
few file handles."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from topoloc.errors import MapError
from topoloc.mapping.edit import edit_map
from topoloc.mapping.storage import map_file, map_writing
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.mapping.validation import sqlite_failures_as_os_errors

ON_DISKS = """
import shutil, subprocess, sys
from pathlib import Path
from topoloc import MapError, undo_edit
from topoloc.mapping.edit import edit_map, read_history

source, disk = Path(sys.argv[1]), Path(sys.argv[2])
path = disk / "room.topo"


def state():
    return {one.name: one.read_bytes() for one in disk.iterdir()}


def edit():
    with edit_map(path) as opened:
        opened.commit(opened.topomap, "note")


for kb in range(*map(int, sys.argv[3:])):
    for work in (undo_edit, edit):
        mount = ["mount", "-t", "tmpfs", "-o", f"size={kb}k", "tmpfs", str(disk)]
        subprocess.run(mount, check=True)
        for one in sorted(source.iterdir(), key=lambda one: len(one.name)):
            try:
                shutil.copyfile(one, disk / one.name)
            except OSError:
                pass
        before, outcome = state(), "done"
        try:
            work(path) if work is undo_edit else work()
        except MapError as error:
            assert state() == before, sorted(state())
            assert "sqlite" not in str(error) and ".part" not in str(error)
            outcome = "no room" if "No space left on device; free some" in str(error) else "damaged"
        else:
            read_history(path)
        print(kb, work.__name__, outcome)
        subprocess.run(["umount", str(disk)], check=True)
"""


@pytest.fixture
def edited(room_map: Path, tmp_path: Path) -> Path:
    """Return a map with two kept files, alone in its folder."""
    (tmp_path / "maps").mkdir()
    path = Path(shutil.copy(room_map, tmp_path / "maps" / "room.topo"))
    for name in ("first", "second"):
        with edit_map(path) as edit:
            edit.commit(edit.topomap, name)
    return path


def test_on_disks_of_every_size_all_or_nothing_happens(edited: Path, tmp_path: Path):
    script = tmp_path / "on_disks.py"
    script.write_text(ON_DISKS)
    (tmp_path / "disk").mkdir()
    kb = edited.stat().st_size // 1000
    command = ["unshare", "-rm", sys.executable, str(script), str(edited.parent)]
    if (
        shutil.which("unshare") is None
        or subprocess.run(
            ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", tmp_path / "disk"], check=False
        ).returncode
    ):
        pytest.skip("no name spaces of mounts here")
    sizes = [str(number) for number in (kb // 2, 5 * kb, kb // 8)]
    done = subprocess.run(
        [*command, str(tmp_path / "disk"), *sizes], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    outcomes = {tuple(line.split(maxsplit=2)[1:]) for line in done.stdout.splitlines()}
    assert {(work, "done") for work in ("edit", "undo_edit")} <= outcomes
    assert {("edit", "no room"), ("undo_edit", "damaged")} <= outcomes
    assert ("undo_edit", "no room") not in outcomes


@pytest.mark.skipif(os.name == "nt", reason="no such limit")
def test_with_few_file_handles_an_edit_is_one_line_or_done(edited: Path):
    import resource

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    used, outcomes = max(map(int, os.listdir("/proc/self/fd"))) + 1, set[str]()
    held = [os.open(os.devnull, os.O_RDONLY)]  # so that no lower handle is free
    while held[-1] < used - 1:
        held.append(os.open(os.devnull, os.O_RDONLY))
    try:
        for more in range(12):
            before = {one.name: one.read_bytes() for one in edited.parent.iterdir()}
            try:
                resource.setrlimit(resource.RLIMIT_NOFILE, (used + more, limits[1]))
                _edit(edited)
                outcomes.add("done")
                continue
            except MapError as error:
                text = str(error)
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            assert {one.name: one.read_bytes() for one in edited.parent.iterdir()} == before
            assert "Too many open files; raise the limit (ulimit -n)" in text
            assert ".part" not in text
            outcomes.add("refused")
    finally:
        for handle in held:
            os.close(handle)
    assert outcomes == {"done", "refused"}


def test_damage_is_distinguished_from_a_full_disk(tmp_path: Path):
    path = tmp_path / "some.db"
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute("CREATE TABLE t (a BLOB)")
        database.execute("PRAGMA max_page_count = 3")
        with pytest.raises(OSError, match="No space left") as full, sqlite_failures_as_os_errors():
            database.execute("INSERT INTO t VALUES (zeroblob(100000))")
    assert full.value.errno == errno.ENOSPC
    path.write_bytes(b"no database" * 1000)
    with (
        closing(sqlite3.connect(path)) as database,
        pytest.raises(sqlite3.DatabaseError),
        sqlite_failures_as_os_errors(),
    ):
        database.execute("SELECT * FROM t")


def _raise_input_error(file: map_file.MapFile) -> None:
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR | 1 << 8
    with file.read_connection():
        raise error


def test_a_disk_that_fails_is_no_damage(edited: Path):
    with (
        closing(map_file.MapFile(edited)) as file,
        pytest.raises(MapError, match=r"cannot read map .*; check this disk") as raised,
    ):
        _raise_input_error(file)
    assert "damaged" not in str(raised.value)


def test_a_read_has_a_budget_of_work(edited: Path, monkeypatch: pytest.MonkeyPatch):
    assert not hasattr(map_file, "time")
    monkeypatch.setattr(map_file, "MAX_STEPS", 20)
    with pytest.raises(MapError, match="takes more than 20 steps, which no map needs"):
        TopoMetricMap.load(edited)


def test_a_full_folder_of_temporary_files_is_named(edited: Path, monkeypatch: pytest.MonkeyPatch):
    before = edited.read_bytes()
    monkeypatch.setattr(map_writing._Writer, "write", _fill)
    with pytest.raises(MapError, match=r"cannot write map .*room\.topo: No space left.*\(TMPDIR\)"):
        _edit(edited)
    assert edited.read_bytes() == before


def _fill(self: map_writing._Writer, _: TopoMetricMap) -> None:
    """Reach the size limit of a small temporary database."""
    self._database.execute("CREATE TABLE t (a BLOB)")
    self._database.execute("PRAGMA max_page_count = 3")
    self._database.execute("INSERT INTO t VALUES (zeroblob(100000))")


def _edit(path: Path) -> None:
    """Edit the map without a change."""
    with edit_map(path) as edit:
        edit.commit(edit.topomap, "note")
