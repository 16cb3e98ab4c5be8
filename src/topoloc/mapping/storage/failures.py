"""Tell failures of the disk and of the process from damage of a file, each with its remedy."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

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
