"""Provide a cluster of two nodes with one processor each, both on this machine, and
small recordings."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

_NODE = {"num_cpus": 1, "object_store_memory": 80_000_000, "include_dashboard": False}


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder for temporary files of the cluster's workers."""
    folder = tmp_path_factory.mktemp("scratch")
    (folder / "ray").mkdir()  # Ray stores the address of the last cluster here
    return folder


@pytest.fixture(scope="module")
def cluster(scratch: Path) -> Iterator[Any]:
    """Start two nodes that import topoloc from the paths of this process."""
    pytest.importorskip("ray", reason="Ray is not installed (the extra cluster)")
    from ray.cluster_utils import Cluster

    folder = tempfile.mkdtemp(prefix="rt-")  # short: sockets lie in it
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("TMPDIR", str(scratch))
        patch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
        patch.setenv("RAY_health_check_failure_threshold", "2")
        cluster = Cluster(initialize_head=True, head_node_args={**_NODE, "temp_dir": folder})
        try:
            cluster.add_node(**_NODE)
            yield cluster
        finally:
            cluster.shutdown()
            shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return recordings of three rooms with a few stereo pairs each."""
    from tiny_world import write_stereo_recording

    folder = tmp_path_factory.mktemp("walks")
    return [
        write_stereo_recording(folder / f"room{seed}", seed, [0.0, 2.0, 4.0, 6.0, 8.0])
        for seed in (1, 2, 3)
    ]
