"""Make malicious map files by seeded changes of SQL values and arrays, with or without
right checksums."""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np

from topoloc.mapping.storage.map_writing import compute_map_digest
from topoloc.mapping.storage.point_encoding import compress_array
from topoloc.mapping.storage.schema import SORT_COLUMNS, TABLES, compute_checksum

Rng = np.random.Generator
POINTS = {
    "points_img": ("<f4", 2),
    "shapes": ("<f4", 3),
    "descriptors": ("i1", 64),
    "points_cam": ("<f4", 3),
    "sqrt_covs": ("<f2", 6),
}
NUMBERS = [-1, 0, 1, 2, 7, 255, 4096, 10**6, 2**31 - 1, 2**31, 2**53, 2**63 - 1, -(2**63)]
TEXTS = [
    "",
    "{",
    "{}",
    "[]",
    "null",
    "NaN",
    "1e999",
    "x" * 5000,
    "[" * 100_000,
    '{"a":' * 5000,
    "\0",
    "surf",
    "sift",
    "orb",
    '"cnn-fc"',
    "ä\n\x1b[31m",
]
SCRIPTS = [
    (
        "CREATE VIEW extra AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
        " SELECT x FROM c"
    ),
    (
        "ALTER TABLE nodes RENAME TO hidden; CREATE VIEW nodes AS WITH RECURSIVE c(x) AS (SELECT 1"
        " UNION ALL SELECT x + 1 FROM c) SELECT x AS node_id, 0 AS session_id, '' AS name, 0 AS"
        " t_ns, 1 AS camera_id, x'' AS world_from_cam, 0 AS num_points, x'' AS checksum FROM c"
    ),
    (
        "ALTER TABLE edges RENAME TO hidden; CREATE VIEW edges AS WITH RECURSIVE c(x) AS (SELECT 1"
        " UNION ALL SELECT x + 1 FROM c) SELECT x AS source_id, x AS target_id, x'' AS checksum"
        " FROM c"
    ),
    "CREATE TRIGGER t AFTER INSERT ON map BEGIN DELETE FROM map; END",
    "CREATE VIRTUAL TABLE v USING fts5(a)",
    "ALTER TABLE nodes ADD COLUMN more INTEGER",
    "CREATE INDEX extra ON nodes (name)",
    "ALTER TABLE map RENAME COLUMN value TO worth",
    "DROP TABLE coarse_models",
    "PRAGMA user_version = 1",
    "PRAGMA user_version = 2",
    "PRAGMA user_version = 4",
    "PRAGMA journal_mode = WAL",
]


def mutate(source: Path, target: Path, seed: int) -> str:
    """Write a changed copy of a map and return a description of the change. Equal seeds make
    equal changes."""
    rng = np.random.default_rng(seed)
    shutil.copyfile(source, target)
    if rng.random() < 0.1:
        return _flip(target, rng)
    with closing(sqlite3.connect(target, isolation_level=None)) as database:
        database.text_factory = _text_of
        # SQLite's own random numbers have no seed
        database.create_function("random", 0, lambda: int(rng.integers(2**62)))
        database.create_function("randomblob", 1, lambda n: rng.bytes(max(n, 0)))
        if rng.random() < 0.08:
            script = SCRIPTS[rng.integers(len(SCRIPTS))]
            try:
                database.executescript(script)
            except sqlite3.Error as error:  # this SQLite lacks a feature
                return f"not possible: {error}"
            return script
        done = [_KINDS[rng.integers(len(_KINDS))](database, rng) for _ in range(rng.integers(1, 3))]
        if rng.random() < 0.8:
            forge(database)
    return "; ".join(done)


def forge(database: sqlite3.Connection) -> None:
    """Set all checksums, counts and the digest to match the changed data."""
    database.text_factory = _text_of
    counts = {
        table: database.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
        for table in TABLES
        if table != "map"
    }
    database.execute(
        "UPDATE map SET value = ? WHERE key = 'counts'", (str(counts).replace("'", '"'),)
    )
    found: dict[str, list[bytes]] = {}
    for table, columns in TABLES.items():
        rows = database.execute(
            f"SELECT rowid, {', '.join(columns)} FROM {table} ORDER BY {SORT_COLUMNS[table]}"
        ).fetchall()
        found[table] = [
            compute_checksum(table, row[1:]) for row in rows if table != "map" or row[1] != "digest"
        ]
        for row in rows:
            database.execute(
                f"UPDATE {table} SET checksum = ? WHERE rowid = ?",
                (compute_checksum(table, row[1:]), row[0]),
            )
    digest = compute_map_digest(found)
    database.execute(
        "UPDATE map SET value = ?, checksum = ? WHERE key = 'digest'",
        (digest, compute_checksum("map", ("digest", digest))),
    )


def _text_of(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")


def _flip(path: Path, rng: Rng) -> str:
    content = bytearray(path.read_bytes())
    for place in rng.integers(0, len(content), rng.integers(1, 4)):
        content[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(content)
    return "bits flipped"


def _value(database: sqlite3.Connection, rng: Rng) -> str:
    """Set another value, of any type, in one column of one row or of all."""
    table, column = _column(rng, lambda name: True)
    value = _any_value(rng)
    where = (
        ""
        if rng.random() < 0.3
        else f"WHERE rowid IN (SELECT rowid FROM {table} ORDER BY random() LIMIT 1)"
    )
    _try(database, f"UPDATE OR IGNORE {table} SET {column} = ? {where}", value)
    return f"{table}.{column} = {str(value)[:30]!r}"


def _resized(database: sqlite3.Connection, rng: Rng) -> str:
    table, column = _column(rng, lambda declared: declared.startswith("BLOB"))
    how = [
        "substr(X, 1, length(X) / 2)",
        "X || X",
        "x''",
        "substr(X, 2)",
        "X || zeroblob(3000000)",
        "randomblob(length(X))",
        "zeroblob(length(X))",
    ]
    change = how[rng.integers(len(how))].replace("X", column)
    _try(database, f"UPDATE {table} SET {column} = {change}")
    return f"{table}.{column} = {change}"


def _floats(database: sqlite3.Connection, rng: Rng) -> str:
    """Set a number within a blob: not finite, huge, tiny or negative."""
    table, column = _column(rng, lambda declared: declared.startswith("BLOB"))
    row = database.execute(
        f"SELECT rowid, {column} FROM {table} ORDER BY random() LIMIT 1"
    ).fetchone()
    if row is None or not isinstance(row[1], bytes) or len(row[1]) < 8:
        return "nothing"
    value = [np.nan, np.inf, -1e30, 1e6, 1e-30, -1.0, 0.0][rng.integers(7)]
    if column in POINTS and rng.random() < 0.8:
        dtype, width = POINTS[column]
        with suppress(zlib.error, ValueError), np.errstate(over="ignore", invalid="ignore"):
            planes = np.frombuffer(zlib.decompress(row[1]), np.uint8).reshape(
                width, np.dtype(dtype).itemsize, -1
            )
            array = (
                np.frombuffer(planes.transpose(2, 0, 1).tobytes(), dtype).reshape(-1, width).copy()
            )
            array[rng.integers(len(array)), rng.integers(width)] = np.array(value).astype(dtype)
            _try(
                database,
                f"UPDATE {table} SET {column} = ? WHERE rowid = ?",
                compress_array(array),
                row[0],
            )
            return f"a number {value} packed in {table}.{column}"
    data = struct.pack("<f", value) if rng.random() < 0.5 else struct.pack("<d", value)
    place = int(rng.integers(0, len(row[1]) // 8)) * 8
    changed = bytearray(row[1])
    changed[place : place + len(data)] = data
    _try(
        database,
        f"UPDATE {table} SET {column} = ? WHERE rowid = ?",
        bytes(changed[: len(row[1])]),
        row[0],
    )
    return f"a number {value} in {table}.{column}"


def _deleted(database: sqlite3.Connection, rng: Rng) -> str:
    table = list(TABLES)[rng.integers(len(TABLES))]
    _try(
        database,
        f"DELETE FROM {table} WHERE rowid IN (SELECT rowid FROM {table} ORDER BY random() LIMIT"
        f" {rng.integers(1, 4)})",
    )
    return f"rows of {table} deleted"


def _agreed(database: sqlite3.Connection, rng: Rng) -> str:
    """Change sizes of points and descriptors together, so that they match only each other."""
    prefix = "side_" if rng.random() < 0.3 else ""
    size = int(rng.choice([0, 1, 2, 63, 65, 128]))
    is_one = rng.random() < 0.5
    if is_one:
        _try(database, f"UPDATE {prefix}nodes SET num_points = 1")
    for rowid, num_points in database.execute(
        f"SELECT rowid, num_points FROM {prefix}node_points"
    ).fetchall():
        n = (
            1
            if is_one or not isinstance(num_points, int) or not 0 <= num_points <= 1000
            else num_points
        )
        shapes = {
            name: (dtype, size if name == "descriptors" else width)
            for name, (dtype, width) in POINTS.items()
        }
        blobs = [compress_array(np.ones((n, width), dtype)) for dtype, width in shapes.values()]
        changes = ", ".join(f"{name} = ?" for name in shapes)
        statement = (
            f"UPDATE {prefix}node_points SET descriptor_size = ?, num_points = ?, {changes} WHERE"
            " rowid = ?"
        )
        _try(database, statement, size, n, *blobs, rowid)
    return f"{prefix}descriptors of size {size}"


def _arrays(database: sqlite3.Connection, rng: Rng) -> str:
    """Change shape, type or content of a coarse localizer's array, in a valid archive."""
    table = "side_coarse_models" if rng.random() < 0.4 else "coarse_models"
    row = database.execute(f"SELECT rowid, arrays FROM {table} LIMIT 1").fetchone()
    if row is None or not isinstance(row[1], bytes):
        return "nothing"
    try:
        with np.load(io.BytesIO(row[1])) as loaded:
            arrays = dict(loaded)
    except Exception:  # changed before
        return "nothing"
    name = list(arrays)[rng.integers(len(arrays))]
    changes: list[Callable[[np.ndarray], np.ndarray]] = [
        lambda a: a[: len(a) // 2],
        lambda a: a[..., : max(a.shape[-1] // 2, 1)],
        lambda a: np.concatenate([a, a]),
        lambda a: a.astype(np.int64),
        lambda a: a.astype(np.float64) * 1e30,
        lambda a: np.full(a.shape, np.nan if a.dtype.kind == "f" else -5).astype(a.dtype),
        lambda a: a.reshape(-1),
        lambda a: np.zeros((0, *a.shape[1:]), a.dtype),
        lambda a: np.asfortranarray(a),
        lambda a: a.astype("U4"),
        lambda a: np.zeros(()),
        lambda a: (a.astype(np.float64) + 10**6).astype(np.float32),
    ]
    number = int(rng.integers(len(changes) + 1))
    if number == len(changes):
        del arrays[name]
    else:
        arrays[name] = changes[number](np.atleast_1d(arrays[name]))  # it may be changed already
    buffer = io.BytesIO()
    (np.savez_compressed if rng.random() < 0.1 else np.savez)(buffer, **arrays)
    _try(database, f"UPDATE {table} SET arrays = ? WHERE rowid = ?", buffer.getvalue(), row[0])
    return f"{table}: {name} changed ({number})"


def _archive(database: sqlite3.Connection, rng: Rng) -> str:
    """Write an archive or an array header that misstates its content."""
    headers = [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000,)}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
    ]
    headers += [
        "(" * 500,
        "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, -8)}",
        "{}",
        "1" * 9000,
    ]
    header = headers[rng.integers(len(headers))].encode()
    npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header + b"\n" + bytes(32)
    buffer = io.BytesIO()
    kind = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA][rng.integers(3)]
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        archive.writestr("words.npy", npy)
        if rng.random() < 0.3:
            archive.writestr("mean.npy", bytes(50_000_000))
    _try(database, "UPDATE coarse_models SET arrays = ?", buffer.getvalue())
    return f"an archive of {header[:40]!r}, compression {kind}"


def _config(database: sqlite3.Connection, rng: Rng) -> str:
    old, new = [
        ('"kind": "surf"', '"kind": "orb"'),
        ('"kind": "surf"', '"kind": "sift"'),
        ('"max_features": 1000', '"max_features": -1'),
        ('"max_features": 1000', '"max_features": "many"'),
        ('"d_thresh": ', '"d_thresh": -'),
        ('"d_thresh": ', '"d_thresh": 1e400, "x": '),
        ('"lambda_rot": ', '"lambda_rot": null, "y": '),
        ('"version": 1', '"version": 2'),
        ('"vlad": {', '"vlad": {"unknown": 1, '),
        ('"normalization": "wide"', '"normalization": "paper"'),
    ][rng.integers(10)]
    _try(database, "UPDATE map SET value = replace(value, ?, ?) WHERE key = 'config'", old, new)
    return f"config: {new}"


_KINDS = [
    _value,
    _value,
    _value,
    _resized,
    _floats,
    _floats,
    _deleted,
    _agreed,
    _arrays,
    _arrays,
    _archive,
    _config,
]


def _column(rng: Rng, wanted: Callable[[str], bool]) -> tuple[str, str]:
    columns = [
        (table, name)
        for table, of_table in TABLES.items()
        for name, declared in of_table.items()
        if wanted(declared)
    ]
    return columns[rng.integers(len(columns))]


def _any_value(rng: Rng) -> int | float | str | bytes | None:
    kind = rng.integers(5)
    if kind == 0:
        return NUMBERS[rng.integers(len(NUMBERS))]
    if kind == 1:
        return TEXTS[rng.integers(len(TEXTS))]
    if kind == 2:
        return rng.bytes(int(rng.choice([0, 1, 8, 96, 1000, 100_000])))
    return [1.5, np.inf, -0.0][rng.integers(3)] if kind == 3 else None


def _try(database: sqlite3.Connection, statement: str, *values: object) -> None:
    """Run a change. The table's own constraints refuse some."""
    with suppress(sqlite3.Error, OverflowError):
        database.execute(statement, values)
