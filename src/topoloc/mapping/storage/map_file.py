"""Open a map file and read validated rows of its tables.

The file is untrusted. Its tables must match the schema exactly, so that no view, trigger or virtual
table runs. The lengths of a row are checked before its bytes are read. Types and checksum are
checked after. SQLite runs with limits of work and size.
"""

from __future__ import annotations

import sqlite3
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

from topoloc.errors import (
    CalibrationError,
    ConfigError,
    FeatureTypeError,
    GeoreferenceError,
    MapError,
)
from topoloc.json_data import Count, decode_json
from topoloc.mapping.forks import fork_safe
from topoloc.mapping.storage.schema import (
    SCHEMA_1,
    SORT_COLUMNS,
    TABLES,
    VIRTUAL_PREFIX,
    compute_checksum,
    create_table_statement,
    schema_2_views,
)
from topoloc.mapping.validation import (
    CorruptDataError,
    check_header,
    describe_failure,
    sqlite_failures_as_os_errors,
)
from topoloc.recordings.atomic import has_locks

MAX_STEPS = 50_000_000
"""Limit of SQLite's steps in one read. A table of MAX_ROWS rows takes a quarter of them."""
MAX_ROWS = 1_000_000
MAX_BYTES = 50_000_000
MAX_ARRAYS_BYTES = 800_000_000
"""Limits of one value in bytes. MAX_BYTES holds for an image, a node's points or a text.
MAX_ARRAYS_BYTES holds for a coarse localizer's arrays (the whole VGG-11 has 258 MB)."""
_PYTHON_TYPES = {"INTEGER": int, "TEXT": str, "BLOB": bytes}
_LIMITS = {
    sqlite3.SQLITE_LIMIT_LENGTH: MAX_ARRAYS_BYTES + 1_000_000,
    sqlite3.SQLITE_LIMIT_SQL_LENGTH: 20_000,
    sqlite3.SQLITE_LIMIT_EXPR_DEPTH: 20,
    sqlite3.SQLITE_LIMIT_COMPOUND_SELECT: 3,
    sqlite3.SQLITE_LIMIT_VDBE_OP: 10_000,
    sqlite3.SQLITE_LIMIT_ATTACHED: 0,
    sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH: 1,
}


def _connect(path: Path) -> sqlite3.Connection:
    """Open a map. It is never changed in place: SQLite needs no locks, and read-only media do."""
    address = f"{path.absolute().as_uri()}?mode=ro&immutable=1" if has_locks() else ":memory:"
    database = sqlite3.connect(address, uri=True, check_same_thread=False, isolation_level=None)
    if not has_locks():  # a file that is open could not be replaced
        database.deserialize(path.read_bytes())
    return database


class MapFile:
    """Hold an open map database. A lock allows one reader at a time, because several threads may
    read.

    The content stays the same if another file is renamed over it.

    Raises:
        MapError: the file is missing, not a topoloc map, truncated, has unexpected tables, or
            another digest than the given one.
        MapVersionError: the schema is unknown to this version.
    """

    def __init__(self, path: Path, digest: str | None = None) -> None:
        self.path = path
        self._lock = fork_safe(threading.RLock())
        self._calls_left, self._database = 0, None
        self._counts: dict[str, int] = {}
        self._cache: dict[str, Any] = {}
        self.version = check_header(path)
        with self._guarded_read():
            self._database = _connect(path)
            for category, limit in _LIMITS.items():
                self._database.setlimit(category, limit)
            self._database.set_progress_handler(self._is_too_much, MAX_STEPS // 10)
        try:
            with self.read_connection() as database:
                for pragma in (
                    "trusted_schema = OFF",
                    "cell_size_check = ON",
                    "mmap_size = 0",
                    "temp_store = MEMORY",
                ):
                    database.execute(f"PRAGMA {pragma}")
                tables = self._check_tables(database)
                if self.version == 1:
                    database.executescript(schema_2_views(f"{VIRTUAL_PREFIX}nodes" in tables))
                self.facts: dict[str, str] = {row["key"]: row["value"] for row in self.rows("map")}
                if self.version > 1:
                    self._counts = decode_json(
                        self.facts.get("counts"), dict[str, Count], CorruptDataError, "counts"
                    )
                    if self._counts.keys() != TABLES.keys() - {"map"}:
                        raise CorruptDataError("the numbers of rows are missing")
                if digest is not None and self.digest != digest:
                    raise MapError(
                        f"map {path} is not the one that was pickled: it was replaced since"
                    )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file. Every later read raises MapError."""
        with self._lock:
            if self._database is not None:
                self._database.close()
            self._database = None

    def __reduce__(self) -> Any:
        return MapFile, (self.path.absolute(), self.digest)

    @contextmanager
    def read_connection(self) -> Iterator[sqlite3.Connection]:
        """Yield the database for one read. Errors of the file become MapError, programming errors
        do not."""
        with self._guarded_read():
            if self._database is None:
                raise MapError(f"map {self.path} is closed")
            self._calls_left = 10
            yield self._database

    def _is_too_much(self) -> bool:
        """Return whether a read takes more than MAX_STEPS. SQLite calls it after a tenth of
        them."""
        self._calls_left -= 1
        return self._calls_left < 0

    @contextmanager
    def _guarded_read(self) -> Iterator[None]:
        try:
            with self._lock, sqlite_failures_as_os_errors():
                yield
        except OSError as error:  # the file may be undamaged
            raise MapError(f"cannot read map {self.path}: {describe_failure(error)}") from error
        except FeatureTypeError as error:  # the type of an extension, not registered here
            raise MapError(f"map {self.path}: {error}") from error
        except (sqlite3.ProgrammingError, sqlite3.InterfaceError):  # a programming error
            raise
        except (
            sqlite3.Error,
            UnicodeDecodeError,  # SQLite's message quotes damaged text
            zlib.error,
            CorruptDataError,
            ConfigError,
            CalibrationError,
            GeoreferenceError,
        ) as error:
            fault = " ".join(str(error).split())[:300]
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_INTERRUPT:
                fault = f"a read takes more than {MAX_STEPS} steps, which no map needs"
            raise MapError(f"map {self.path} is damaged: {fault}") from error

    def rows(self, table: str, columns: Sequence[str] | None = None) -> list[dict[str, Any]]:
        """Return all rows of a table with small rows, in its order. With `columns`, only these
        columns are read, without checking the checksum."""
        shown, order = ", ".join(columns or (*TABLES[table], "checksum")), SORT_COLUMNS[table]
        with self.read_connection() as database:
            query = f"SELECT {shown} FROM {table} ORDER BY {order} LIMIT {MAX_ROWS + 1}"
            found = database.execute(query).fetchall()
            expected = min(self._counts.get(table, len(found)), MAX_ROWS)
            if len(found) != expected:
                raise CorruptDataError(f"table {table} has {len(found)} rows, not {expected}")
            if columns is not None:
                return [_check_types(table, columns, row) for row in found]
            return [self._verify_checksum(table, row) for row in found]

    def find(self, table: str, **key: int | str) -> list[dict[str, Any]]:
        """Return the rows with these values, in the order of the table. Their lengths are checked
        before they are read, their checksums after."""
        names = TABLES[table]
        query = f"FROM {table} WHERE {' AND '.join(f'{name} = ?' for name in key)}"
        query += f" ORDER BY {SORT_COLUMNS[table]} LIMIT {MAX_ROWS}"
        with self.read_connection() as database:
            lengths = f"SELECT {', '.join(f'length({name})' for name in names)} {query}"
            for row in database.execute(lengths, tuple(key.values())):
                for name, length in zip(names, row, strict=True):
                    limit = MAX_ARRAYS_BYTES if name == "arrays" else MAX_BYTES
                    if length is None or length > limit:
                        raise CorruptDataError(f"{table}.{name} is empty or too large")
            rows = f"SELECT {', '.join(names)}, checksum {query}"
            found = database.execute(rows, tuple(key.values()))
            return [self._verify_checksum(table, row) for row in found]

    def row(self, table: str, what: str, **key: int | str) -> dict[str, Any]:
        """Return the row with this key, as `find` does. If it is missing, the error names
        `what`."""
        found = self.find(table, **key)
        if not found:
            raise CorruptDataError(f"{what} is missing")
        return found[0]

    def checksums(self, table: str) -> list[bytes]:
        """Return the checksums of all rows of a table in order, without the row of the digest."""
        with self.read_connection() as database:
            where = " WHERE key != 'digest'" if table == "map" else ""
            found = database.execute(
                f"SELECT checksum FROM {table}{where} ORDER BY {SORT_COLUMNS[table]} LIMIT"
                f" {MAX_ROWS}"
            ).fetchall()
            if not all(type(checksum) is bytes for (checksum,) in found):
                raise CorruptDataError(f"a checksum of {table} is missing")
            return [checksum for (checksum,) in found]

    def cached(self, name: str, make: Callable[[], Any]) -> Any:
        """Return the value of `make` from its first call under this name. It shares the lock of
        reading, because two locks could deadlock."""
        with self._lock:
            if name not in self._cache:
                self._cache[name] = make()
            return self._cache[name]

    def count(self, table: str) -> int:
        """Return the number of rows of a table as stored in the file. Schema 1 stores none, so its
        rows are counted."""
        if table in self._counts:
            return self._counts[table]
        with self.read_connection() as database:
            return int(database.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])

    @property
    def digest(self) -> str:
        """Return the digest that identifies the content of the map."""
        if self.version == 1:
            return blake2b(self.path.read_bytes(), digest_size=16).hexdigest()
        if "digest" not in self.facts:
            raise MapError(f"map {self.path} is damaged: the digest is missing")
        return self.facts["digest"]

    def _verify_checksum(self, table: str, row: tuple[Any, ...]) -> dict[str, Any]:
        *values, checksum = row
        typed = _check_types(table, TABLES[table], values)
        if self.version > 1 and checksum != compute_checksum(table, values):
            names = SORT_COLUMNS[table].split(", ")
            key = ", ".join(f"{name} {str(typed[name])[:40]}" for name in names)
            raise CorruptDataError(f"the checksum of a row of {table} is wrong ({key})")
        return typed

    def _check_tables(self, database: sqlite3.Connection) -> set[str]:
        """Check that the file has exactly the tables of its schema and nothing else that SQLite
        would run. Return their names."""
        wanted = (
            SCHEMA_1
            if self.version == 1
            else {table: create_table_statement(table) for table in TABLES}
        )
        entries = database.execute(
            "SELECT type, name, tbl_name, sql FROM sqlite_master LIMIT 100"
        ).fetchall()
        found = set()
        for kind, name, of_table, sql in entries:
            is_key = kind == "index" and sql is None and str(name).startswith("sqlite_autoindex_")
            if is_key and of_table in wanted:
                continue
            if kind != "table" or name not in wanted or sql != wanted[name]:
                raise CorruptDataError(
                    f"{str(kind)[:20]} {str(name)[:60]!r} is none of a map of schema {self.version}"
                )
            found.add(name)
        optional = {name for name in wanted if name.startswith(VIRTUAL_PREFIX)}
        if self.version > 1 or found & optional:
            optional = set()
        if missing := wanted.keys() - found - optional:
            raise CorruptDataError(f"table {min(missing)} is missing")
        return found


def _check_types(table: str, names: Iterable[str], row: Sequence[Any]) -> dict[str, Any]:
    typed = dict(zip(names, row, strict=True))
    for name, value in typed.items():
        declared = TABLES[table][name].split()[0]
        if type(value) is not _PYTHON_TYPES[declared]:
            raise CorruptDataError(f"{table}.{name} is no {declared.lower()} in one row")
    return typed
