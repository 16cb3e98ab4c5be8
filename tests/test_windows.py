"""Simulate files on Windows: no `flock`, no opening of folders, and no rename, replacement or
removal of a file that this process has open."""

from __future__ import annotations

import ast
import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from topoloc import TopoMetricMap
from topoloc.apps.cli import main
from topoloc.apps.formats.bags.chunked_file import WHOLE_FILE, ChunkedBytes
from topoloc.recordings import atomic, file_locks

ROOT = Path(__file__).parents[1]
_DESCRIPTORS = Path("/proc/self/fd")
pytestmark = pytest.mark.skipif(
    not _DESCRIPTORS.is_dir(), reason="needs Linux's list of open files"
)


def _status_of(path: Any, dir_fd: int | None = None) -> tuple[int, int] | None:
    try:
        status = os.stat(path, dir_fd=dir_fd) if dir_fd is not None else os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _is_ours(path: Any) -> bool:
    """Return whether a file is not one of pytest's own."""
    return any(word in str(path) for word in ("pytest-", "topoloc-"))


def _refuse_if_open(path: Any) -> None:
    """Raise the error of Windows for a file that is open or mapped into memory."""
    wanted = _status_of(path)
    opened = [_status_of(f"/proc/self/fd/{name}") for name in os.listdir(_DESCRIPTORS)]
    mapped = f" {os.path.realpath(path)}\n" in Path("/proc/self/maps").read_text("utf-8")
    if _is_ours(path) and os.path.isfile(path) and (wanted in opened or mapped):
        raise PermissionError(errno.EACCES, "The process cannot access the file", str(path))


@pytest.fixture
def windows() -> Iterator[None]:
    """Replace the functions of the system that differ."""
    system = {name: getattr(os, name) for name in ("open", "fsync")}

    def open_file(path: Any, flags: int, mode: int = 0o777, **more: Any) -> int:
        if _is_ours(path) and os.path.isdir(path):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return system["open"](path, flags, mode, **more)

    def fsync(descriptor: int) -> None:
        flags = Path(f"/proc/self/fdinfo/{descriptor}").read_text(encoding="utf-8")
        if int(flags.split("flags:")[1].split()[0], 8) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        system["fsync"](descriptor)

    def guarded(change: Callable[..., None]) -> Callable[..., None]:
        def run(*paths: Any, **more: Any) -> None:
            for path in paths:
                _refuse_if_open(path)
            change(*paths, **more)

        return run

    with pytest.MonkeyPatch.context() as monkeypatch:
        for name in ("rename", "replace", "unlink", "remove"):
            monkeypatch.setattr(os, name, guarded(getattr(os, name)))
        monkeypatch.setattr(os, "open", open_file)
        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(shutil, "_use_fd_functions", False)
        monkeypatch.setattr(file_locks, "fcntl", None)
        for name in ("pread", "sched_getaffinity"):
            monkeypatch.delattr(os, name)
        monkeypatch.setitem(sys.modules, "resource", None)
        yield


def test_the_simulation_refuses_what_windows_refuses(windows: None, tmp_path: Path):
    path = tmp_path / "file"
    path.write_bytes(b"1")
    with path.open("rb"), pytest.raises(PermissionError):
        path.unlink()
    with path.open("rb"), pytest.raises(PermissionError):
        os.replace(path, tmp_path / "other")
    with pytest.raises(PermissionError):
        os.open(tmp_path, os.O_RDONLY)
    path.unlink()


def test_files_and_folders_are_written_and_nothing_is_left(windows: None, tmp_path: Path):
    for data in (b"first", b"second"):
        atomic.write_bytes(tmp_path / "file", data)
        atomic.write_folder(tmp_path / "folder", {"a.txt": data, "below/b.txt": data})
    assert (tmp_path / "file").read_bytes() == b"second"
    assert (tmp_path / "folder" / "below" / "b.txt").read_bytes() == b"second"
    with atomic.temporary_file(tmp_path / "file") as scratch:
        scratch.write_bytes(b"tried")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
    with atomic.temporary_folder("topoloc-test-windows-") as folder:
        (folder / "file").write_bytes(b"1")
    assert not folder.exists()


def test_files_are_synchronized(windows: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    synchronized, fsync = list[int](), os.fsync

    def count(descriptor: int) -> None:
        fsync(descriptor)
        synchronized.append(descriptor)

    monkeypatch.setattr(os, "fsync", count)
    atomic.write_bytes(tmp_path / "file", b"data")
    assert len(synchronized) == 1


def test_a_reader_that_closes_soon_is_waited_for(windows: None, tmp_path: Path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    reader = path.open("rb")
    closing = threading.Timer(0.1, reader.close)
    closing.start()
    atomic.write_bytes(path, b"new")
    closing.join()
    assert path.read_bytes() == b"new"


def test_a_file_that_stays_open_is_one_line_with_the_remedy(
    windows: None, room_map: Path, tmp_path: Path, complaint: Callable[..., str]
):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    with path.open("rb"):
        said = complaint("georeference", path, "--origin", "48.2,16.37,170,90")
    assert f"cannot write map {path}: another program has it open" in said
    assert "close that program" in said


@pytest.fixture
def edited(windows: None, room_map: Path, tmp_path: Path) -> Iterator[tuple[Path, TopoMetricMap]]:
    """Return a copy of a map, and the same map held open by a reader."""
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    with TopoMetricMap.load(path) as topomap:
        yield path, topomap


def test_maps_are_edited_and_undone_while_a_reader_has_them_open(
    edited: tuple[Path, TopoMetricMap], capsys: pytest.CaptureFixture[str]
):
    path, topomap = edited
    before = path.read_bytes()
    for _ in range(2):
        assert main(["georeference", str(path), "--origin", "48.2,16.37,170,90"]) == 0
    assert main(["info", str(path), "--check"]) == 0
    assert "48.2" in capsys.readouterr().out
    assert topomap.georeference is None
    assert topomap.nodes[0].points_cam.shape[1] == 3, "the reader keeps the map that it opened"
    for _ in range(2):
        assert main(["undo", str(path)]) == 0
    assert path.read_bytes() == before
    assert [one.name for one in path.parent.iterdir()] == ["room.topo"]


def test_an_atlas_is_made_and_changed(
    edited: tuple[Path, TopoMetricMap], queries: Path, tmp_path: Path
):
    path, atlas = edited[0], tmp_path / "atlas"
    assert main(["atlas", "create", str(atlas), str(path)]) == 0
    assert main(["localize", str(atlas), str(queries), "--json", str(tmp_path / "a.jsonl")]) == 0
    assert '"localized": true' in (tmp_path / "a.jsonl").read_text(encoding="utf-8")
    assert main(["georeference", str(atlas), "--tile", "room", "--origin", "48.2,16.37,170,9"]) == 0
    assert main(["atlas", "info", str(atlas), "--check"]) == 0
    assert main(["atlas", "remove", str(atlas), "room"]) == 0
    names = [one.name for one in tmp_path.rglob("*")]
    assert [name for name in names if set(name) & set('<>:"|?*') or name.endswith(".part")] == []


def test_bags_are_read_without_pread(windows: None, tmp_path: Path):
    (tmp_path / "bag").write_bytes(bytes(range(256)))
    bag = ChunkedBytes(tmp_path / "bag")
    assert [bag.read(WHOLE_FILE, start, 2) for start in (200, 3)] == [b"\xc8\xc9", b"\x03\x04"]


def test_the_doctor_counts_processors(windows: None, capsys: pytest.CaptureFixture[str]):
    assert main(["doctor"]) == 0
    assert f"{os.cpu_count()} usable" in capsys.readouterr().out


def test_names_that_a_code_page_lacks_are_printed_with_escapes(tmp_path: Path):
    answer = subprocess.run(
        [sys.executable, "-m", "topoloc", "slam", "--help"],
        env=os.environ | {"PYTHONIOENCODING": "ascii:strict"},
        capture_output=True,
        check=False,
    )
    assert (answer.returncode, answer.stderr) == (0, b"")
    code = (
        "import sys; from topoloc.apps import cli; cli._help = lambda: '\\u5730.topo';"
        " sys.exit(cli.main(['--help']))"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONIOENCODING": "cp1252:strict"},
        capture_output=True,
        check=False,
    )
    assert (answer.returncode, answer.stdout.strip()) == (0, b"\\u5730.topo")


_SERVE = """
import asyncio, sys
def refuse(*_): raise NotImplementedError
asyncio.SelectorEventLoop.add_signal_handler = refuse
from topoloc.apps.cli import main
sys.exit(main(["serve", sys.argv[1], "--port", "0"]))
"""


def test_the_service_starts_and_stops_without_handlers_of_the_loop(room_map: Path):
    served = subprocess.Popen(
        [sys.executable, "-c", _SERVE, str(room_map)], stderr=subprocess.PIPE, text=True
    )
    try:
        assert served.stderr is not None
        line = ""
        for line in served.stderr:
            if "serves on" in line or "Traceback" in line:
                break
        time.sleep(1.0)
        served.send_signal(signal.SIGTERM)
        rest = served.stderr.read()
        assert (served.wait(timeout=60), "Traceback" in line + rest) == (0, False)
    finally:
        served.kill()


def _calls_without_encoding(tree: ast.AST) -> Iterator[int]:
    """Yield the lines of calls that open a text file without an encoding."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and "encoding" not in {one.arg for one in node.keywords}:
            owner, _, name = ast.unparse(node.func).rpartition(".")
            modes = [one.value for one in node.args if isinstance(one, ast.Constant)]
            is_text = any(isinstance(mode, str) and set(mode) <= set("rwaxt+") for mode in modes)
            is_path = owner and len(node.args) < {"read_text": 1, "write_text": 2}.get(name, 0)
            if is_path or (name == "open" and owner != "os" and is_text):
                yield node.lineno


def test_text_files_have_an_encoding():
    folders = ("src", "worlds/src", "training/src", "paper/src")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in files
        for line in _calls_without_encoding(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert len(files) > 300
    assert found == []
