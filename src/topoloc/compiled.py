"""Compile functions with Numba, cache their machine code, and set the number of threads. Distribute
work over threads: a band of rows (of an image, of a table of products) per thread, or whole items.

Numba's own cache raises an error at import if the cache folder cannot be written. It also reads no
code from such a folder. A container's image is often filled while it is built and read-only
afterwards. Therefore this cache reads code from any folder that has it and writes to the first
writable one. If no folder is writable, each process compiles again, and one line on stderr suggests
a remedy.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, NullCache

_DEFAULT_NUM_THREADS = 2
_PACKAGE = Path(__file__).parent

KERNELS: list[Any] = []
"""All kernels declared so far."""
_configured: list[int] = []
_thread_local = threading.local()
_warned_folders: list[str] = []


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function with Numba. `options` are those of `numba.njit`.

    A kernel releases the GIL, and its machine code is cached. The option `parallel` is not allowed:
    only one Python thread may use Numba's own threads, but several threads may share a `Localizer`.
    `parallel_for_rows` distributes rows over threads instead.

    Raises:
        ValueError: `parallel` is among the options.
    """
    if "parallel" in options:
        raise ValueError("a kernel that several threads call cannot be parallel")

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher: Any = numba.njit(nogil=True, **options)(function)
        dispatcher._cache = _KernelCache(function)
        KERNELS.append(dispatcher)
        return dispatcher

    return compiled


def is_cached(compiled: Any) -> bool:
    """Return whether the machine code of this kernel is cached, so that its first call compiles
    nothing."""
    return compiled._cache.is_cached


def set_num_threads(number: int) -> None:
    """Set the maximum number of threads for one query or one frame.

    While a map is built, each thread processes a mapping image or a node of its own. The default is
    2 threads, and 1 for the networks of learned coarse localizers. Results do not depend on the
    number, except for the last digits of the scores of such a network.

    The number holds for topoloc in this process and for OpenCV and PyTorch (if it is loaded). If
    several threads share a `Localizer`, each of them uses this number. NumPy's number of threads
    must be set before NumPy is loaded, by `OPENBLAS_NUM_THREADS`. The command line sets it to 1 if
    it is unset.

    Raises:
        ValueError: `number` is below 1.
    """
    if number < 1:
        raise ValueError(f"at least one thread is needed, not {number}")
    import cv2

    _configured[:] = [number]
    cv2.setNumThreads(number)
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(number)


def num_threads(default: int = _DEFAULT_NUM_THREADS) -> int:
    """Return the number set by `set_num_threads`, or `default` if it was not called. In a worker
    thread the number is 1."""
    return 1 if hasattr(_thread_local, "is_worker") else _configured[0] if _configured else default


def mark_worker_thread() -> None:
    """Mark this Python thread as one of several workers, so that it starts no further threads
    (`parallel_map`)."""
    _thread_local.is_worker = True


class _KernelCache(NullCache):
    """Cache the machine code of one function behind Numba's cache interface. Code is read from the
    first folder that has it and written to the first writable folder."""

    def __init__(self, function: Callable[..., Any]) -> None:
        folders = _cache_folders(str(Path(function.__code__.co_filename).parent))
        self._caches = [_FolderCache(function, folder) for folder in folders]

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
            except Exception:  # a damaged file: unpickling may raise any exception
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
    """Run Numba's cache in a given folder."""

    def __init__(self, function: Callable[..., Any], folder: str) -> None:
        locators = {"_locator_classes": [_CacheLocator(function, folder)]}
        self._impl_class = type("_Impl", (CompileResultCacheImpl,), locators)
        super().__init__(function)

    @property
    def is_cached(self) -> bool:
        """Return whether code of the current version of the function exists."""
        try:
            return bool(self._cache_file._load_index())
        except Exception:  # a damaged file: unpickling may raise any exception
            return False


class _CacheLocator:
    """Implement Numba's locator: the folder of a function's code and the stamp of its source."""

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


def kernel_caches() -> list[Path]:
    """Return the folders of machine code: `NUMBA_CACHE_DIR`, or else this package (`__pycache__`
    beside the functions) and then the user's cache folder."""
    if named := vars(config)["CACHE_DIR"]:
        return [Path(named)]
    folders = [_PACKAGE]
    with contextlib.suppress(RuntimeError):  # the user has no home folder
        caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folders.append(caches / "topoloc" / "kernels")
    return folders


@cache
def _cache_folders(source: str) -> list[str]:
    """Return the folders for the code of functions from the folder `source`."""
    subfolder = f"{Path(source).name}_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    beside = os.path.join(source, "__pycache__")
    return [beside if cache is _PACKAGE else str(cache / subfolder) for cache in kernel_caches()]


@cache
def _source_digest(file: str) -> str:
    """Return the digest of a file and of all kernels beside it, because these call each other."""
    files = {Path(file), *Path(file).parent.glob("*_kernels.py")}
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(files))).hexdigest()


def _warn_not_cached(folders: str) -> None:
    """Print the warning once per process."""
    if _warned_folders:
        return
    _warned_folders.append(folders)
    print(
        "topoloc compiles anew in every process, a minute in all: machine code cannot be kept"
        f" ({folders}). While a container's image is built, `python -c 'import topoloc;"
        " topoloc.warm_up()'` fills the first; or NUMBA_CACHE_DIR names one that can be written.",
        file=sys.stderr,
    )


T = TypeVar("T")
R = TypeVar("R")


@cache
def _pool(process_id: int) -> ThreadPoolExecutor:
    """Return the thread pool of this process. A forked child inherits a pool without its threads,
    and would wait for them forever."""
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix=f"bands-{process_id}")


def parallel_for_rows(
    run: Callable[[int, int], object], num_rows: int, max_bands: int | None = None
) -> None:
    """Call run(first_row, last_row) in parallel for `max_bands` bands of about equal height that
    cover the rows.

    The default number is that of `set_num_threads`. The calling thread processes one band itself.
    An exception in any band is raised here.
    """
    num_bands = max(1, min(max_bands or num_threads(), num_rows))
    bounds = [num_rows * band // num_bands for band in range(num_bands + 1)]
    pool = _pool(os.getpid())
    others = [pool.submit(run, bounds[band], bounds[band + 1]) for band in range(1, num_bands)]
    run(0, bounds[1])
    for other in others:
        other.result()


def parallel_map(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield work(item) in the order of the items. As many threads as `set_num_threads` set process
    one item each.

    With a whole item per thread, no thread waits for part of an image. The Python code for one item
    also overlaps with the kernels of another. At most one finished result more than there are
    threads is buffered, which limits memory. An exception is raised in its item's place. The
    calling thread creates the items.
    """
    number = num_threads()
    if number == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(number, initializer=mark_worker_thread) as pool:
        pending: deque[Future[R]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(work, item))
                if len(pending) > number:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
