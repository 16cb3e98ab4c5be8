"""Cache slow results that tests only read: the first process of a test run makes one, and others
read its file."""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

try:
    import fcntl
except ImportError:  # each process makes its own
    fcntl = None

P, R = ParamSpec("P"), TypeVar("R")
_folder: list[Path] = []


def share_in(folder: Path) -> None:
    """Set the folder for the results of `once_a_run`, which all processes of the run share."""
    _folder[:] = [folder]


def once_a_run(make: Callable[P, R]) -> Callable[P, R]:
    """Cache a function. Its arguments must print equally in all processes, and its result
    must be picklable."""

    @functools.cache
    def made(*args: P.args, **settings: P.kwargs) -> R:
        if fcntl is None or not _folder:
            return make(*args, **settings)
        name = hashlib.sha256(
            repr((make.__module__, make.__qualname__, args, settings)).encode()
        ).hexdigest()
        path = _folder[0] / name
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if path.exists():
                return pickle.loads(path.read_bytes())
            result = make(*args, **settings)
            path.with_suffix(".part").write_bytes(pickle.dumps(result))
            os.replace(path.with_suffix(".part"), path)
            return result

    return made
