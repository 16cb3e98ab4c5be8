"""Edits and undos of a map in a process that is killed at random moments: is the map ever broken, is anything left lying about?

    python benchmarks/kill_edits.py MAP [--kills 200]

A child edits a copy of MAP without end, every third time taking the edit back. After each kill the map is looked at from end to end, all
that can be undone is undone, and one more edit is made; then no file but the map and its undo file may be there. Exit status 1 where
anything was wrong.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from topoloc.map.checking import damages
from topoloc.map.edit import editing, undo_edit, undoable_edits

_CHILD = """
import sys
from topoloc.map.edit import editing, undo_edit
print("ready", flush=True)
for k in range(100_000):
    with editing(sys.argv[1]) as edit:
        edit.commit(edit.topomap, f"edit {k}", {"k": k})
    if k % 3 == 2:
        undo_edit(sys.argv[1])
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("--kills", type=int, default=200)
    args = parser.parse_args()
    rng, broken, litter, edits = np.random.default_rng(0), 0, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(shutil.copy(args.map, Path(folder) / "map.topo"))
        for _ in range(args.kills):
            with subprocess.Popen([sys.executable, "-c", _CHILD, str(path)], stdout=subprocess.PIPE) as child:
                assert child.stdout is not None
                child.stdout.readline()
                time.sleep(rng.uniform(0.0, 2.0))
                child.send_signal(signal.SIGKILL)
            broken += bool(damages(path))
            while undoable_edits(path):
                undo_edit(path)
                edits += 1
            broken += bool(damages(path))
            with editing(path) as edit:
                edit.commit(edit.topomap, "after")
            undo_edit(path)
            litter += sorted(one.name for one in path.parent.iterdir()) not in (["map.topo"], ["map.topo", "map.topo.undo"])
    print(f"{args.kills} kills, {edits} edits undone afterwards: {broken} times broken, {litter} times something left")
    return int(broken + litter > 0)


if __name__ == "__main__":
    sys.exit(main())
