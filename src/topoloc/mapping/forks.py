"""Keep locks usable in a forked child whose parent had other threads.

Only the forking thread exists in the child. A lock of another one would stay locked there, and its
data could be half changed. So a fork waits for the locks of `fork_safe`, and the child renews
all. That of a `cached_property` (until Python 3.12) is only renewed: a value is computed under it,
which takes long, and the child computes it again.
"""

from __future__ import annotations

import os
import sys
import threading
import weakref
from functools import cached_property
from typing import Any, TypeVar

T = TypeVar("T")

_MAX_WAIT_S = 0.5
_locks: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
_held = threading.local()


def fork_safe(lock: T) -> T:
    """Return a lock of `threading`, for which a fork waits. No other one may be acquired under
    it."""
    _locks[id(lock)] = lock
    return lock


def _registered() -> list[Any]:
    locks = [reference() for reference in _locks.valuerefs()]  # copied at once: threads add others
    return [lock for lock in locks if lock is not None]


def _acquire() -> None:
    _held.locks = [lock for lock in _registered() if lock.acquire(timeout=_MAX_WAIT_S)]


def _release() -> None:
    for lock in _held.locks:
        lock.release()


def _renew() -> None:
    for lock in _registered():
        lock._at_fork_reinit()
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("topoloc")]
    classes = [one for module in modules for one in vars(module).values() if isinstance(one, type)]
    for value in [value for one in classes for value in vars(one).values()]:
        if isinstance(value, cached_property) and hasattr(value, "lock"):
            value.lock = threading.RLock()  # pyright: ignore[reportAttributeAccessIssue]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_acquire, after_in_parent=_release, after_in_child=_renew)
