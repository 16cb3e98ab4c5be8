"""Recordings built on a cluster of two nodes beside the same ones built one by one: the same bytes?
how much time is lost?

    python benchmarks/ray_build.py SEQ [SEQ ...] [--nodes 2]

Both nodes are this machine, with one processor each. One by one is `topoloc build SEQ MAP`, a
process each, with one thread. What is lost is the time on the clock over the processor time of the
work divided by the processors, once of the commands one by one and once of the tasks. On a busy
machine the clock counts others' work, too; so what processors idled and what Ray itself took stand
beside it.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from ray.cluster_utils import Cluster

from topoloc.apps.cli.mapping.map_jobs import MapJob, PoseOptions
from topoloc.apps.cluster.tiles import Outcome, TileJob, build_on_ray, derive_tile_ids
from topoloc.atlas.atlas import Atlas
from topoloc.mapping.build import BuildConfig

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
TICKS = os.sysconf("SC_CLK_TCK")


class Watch:
    """Processor seconds of all processes below this one, also of those that end meanwhile, and
    seconds that processors idled."""

    def __init__(self) -> None:
        self._cpu: dict[int, float] = {}
        self._stop = threading.Event()
        self._idle, self._started = idle_s(), time.perf_counter()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def ended(self) -> tuple[float, float, float]:
        """Seconds on the clock, processor seconds, idle seconds."""
        wall, idle = time.perf_counter() - self._started, idle_s() - self._idle
        self._stop.set()
        self._thread.join()
        return wall, sum(self._cpu.values()), idle

    def _look(self) -> None:
        first: dict[int, float] = {}
        while not self._stop.wait(0.2):
            for pid, seconds in descendants(os.getpid()).items():
                first.setdefault(pid, seconds if not self._cpu and not first else 0.0)
                self._cpu[pid] = max(self._cpu.get(pid, 0.0), seconds - first[pid])


def descendants(root: int) -> dict[int, float]:
    """Processor seconds by the process, of all below `root`."""
    found: dict[int, tuple[int, float]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            found[int(entry.name)] = int(fields[1]), (int(fields[11]) + int(fields[12])) / TICKS
    below = {root}
    while more := {pid for pid, (parent, _) in found.items() if parent in below} - below:
        below |= more
    return {pid: found[pid][1] for pid in below if pid != root and pid in found}


def idle_s() -> float:
    """Seconds that this machine's processors idled, all together, since it began."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return (int(fields[4]) + int(fields[5])) / TICKS


def one_by_one(recordings: list[str], names: list[str], folder: Path) -> tuple[float, float]:
    """Seconds on the clock and on a processor."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    for recording, name in zip(recordings, names, strict=True):
        command = [
            sys.executable,
            "-m",
            "topoloc",
            "build",
            recording,
            str(folder / f"{name}.topo"),
        ]
        subprocess.run(command, check=True, env=os.environ | ONE_THREAD, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (
        time.perf_counter() - start,
        after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
    )


def on_cluster(
    recordings: list[str], names: list[str], atlas: str, num_nodes: int
) -> tuple[list[Outcome], tuple[float, float, float]]:
    jobs = [
        TileJob(
            recording,
            name,
            name,
            MapJob((recording,), PoseOptions(), BuildConfig()),
        )
        for recording, name in zip(recordings, names, strict=True)
    ]
    node = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100_000_000}
    files = tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True)
    cluster = Cluster(initialize_head=True, head_node_args={**node, "temp_dir": files.name})
    try:
        for _ in range(num_nodes - 1):
            cluster.add_node(**node)
        watch = Watch()
        outcomes = build_on_ray(jobs, atlas, cluster.address)
        return outcomes, watch.ended()
    finally:
        cluster.shutdown()
        files.cleanup()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--nodes", type=int, default=2)
    args = parser.parse_args()
    names = derive_tile_ids(args.recordings)
    with tempfile.TemporaryDirectory() as folder:
        alone_s, work_s = one_by_one(args.recordings, names, Path(folder))
        where = str(Path(folder) / "atlas")
        outcomes, (wall_s, cpu_s, idle) = on_cluster(args.recordings, names, where, args.nodes)
        atlas = Atlas.open(where)
        same = [
            atlas.map_path(atlas.tile(name)).read_bytes()
            == (Path(folder) / f"{name}.topo").read_bytes()
            for name in names
        ]
    tasks_s = sum(outcome.cpu_seconds for outcome in outcomes)
    for one in outcomes:
        print(
            f"  {one.recording}: {one.state} {one.reason or ''} {one.seconds:.1f} s, of a processor"
            f" {one.cpu_seconds:.1f} s"
        )
    print(f"one by one: {alone_s:.1f} s on the clock, {work_s:.1f} s of a processor")
    print(
        f"{args.nodes} nodes: {wall_s:.1f} s on the clock; of a processor {tasks_s:.1f} s the"
        f" tasks, {cpu_s - tasks_s:.1f} s Ray and starts"
    )
    for name, seconds in (("one by one", work_s), ("the tasks", tasks_s)):
        print(f"clock over work of {name} / {args.nodes}: {wall_s / (seconds / args.nodes):.3f}")
    others = 1 - (cpu_s + idle) / (wall_s * (os.cpu_count() or 1))
    print(
        f"others took {100 * others:.0f} % of the processors; our time and idle time over work one"
        f" by one: {(cpu_s + idle) / work_s:.3f}"
    )
    print(f"same bytes: {sum(same)} of {len(same)}")


if __name__ == "__main__":
    main()
