"""Check that files are complete or absent with parallel writers, and if a writer is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from topoloc.errors import TopolocError
from topoloc.recordings.atomic import (
    atomic_write,
    remove_all_stale_files,
    remove_stale_files,
    temporary_file,
    write_bytes,
    write_folder,
)

WRITER = """
import sys
from pathlib import Path
from topoloc.recordings import atomic
with getattr(atomic, sys.argv[2])(Path(sys.argv[1])) as temporary:
    temporary.write_bytes(b"half")
    print(temporary.name, flush=True)
    sys.stdin.readline()
"""
WRITERS = """
import sys
from pathlib import Path
from topoloc.recordings.atomic import write_bytes
for number in range(100):
    write_bytes(Path(sys.argv[1]), bytes([number]) * 100_000)
"""


def is_whole(data: bytes) -> bool:
    return len(data) == 100_000 and len(set(data)) == 1


def test_threads_and_processes_that_write_one_file_leave_a_whole_one(tmp_path: Path):
    path = tmp_path / "file"
    children = [subprocess.Popen([sys.executable, "-c", WRITERS, str(path)]) for _ in range(2)]
    failures: list[BaseException] = []

    def write(letter: int) -> None:
        try:
            for _ in range(100):
                write_bytes(path, bytes([letter]) * 100_000)
                assert is_whole(path.read_bytes())
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in (200, 201)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [child.wait() for child in children] == [0, 0]
    assert failures == []
    assert is_whole(path.read_bytes())
    assert list(tmp_path.iterdir()) == [path]


def begun(path: Path, by: str = "atomic_write") -> tuple[subprocess.Popen[str], Path]:
    """Start a process that stops in the middle of a write, and return it with its
    temporary file."""
    child = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), by],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    return child, path.parent / child.stdout.readline().strip()


def test_files_of_killed_writers_are_removed_and_files_of_living_ones_stay(tmp_path: Path):
    path = tmp_path / "map.topo"
    (killed, left), (living, held) = begun(path), begun(path)
    left.with_name(left.name + "-journal").write_bytes(b"of SQLite")
    other = tmp_path / ".other.topo.0123456789abcdef.part"
    other.write_bytes(b"of another output")
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert left.is_file()
    write_bytes(path, b"new")
    assert sorted(tmp_path.iterdir()) == sorted([path, held, other])
    living.communicate("\n")
    assert path.read_bytes() == b"half"
    assert sorted(tmp_path.iterdir()) == sorted([path, other])


def test_a_scratch_file_is_its_own_while_it_is_used(tmp_path: Path):
    left = tmp_path / ".scratch.0123456789abcdef.part"
    left.write_bytes(b"of somebody who was killed")
    with temporary_file(tmp_path / "scratch") as one:
        one.write_bytes(b"one")
        with temporary_file(tmp_path / "scratch") as two:
            assert sorted(tmp_path.iterdir()) == sorted([one, two])
        assert one.read_bytes() == b"one"
    with pytest.raises(KeyError), temporary_file(tmp_path / "scratch"):
        raise KeyError
    assert list(tmp_path.iterdir()) == []


def test_abandoned_files_are_removed_from_a_folder(tmp_path: Path):
    (tmp_path / ".a.topo.0123456789abcdef.part").write_bytes(b"")
    kept = [tmp_path / ".hidden", tmp_path / "b.part"]
    for path in kept:
        path.write_bytes(b"")
    with atomic_write(tmp_path / "c.topo") as held:
        remove_all_stale_files(tmp_path)
        assert sorted(tmp_path.iterdir()) == sorted([*kept, held])
    remove_all_stale_files(tmp_path / "nowhere")


def test_leftovers_of_older_versions_go_too(tmp_path: Path):
    (tmp_path / ".map.topo.1234.part").write_bytes(b"")
    (tmp_path / ".map.topo.1234.part-journal").write_bytes(b"")
    remove_stale_files(tmp_path / "map.topo")
    assert list(tmp_path.iterdir()) == []


def test_temporary_files_of_killed_processes_are_removed(tmp_path: Path):
    path = tmp_path / "map.topo"
    write_bytes(path, b"old")
    with temporary_file(path) as scratch:
        scratch.write_bytes(b"tried")
        write_bytes(path, b"new")
        assert scratch.read_bytes() == b"tried", "a living process's stays"
    assert list(tmp_path.iterdir()) == [path]
    killed, left = begun(path, "temporary_file")
    os.kill(killed.pid, signal.SIGKILL)
    killed.wait()
    assert left.is_file()
    write_bytes(path, b"newer")
    assert list(tmp_path.iterdir()) == [path]


def write_half(path: Path) -> None:
    with atomic_write(path) as temporary:
        temporary.write_bytes(b"half")
        raise ValueError("stop")


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path):
    path = tmp_path / "file"
    write_bytes(path, b"old")
    with pytest.raises(ValueError, match="stop"):
        write_half(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_places_that_cannot_be_written_are_errors_of_one_line(tmp_path: Path):
    for path in (tmp_path / "missing" / "file", tmp_path / ("x" * 300), tmp_path):
        with pytest.raises(TopolocError, match="cannot write") as caught:
            write_bytes(path, b"")
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_name_as_long_as_a_file_system_takes_can_be_written(tmp_path: Path):
    write_bytes(tmp_path / ("x" * 250), b"data")
    assert (tmp_path / ("x" * 250)).read_bytes() == b"data"


def test_a_symbolic_link_is_followed(tmp_path: Path):
    (tmp_path / "far").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "far" / "file")
    for content in (b"first", b"second"):
        write_bytes(link, content)
        assert link.is_symlink()
        assert (tmp_path / "far" / "file").read_bytes() == content
    assert [path.name for path in (tmp_path / "far").iterdir()] == ["file"]


def test_a_folder_is_written_whole_or_not_at_all(tmp_path: Path):
    folder = tmp_path / "model"
    write_folder(folder, {"a.txt": b"1", "images/b.jpg": b"2"})
    with pytest.raises(TopolocError, match="cannot write"):
        write_folder(folder, {"a.txt": b"3", "a.txt/b": b"4"})  # a file cannot be a folder
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*")} == {
        "a.txt",
        "images",
        "images/b.jpg",
    }
    assert (folder / "a.txt").read_bytes() == b"1"
    (folder / "images" / "mine.jpg").write_bytes(b"5")
    with pytest.raises(TopolocError, match=r"other things, such as images/mine\.jpg"):
        write_folder(folder, {"a.txt": b"6", "images/b.jpg": b"7"})
    assert (folder / "images" / "mine.jpg").read_bytes() == b"5"
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
