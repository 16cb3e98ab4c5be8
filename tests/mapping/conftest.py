"""Provide a map of the rendered room, built once, and its file."""

from __future__ import annotations

from pathlib import Path

import pytest

import topoloc
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="session")
def tiny_map(tiny_recording: Path) -> TopoMetricMap:
    """Return the map of every other pair of the recording, of SURF alone, in memory."""
    return topoloc.build_map(
        topoloc.open_sequence(f"{tiny_recording}@0::2"), topoloc.BuildConfig(other_kinds=())
    )


@pytest.fixture
def saved(tiny_map: TopoMetricMap, tmp_path: Path) -> Path:
    """Return a file of that map that a test may change."""
    tiny_map.save(tmp_path / "room.topo")
    return tmp_path / "room.topo"
