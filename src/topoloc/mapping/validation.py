"""Validate the header of a map file and its data: shapes, types and bounds. Invalid data raises
`CorruptDataError` before any kernel uses it. Failures of the disk and of the process are told from
damage of the file, each with its remedy."""

from __future__ import annotations

import errno
import io
import math
import os
import sqlite3
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import CalibrationError, MapError, MapVersionError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.storage.schema import APPLICATION_ID, SCHEMA_VERSION

_ERRNO_OF_SQLITE = {
    sqlite3.SQLITE_FULL: errno.ENOSPC,
    # the file or its folder was opened a moment ago
    sqlite3.SQLITE_CANTOPEN: errno.EMFILE,
    sqlite3.SQLITE_IOERR: errno.EIO,
    sqlite3.SQLITE_NOMEM: errno.ENOMEM,
    sqlite3.SQLITE_PERM: errno.EACCES,
    sqlite3.SQLITE_READONLY: errno.EROFS,
}
_REMEDIES = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT),
        "free some on this disk and in the folder for temporary files (TMPDIR)",
    ),
    errno.EIO: "check this disk and the folder for temporary files (TMPDIR)",
    errno.EMFILE: "raise the limit (ulimit -n)",
    errno.ENFILE: "close other programs",
    errno.EACCES: "change the permissions of the file or of its folder",
    errno.EROFS: "copy the file to another disk",
}


@contextmanager
def sqlite_failures_as_os_errors() -> Iterator[None]:
    """Raise OSError instead of those errors of SQLite that do not mean a damaged file."""
    try:
        yield
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", None) or sqlite3.SQLITE_OK
        number = _ERRNO_OF_SQLITE.get(code & 0xFF)
        if number is None:
            raise
        raise OSError(number, os.strerror(number)) from error


def describe_failure(error: OSError | ValueError) -> str:
    """Return the reason and the remedy of a failure, without a path. ValueError is raised for a
    name with a null character."""
    if isinstance(error, ValueError):
        return str(error)
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{error.strerror or error}" + (f"; {remedy}" if remedy else "")


MAX_POINTS = 100_000
MAX_SIDE_PX = 32_768
_MAX_MAGNITUDE = 1e7  # metres and pixels; larger than any measurement


class CorruptDataError(Exception):
    """Invalid data in a map file. The message describes it."""


def check_header(path: Path) -> int:
    """Check the 100-byte header of a map file and return its schema version. Raises MapError,
    MapVersionError."""
    if os.path.exists(path) and not os.path.isfile(path):
        hint = "a folder" if os.path.isdir(path) else "a pipe or a device"
        hint = "an atlas" if os.path.isfile(path / "atlas.json") else hint
        raise MapError(f"{path} is no map but {hint}")
    try:
        with path.open("rb") as file:
            header = file.read(100)
            num_bytes = file.seek(0, os.SEEK_END)
    except (OSError, ValueError) as error:  # ValueError: the name contains a null character
        raise MapError(f"cannot open map {path}: {describe_failure(error)}") from error
    if len(header) < 100 or not header.startswith(b"SQLite format 3\0"):
        raise MapError(
            f"{path} is not a topoloc map" + (" (the file is empty)" if num_bytes == 0 else "")
        )
    if int.from_bytes(header[68:72], "big") != APPLICATION_ID:
        raise MapError(f"{path} is an SQLite database but not a topoloc map")
    version = int.from_bytes(header[60:64], "big")
    if not 1 <= version <= SCHEMA_VERSION:
        newer = (
            "a newer topoloc" if version > SCHEMA_VERSION else "an older topoloc; build it again"
        )
        raise MapVersionError(
            f"map {path} has schema {version}, this topoloc reads schemas 1 to {SCHEMA_VERSION}:"
            f" written by {newer}"
        )
    page_size = int.from_bytes(header[16:18], "big")
    expected = int.from_bytes(header[28:32], "big") * (65536 if page_size == 1 else page_size)
    if num_bytes < expected:
        raise MapError(f"map {path} is truncated: {num_bytes} of {expected} bytes")
    return version


def array_from_bytes(data: bytes, dtype: str, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return an array of exactly this shape. Floating point numbers must be finite and within ±
    `_MAX_MAGNITUDE`. Raises CorruptDataError."""
    if len(data) != math.prod(shape) * np.dtype(dtype).itemsize:
        raise CorruptDataError(
            f"{what}: {len(data)} bytes are not {' x '.join(map(str, shape))} {dtype}"
        )
    array = np.frombuffer(data, dtype).reshape(shape)
    largest = float(np.abs(array).max(initial=0)) if array.dtype.kind == "f" else 0.0
    if not largest <= _MAX_MAGNITUDE:  # NaN compares as false
        raise CorruptDataError(f"{what}: a number that is not finite or beyond {_MAX_MAGNITUDE:g}")
    return array


def pose_from_bytes(data: bytes) -> Rigid3:
    """Return the rigid transform of 3x4 float64 numbers. The left 3x3 must be a rotation. Raises
    CorruptDataError."""
    matrix = array_from_bytes(data, "<f8", (3, 4), "a pose")
    rotation = matrix[:, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0.0:
        raise CorruptDataError("a pose whose rotation is none")
    return Rigid3(rotation.copy(), matrix[:, 3].copy())


def camera_from_text(text: str) -> Camera:
    """Parse a camera model of plausible size. Raises CalibrationError, CorruptDataError."""
    camera = Camera.from_json(text)
    if (
        max(camera.width, camera.height) > MAX_SIDE_PX
        or max(map(abs, camera.params)) > _MAX_MAGNITUDE
        or min(camera.fx, camera.fy) < 1.0
    ):
        raise CalibrationError(
            f"a camera of {camera.width}x{camera.height} pixels, f = {camera.fx:g}, is none"
        )
    return camera


def check_count(value: int, least: int, most: int, what: str) -> int:
    """Return `value` if it is within `least` and `most`. Raises CorruptDataError otherwise."""
    if not least <= value <= most:
        raise CorruptDataError(f"{what}: {value} is not within {least} and {most}")
    return value


def decompress_bytes(data: bytes, num_bytes: int, what: str) -> bytes:
    """Decompress zlib data of exactly this length. Raises CorruptDataError."""
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(data, num_bytes + 1)
    except zlib.error as error:
        raise CorruptDataError(f"{what}: {error}") from error
    if len(found) != num_bytes or not unpacker.eof:
        raise CorruptDataError(f"{what}: not {num_bytes} bytes")
    return found


def arrays_from_npz(data: bytes, what: str) -> dict[str, np.ndarray]:
    """Return the arrays of an uncompressed NumPy `.npz` without objects. So arrays are no larger
    than the data. Raises CorruptDataError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if len(members) > 2000 or sum(member.file_size for member in members) > len(data):
                raise CorruptDataError(f"{what}: larger than it can be")
            if any(one.compress_type != zipfile.ZIP_STORED or one.flag_bits & 1 for one in members):
                raise CorruptDataError(f"{what}: of a compression that no map has")
            return {
                member.filename.removesuffix(".npy"): _array_from_npy(archive.read(member), what)
                for member in members
            }
    except (
        zipfile.BadZipFile,
        EOFError,
        OSError,
        ValueError,
        NotImplementedError,
        LookupError,
        OverflowError,
    ) as error:
        raise CorruptDataError(f"{what}: {' '.join(str(error).split())[:100]}") from error


def _array_from_npy(data: bytes, what: str) -> np.ndarray:
    """Parse one `.npy`. Its header must agree with its length before an array is created."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header: Any = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise CorruptDataError(f"{what}: an array of an unknown version")
    try:
        shape, is_fortran, dtype = read_header(stream, max_header_size=2000)
    except (
        SyntaxError,
        TypeError,
        RecursionError,
        MemoryError,
        tokenize.TokenError,
    ) as error:  # raised by Python's parser if the header is invalid
        raise CorruptDataError(f"{what}: an array without a header") from error
    left = len(data) - stream.tell()
    if (
        dtype.kind not in "fiub"
        or dtype.itemsize > 8
        or len(shape) > 6
        or math.prod(shape) * dtype.itemsize != left
        or min(shape, default=0) < 0
    ):
        raise CorruptDataError(f"{what}: an array of {left} bytes that says {dtype} {shape}")
    flat = np.frombuffer(data, dtype, offset=stream.tell())
    return flat.reshape(shape[::-1]).T.copy("F") if is_fortran else flat.reshape(shape).copy()
