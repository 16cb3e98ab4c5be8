"""Test `topoloc benchmark paper --quick` as a user types it, on the shipped lab."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from topoloc.features.feature_types import default_learned_type
from topoloc.mapping.topomap import TopoMetricMap


@pytest.mark.slow
def test_the_quick_run_finishes_with_both_feature_types(tmp_path: Path):
    command = [sys.executable, "-m", "topoloc", "benchmark", "paper", "--quick"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    assert "Traceback" not in run.stderr
    out = tmp_path / "topoloc-paper"
    assert f"report: {Path('topoloc-paper') / 'report.html'}" in run.stdout
    assert (out / "report.html").exists()
    for path in (out / "maps").glob("*.topo"):
        with TopoMetricMap.load(path) as topomap:
            assert topomap.kinds[1:] == [default_learned_type()], path.name
    results = json.loads((out / "results.json").read_text(encoding="utf-8"))
    rows = {(row["queries"], row["change"]): row for row in results["ablation"]}
    for light in ("day", "night"):
        given = rows[light, "nearest nodes given"]
        assert given["topological_accuracy"] == 1.0
        assert given["num_localized"] >= rows[light, "as it is"]["num_localized"] - 1
    assert all(row["far_off"] == 0 for row in results["peers"] if row["peer"] == "topoloc")
