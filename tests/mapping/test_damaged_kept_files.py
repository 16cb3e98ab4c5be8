"""Damage a map or its kept files in any way: a command succeeds, or it ends with one error and the
map file stays byte-identical."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
import warnings
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import example, given, settings, strategies as st
from mutations import forge

from topoloc.errors import TopolocError
from topoloc.mapping.edit import edit_map, read_history, undo_edit
from topoloc.mapping.storage.kept_files import find_kept_files
from topoloc.mapping.storage.schema import TABLES

FIXTURE = Path(__file__).parents[1] / "fixtures" / "aea690a" / "pruned.topo"
NUM_EDITS = 3


@dataclass(frozen=True)
class Sql:
    """Run one statement on a table, with values. If `is_forged`, make all checksums
    right afterwards."""

    statement: str
    values: tuple[object, ...]
    is_forged: bool

    def damage(self, path: Path) -> None:
        """Run the statement on an SQLite file. A refused one changes nothing."""
        with (
            suppress(sqlite3.Error, OverflowError, TypeError, ValueError),
            closing(sqlite3.connect(path, isolation_level=None)) as database,
        ):
            database.execute(self.statement, self.values)
            if self.is_forged:
                forge(database)


@dataclass(frozen=True)
class Bytes:
    """Replace the bytes from `start` to `end`, given as shares of the file."""

    start: float
    end: float
    data: bytes

    def damage(self, path: Path) -> None:
        """Replace the bytes of a file."""
        old = path.read_bytes()
        start, end = (int(share * len(old)) for share in sorted((self.start, self.end)))
        path.write_bytes(old[:start] + self.data + old[end:])


@dataclass(frozen=True)
class Node:
    """Replace a file by nothing, a folder, or a link to itself or to the map."""

    kind: str

    def damage(self, path: Path) -> None:
        """Replace a file."""
        path.unlink()
        if self.kind == "folder":
            path.mkdir()
        elif self.kind != "nothing":
            path.symlink_to(path if self.kind == "loop" else path.with_name("map.topo"))


VALUES = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.text(max_size=40),
    st.binary(max_size=200),
    st.sampled_from(["{}", "[]", "null", "NaN", "[" * 10_000, "1e999"]),
)


@st.composite
def sql(draw: st.DrawFn) -> Sql:
    """Draw a statement that changes a column, deletes rows, or alters a table."""
    table = draw(st.sampled_from(list(TABLES)))
    column = draw(st.sampled_from([*TABLES[table], "checksum"]))
    row = draw(st.sampled_from(["", f" WHERE rowid = (SELECT max(rowid) FROM {table})"]))
    statement = draw(
        st.sampled_from(
            [
                f"UPDATE OR IGNORE {table} SET {column} = ?{row}",
                f"UPDATE {table} SET {column} = substr({column}, 2){row}",
                f"DELETE FROM {table}{row}",
                f"DROP TABLE {table}",
                f"ALTER TABLE {table} ADD COLUMN more INTEGER",
                f"PRAGMA user_version = {draw(st.integers(0, 9))}",
            ]
        )
    )
    values = (draw(VALUES),) if "?" in statement else ()
    return Sql(statement, values, draw(st.booleans()))


SHARES = st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0)
BYTES = st.builds(Bytes, SHARES, SHARES, st.binary(max_size=64))
NODES = st.builds(Node, st.sampled_from(["nothing", "folder", "loop", "map"]))
# 0 is the map, 1 the file that `undo` would restore
DAMAGES = st.lists(
    st.tuples(st.integers(1, NUM_EDITS), sql() | BYTES | NODES)
    | st.tuples(st.just(0), sql() | BYTES),
    min_size=1,
    max_size=3,
)


def _undo(path: Path) -> None:
    undo_edit(path)


def _history(path: Path) -> None:
    read_history(path)


def _edit(path: Path) -> None:
    with edit_map(path) as edit:
        edit.commit(edit.topomap, "another edit")


COMMANDS = {"undo": _undo, "history": _history, "edit": _edit}


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of an edited map and its kept files."""
    path = Path(shutil.copy(FIXTURE, tmp_path_factory.mktemp("edited") / "map.topo"))
    for k in range(NUM_EDITS):
        with edit_map(path) as edit:
            edit.commit(edit.topomap, f"edit {k}")
    assert len(find_kept_files(path)) == NUM_EDITS
    return path.parent


@settings(max_examples=60)
@given(
    damages=DAMAGES,
    commands=st.lists(st.sampled_from(list(COMMANDS)), min_size=1, max_size=5),
)
# SQLite's error quotes text that is no UTF-8
@example(damages=[(0, Bytes(0.971954510943523, 0.971954510943523, b"\x80"))], commands=["undo"])
def test_a_command_succeeds_or_leaves_the_map_as_it_is(
    edited: Path, damages: list[tuple[int, Sql | Bytes | Node]], commands: list[str]
):
    with TemporaryDirectory() as folder:
        path = Path(shutil.copytree(edited, folder, dirs_exist_ok=True)) / "map.topo"
        files = [path, *find_kept_files(path)]
        for row, damage in damages:
            with suppress(OSError):  # a folder or a link is there already
                damage.damage(files[row])
        for name in commands:
            _check(COMMANDS[name], path, name)


def _check(command: Callable[[Path], None], path: Path, name: str) -> None:
    """Run a command on a map and check the map afterwards."""
    before = path.read_bytes()
    kept = {_short_digest(one): one.read_bytes() for one in _kept_regular_files(path)}
    error = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            command(path)
        except TopolocError as raised:
            error = str(raised)
    after = path.read_bytes()
    assert not [one for one in path.parent.iterdir() if one.name.endswith(".part")]
    if error is not None:
        assert len(error.splitlines()) == 1
        assert after == before
    elif name == "history":
        assert after == before
    elif name == "undo":
        restored = hashlib.sha256(after).hexdigest()[:16]
        assert kept[restored] == after
    else:
        newest, *_ = find_kept_files(path)
        assert newest.read_bytes() == before


def _kept_regular_files(path: Path) -> list[Path]:
    return [one for one in path.parent.glob("map.topo.undo-*") if one.is_file()]


def _short_digest(path: Path) -> str:
    return path.name[-16:]
