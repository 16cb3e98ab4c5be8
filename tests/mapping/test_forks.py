"""Test that a child forked while other threads hold locks waits for none of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")

SCRIPT = """
import os, sys, threading, time, types
from functools import cached_property
from pathlib import Path
from topoloc.mapping.forks import fork_safe
from topoloc.mapping.node_cache import NODE_CACHE
from topoloc.mapping.storage.map_file import MapFile

file = MapFile(Path(sys.argv[1]))
endless, inside = fork_safe(threading.RLock()), threading.Event()

class Slow:
    @cached_property
    def value(self):
        hold(lambda: None)
        return 1

sys.modules["topoloc_slow"] = types.ModuleType("topoloc_slow")
sys.modules["topoloc_slow"].Slow = Slow
slow = Slow()

def hold(end):
    inside.set()
    time.sleep(SECONDS)
    end()

def in_lock(lock):
    with lock:
        hold(lambda: None)

busy, use = {
    "a map": (lambda: in_lock(file._lock), lambda: file.rows("map")),
    "nodes": (lambda: in_lock(NODE_CACHE._lock), lambda: NODE_CACHE.get(1, 1)),
    "a property": (lambda: slow.value, lambda: Slow.value.__get__(other, Slow)),
    "an endless wait": (lambda: in_lock(endless), lambda: endless.acquire()),
}[sys.argv[2]]
SECONDS = 20.0 if sys.argv[2] in ("a property", "an endless wait") else 0.2
other = Slow()
threading.Thread(target=busy, daemon=True).start()
inside.wait()
child = os.fork()
if child == 0:
    threading.Timer(4.0, os._exit, [3]).start()
    SECONDS = 0.0
    use()
    os._exit(0)
for lock in (file._lock, NODE_CACHE._lock):  # the parent goes on
    with lock:
        pass
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.parametrize("busy", ["a map", "nodes", "a property", "an endless wait"])
def test_a_child_waits_for_no_thread_of_its_parent(room_map: Path, busy: str):
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, str(room_map), busy]
    assert subprocess.run(command, check=False, timeout=30).returncode == 0
