"""Store the data to undo the last edits of a map file: `lab.topo.undo`, beside `lab.topo`.

It is an SQLite database with one entry per edit: the rows that the edit removed or changed, and the
keys of the rows it added. The map does not need it otherwise. Without it, no edit can be undone. An
entry is valid for the file with its digest. If a process is killed between writing the two files,
the next edit drops the invalid entry.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from topoloc.errors import MapError
from topoloc.mapping.map_file import MapFile, check_header
from topoloc.mapping.map_writing import copy_sorted_tables
from topoloc.mapping.schema import (
    SCHEMA_VERSION,
    SORT_COLUMNS,
    TABLES,
    compute_checksum,
    create_table_statement,
)
from topoloc.recordings.atomic import atomic_write, remove_stale_files, temporary_file

_APPLICATION_ID = 0x544F5055  # "TOPU"
_MAX_COLUMNS = 1 + max(len(columns) for columns in TABLES.values())  # with the checksum
_CREATE_ENTRIES = (
    "CREATE TABLE entries (depth INTEGER PRIMARY KEY, before TEXT NOT NULL, after TEXT NOT NULL,"
    " whole BLOB)"
)
_CREATE_OLD_ROWS = (
    "CREATE TABLE old_rows (depth INTEGER, of_table TEXT, is_kept INTEGER, {})".format(
        ", ".join(f"v{k}" for k in range(_MAX_COLUMNS))
    )
)
_MAX_BYTES = 4_000_000_000


@dataclass(frozen=True)
class UndoEntry:
    """Hold one edit that can be undone: from the file of digest `after` to that of `before`."""

    depth: int
    before: str
    after: str


def undo_log_path(path: Path) -> Path:
    """Return the path of a map's undo file."""
    return path.with_name(f"{path.name}.undo")


def find_undo_entries(log_path: Path, digest: str) -> list[UndoEntry]:
    """Return the entries of an undo file that lead back from the map file of this digest, the last
    edit first. Raises MapError."""
    with closing(_open_log(log_path)) as log:
        rows = [
            UndoEntry(*row)
            for row in log.execute(
                "SELECT depth, before, after FROM entries ORDER BY depth DESC"
            ).fetchall()
        ]
    found = list[UndoEntry]()
    for entry in rows:
        if entry.after == digest:
            found.append(entry)
            digest = entry.before
    return found


def add_undo_entry(path: Path, changed: Path) -> None:
    """Add the entry that leads from the file `changed` back to the file at `path`. Entries that do
    not lead there are dropped. Raises MapError, OSError."""
    before, after = (_read_digest(one) for one in (path, changed))
    depth = (
        max((entry.depth for entry in find_undo_entries(undo_log_path(path), before)), default=0)
        + 1
    )
    with _rewrite_log(path) as log:
        _delete_entries(log, depth)
        log.execute("INSERT INTO entries VALUES (?, ?, ?, NULL)", (depth, before, after))
        if check_header(path) == SCHEMA_VERSION:
            _store_changed_rows(log, depth, path, changed)
        if not _restores_previous(
            log, depth, path, changed
        ):  # an older schema, or a file layout of another SQLite version
            log.execute("DELETE FROM old_rows WHERE depth = ?", (depth,))
            log.execute(
                "UPDATE entries SET whole = ? WHERE depth = ?",
                (zlib.compress(path.read_bytes(), 3), depth),
            )


def drop_undo_entries(path: Path, depth: int) -> None:
    """Drop the entries from `depth` on. An empty undo file is removed. Raises MapError, OSError."""
    if depth <= 1:
        undo_log_path(path).unlink(missing_ok=True)
        return
    with _rewrite_log(path) as log:
        _delete_entries(log, depth)


def write_previous_map(path: Path, entry: UndoEntry, target: Path) -> None:
    """Write the map file before an edit to `target`. The file at `path` is the one after it. Raises
    MapError if the log is damaged."""
    try:
        with closing(_open_log(undo_log_path(path))) as log:
            _write_previous(log, entry.depth, path, target)
    except (sqlite3.Error, zlib.error) as error:
        raise MapError(f"{undo_log_path(path)} is damaged: {error}") from error


def _open_log(file: Path) -> sqlite3.Connection:
    """Open an undo file, or an empty one in memory if there is none. Raises MapError."""
    remove_stale_files(file)
    if not file.exists():
        log = sqlite3.connect(":memory:", isolation_level=None)
        log.execute(_CREATE_ENTRIES)
        log.execute(_CREATE_OLD_ROWS)
        return log
    try:
        log = sqlite3.connect(
            f"{file.absolute().as_uri()}?mode=ro&immutable=1", uri=True, isolation_level=None
        )
        with closing(log.execute("SELECT sql FROM sqlite_master LIMIT 10")) as tables:
            found = {sql for (sql,) in tables}
        if (
            found == {_CREATE_ENTRIES, _CREATE_OLD_ROWS}
            and log.execute("PRAGMA application_id").fetchone()[0] == _APPLICATION_ID
        ):
            return log
        log.close()
    except sqlite3.Error:
        pass
    raise MapError(
        f"{file} is not the undo file of a map, or damaged; move it away: the map itself does not"
        " need it"
    )


@contextmanager
def _rewrite_log(path: Path) -> Iterator[sqlite3.Connection]:
    """Yield a copy of the undo file to change. It replaces the undo file at the end."""
    with (
        atomic_write(undo_log_path(path)) as temporary,
        closing(_open_log(undo_log_path(path))) as before,
        closing(sqlite3.connect(temporary, isolation_level=None)) as log,
    ):
        before.backup(log)
        for pragma in (
            "journal_mode = OFF",
            "synchronous = OFF",
            f"application_id = {_APPLICATION_ID}",
        ):
            log.execute(f"PRAGMA {pragma}")
        yield log
        log.execute("VACUUM")


def _delete_entries(log: sqlite3.Connection, depth: int) -> None:
    for table in ("entries", "old_rows"):
        log.execute(f"DELETE FROM {table} WHERE depth >= ?", (depth,))


def _store_changed_rows(log: sqlite3.Connection, depth: int, path: Path, changed: Path) -> None:
    """Store all rows of the old file that are not in the new one, and the keys of the new rows."""
    for name, of in (("old", path), ("new", changed)):
        log.execute(f"ATTACH ? AS {name}", (str(of),))
    log.execute("BEGIN")
    for table, columns in TABLES.items():
        keys = SORT_COLUMNS[table]
        for is_kept, values, of, other in (
            (1, [*columns, "checksum"], "old", "new"),
            (0, keys.split(", "), "new", "old"),
        ):
            selected = ", ".join([*values, *["NULL"] * (_MAX_COLUMNS - len(values))])
            differing = (
                f"SELECT {keys}, checksum FROM {of}.{table} EXCEPT SELECT {keys}, checksum FROM"
                f" {other}.{table}"
            )
            query = (
                f"SELECT ?, ?, ?, {selected} FROM {of}.{table} WHERE ({keys}, checksum) IN"
                f" ({differing}) ORDER BY {keys}"
            )
            log.execute(f"INSERT INTO old_rows {query}", (depth, table, is_kept))
    log.execute("COMMIT")
    for name in ("old", "new"):
        log.execute(f"DETACH {name}")


def _restores_previous(log: sqlite3.Connection, depth: int, path: Path, changed: Path) -> bool:
    """Return whether the stored rows restore a file byte-identical to `path`."""
    if check_header(path) != SCHEMA_VERSION:
        return False
    with temporary_file(undo_log_path(path)) as tried:
        _write_previous(log, depth, changed, tried)
        return tried.read_bytes() == path.read_bytes()


def _write_previous(log: sqlite3.Connection, depth: int, path: Path, target: Path) -> None:
    (whole,) = log.execute("SELECT whole FROM entries WHERE depth = ?", (depth,)).fetchone()
    if whole is not None:
        target.write_bytes(zlib.decompressobj().decompress(whole, _MAX_BYTES))
        return
    with closing(sqlite3.connect("", isolation_level=None)) as database:
        database.execute("PRAGMA journal_mode = OFF")
        database.execute("ATTACH ? AS now", (str(path),))
        database.execute("BEGIN")
        for table, columns in TABLES.items():
            _restore_table(
                database,
                table,
                [*columns, "checksum"],
                lambda *args: _select_old_rows(log, depth, *args),
            )
        database.execute("COMMIT")
        database.execute("DETACH now")
        copy_sorted_tables(database, target)


def _restore_table(
    database: sqlite3.Connection, table: str, columns: list[str], rows_of: Any
) -> None:
    """Restore a table: remove rows added or changed since, and insert the stored rows. Raises
    MapError."""
    keys = SORT_COLUMNS[table].split(", ")
    at = [columns.index(key) for key in keys]
    kept, added = rows_of(table, 1, len(columns)), rows_of(table, 0, len(keys))
    if any(compute_checksum(table, values) != checksum for *values, checksum in kept):
        raise MapError(
            f"the undo file of the map is damaged: a row of {table} is not as it was; the map stays"
            " as it is"
        )
    database.execute(create_table_statement(table))
    database.execute(
        f"CREATE TEMP TABLE gone_{table} ({', '.join(keys)}, PRIMARY KEY ({', '.join(keys)}))"
    )
    gone = f"INSERT OR IGNORE INTO gone_{table} VALUES ({', '.join('?' * len(keys))})"
    database.executemany(gone, [*added, *([row[k] for k in at] for row in kept)])
    left = f"({', '.join(keys)}) NOT IN (SELECT {', '.join(keys)} FROM gone_{table})"
    database.execute(f"INSERT INTO main.{table} SELECT * FROM now.{table} WHERE {left}")
    database.executemany(f"INSERT INTO main.{table} VALUES ({', '.join('?' * len(columns))})", kept)


def _select_old_rows(
    log: sqlite3.Connection, depth: int, table: str, is_kept: int, width: int
) -> list[tuple[Any, ...]]:
    columns = ", ".join(f"v{k}" for k in range(width))
    return log.execute(
        f"SELECT {columns} FROM old_rows WHERE depth = ? AND of_table = ? AND is_kept = ?",
        (depth, table, is_kept),
    ).fetchall()


def _read_digest(path: Path) -> str:
    with closing(MapFile(path)) as file:
        return file.digest
