"""Functions compiled by Numba, where their machine code is kept, and how many threads run them.

Numba itself refuses, as a module is imported, to compile for a folder that cannot be written, and
reads no code from one. A container's image is often both: filled as it is built, read-only
afterwards. Here code is read from wherever it lies and kept where it can be; where that is nowhere,
it is compiled anew in every process, and one line on stderr says what to do.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, NullCache

_DEFAULT_NUM_THREADS = 2

KERNELS: list[Any] = []
"""All that were declared by now."""
_configured: list[int] = []
_thread_local = threading.local()
_warned_folders: list[str] = []


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorates a function that Numba compiles; `options` are those of `numba.njit`.

    It releases the GIL and its machine code is kept. It is never `parallel`: Numba's own threads
    may be used by one thread of Python alone, while a `Localizer` is shared by several.
    `features/bands.py` shares rows out to threads instead.
    """
    if "parallel" in options:
        raise ValueError("a kernel that several threads call cannot be parallel")

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(nogil=True, **options)(function)
        dispatcher._cache = _KernelCache(function)  # pyright: ignore[reportAttributeAccessIssue]
        KERNELS.append(dispatcher)
        return dispatcher

    return compiled


def is_cached(compiled: Any) -> bool:
    """Whether machine code of this kernel lies somewhere, so that its first call takes no time to
    speak of."""
    return compiled._cache.is_cached


def set_num_threads(number: int) -> None:
    """At most so many threads work on one query or one frame; while a map is made, each on a
    mapping image or a node of its own.

    Unless it is said these are 2, and 1 for the networks of learned coarse localizers. The answers
    do not depend on it, but for the last digits of such a network's scores. Holds for topoloc in
    this process and for the libraries that it calls: OpenCV, FAISS, and PyTorch where it is loaded.
    Of several threads that share a `Localizer`, each uses as many. NumPy's own number is set before
    it is loaded (`OPENBLAS_NUM_THREADS`; the command line sets 1 where it is not set).

    Raises:
        ValueError: `number` is below 1.
    """
    if number < 1:
        raise ValueError(f"at least one thread is needed, not {number}")
    import cv2
    import faiss

    _configured[:] = [number]
    cv2.setNumThreads(number)
    faiss.omp_set_num_threads(number)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(number)


def num_threads(default: int = _DEFAULT_NUM_THREADS) -> int:
    """As `set_num_threads` said, `default` where it was not called; 1 in a thread that is one of
    several already."""
    return (
        1
        if hasattr(_thread_local, "is_one_of_several")
        else _configured[0]
        if _configured
        else default
    )


def mark_worker_thread() -> None:
    """From now on this thread of Python starts no others: they are all at work on items of their
    own (`features/bands.py`)."""
    _thread_local.is_one_of_several = True


class _KernelCache(NullCache):
    """The machine code of one function, as Numba asks for it: read from the first folder that has
    it, kept in the first that takes it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._caches = [
            _FolderCache(function, folder)
            for folder in _cache_folders(str(Path(function.__code__.co_filename).parent))
        ]

    @property
    def cache_path(self) -> Any:
        return self._caches[0].cache_path

    @property
    def is_cached(self) -> bool:
        return any(folder.is_cached for folder in self._caches)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        for folder in self._caches:
            try:
                found = folder.load_overload(sig, target_context)
            except OSError:
                continue
            except Exception:  # damaged: what unpickling raises then is anybody's guess
                with contextlib.suppress(OSError):
                    folder.flush()
                continue
            if found is not None:
                return found
        return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        for folder in self._caches:
            with contextlib.suppress(OSError):
                return folder.save_overload(sig, cres)
        _warn_not_cached(" or ".join(folder.cache_path for folder in self._caches))
        return None

    def flush(self) -> None:
        for folder in self._caches:
            folder.flush()


class _FolderCache(FunctionCache):
    """Numba's cache in a folder of our choice."""

    def __init__(self, function: Callable[..., Any], folder: str) -> None:
        self._impl_class = type(
            "_Impl",
            (CompileResultCacheImpl,),
            {"_locator_classes": [_CacheLocator(function, folder)]},
        )
        super().__init__(function)

    @property
    def is_cached(self) -> bool:
        """Whether there is code of the function as it is now."""
        try:
            return bool(self._cache_file._load_index())
        except Exception:  # damaged: what unpickling raises then is anybody's guess
            return False


class _CacheLocator:
    """What Numba calls a locator: the folder of a function's code, and what the code is of."""

    def __init__(self, function: Callable[..., Any], folder: str) -> None:
        self._function, self._folder = function, folder

    def from_function(self, function: Callable[..., Any], file: str) -> _CacheLocator:
        del function, file
        return self

    def ensure_cache_path(self) -> None:
        os.makedirs(self._folder, exist_ok=True)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return _source_digest(self._function.__code__.co_filename)

    def get_disambiguator(self) -> str:
        return str(self._function.__code__.co_firstlineno)


@cache
def _cache_folders(source: str) -> list[str]:
    """Where code of functions from the folder `source` may lie: `NUMBA_CACHE_DIR` if that is set,
    else beside them or the user's own."""
    apart = f"{Path(source).name}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    if named := config.CACHE_DIR:  # pyright: ignore[reportAttributeAccessIssue]
        return [os.path.join(named, apart)]
    folders = [os.path.join(source, "__pycache__")]
    with contextlib.suppress(RuntimeError):  # nobody knows a home
        folders.append(
            str(
                Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
                / "topoloc"
                / "kernels"
                / apart
            )
        )
    return folders


@cache
def _source_digest(file: str) -> str:
    """Of a file and of all kernels beside it, since they call each other."""
    files = {Path(file), *Path(file).parent.glob("*_kernels.py")}
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(files))).hexdigest()


def _warn_not_cached(folders: str) -> None:
    """Once a process."""
    if _warned_folders:
        return
    _warned_folders.append(folders)
    print(
        "topoloc compiles anew in every process, a minute in all: machine code cannot be kept"
        f" ({folders}). While a container's image is built, `python -c 'import topoloc;"
        " topoloc.warm_up()'` fills the first; or NUMBA_CACHE_DIR names one that can be written.",
        file=sys.stderr,
    )
