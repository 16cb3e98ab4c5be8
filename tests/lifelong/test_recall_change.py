"""Test the effect of an edit on the recall of the map's own sessions, and its entry
in the history."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc import TopoMetricMap
from topoloc.apps.cli import main
from topoloc.apps.cli.maps.history import _format_changes
from topoloc.lifelong.node_localization import measure_recall_change
from topoloc.lifelong.node_pruning import select_landmarks


def test_a_map_that_lost_its_landmarks_localizes_fewer_of_its_earlier_nodes(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        nodes = [select_landmarks(node, np.arange(3)) for node in topomap.nodes]
        poorer = replace(
            topomap.with_first_layer(nodes=nodes), summaries=[node.summary for node in nodes]
        )
        counts = measure_recall_change(topomap, poorer, max_queries=4)
        assert measure_recall_change(topomap, poorer, max_queries=0) == {}
    assert counts == {
        "earlier_asked": 4,
        "earlier_localized_before": 4,
        "earlier_localized_after": 0,
    }
    assert (
        _format_changes(counts)
        == ": of 4 earlier nodes, each asked without itself, 4 localized before and 0 after"
    )
    assert _format_changes({"landmarks_gone": 3}) == ": landmarks gone 3"


def test_the_history_contains_it(
    room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    with TopoMetricMap.load(path) as topomap:
        num = len(topomap.nodes)
    assert (
        main(
            [
                "prune",
                str(path),
                "--max-mb",
                f"{0.8 * path.stat().st_size / 1e6:.4f}",
            ]
        )
        == 0
    )
    capsys.readouterr()
    assert main(["history", str(path)]) == 0
    assert (
        f"of {num} earlier nodes, each asked without itself, {num} localized before and {num} after"
        in capsys.readouterr().out
    )
    assert main(["history", str(path), "--json", "-"]) == 0
    assert (
        json.loads(capsys.readouterr().out)["edits"][-1]["changes"]["earlier_localized_after"]
        == num
    )
