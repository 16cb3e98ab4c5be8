"""Check that the tables in docs/journal/paper.md match the stored results, name skipped runs, and
count each query."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from topoloc.errors import TopolocError
from topoloc_paper import targets
from topoloc_paper.readme_block import BEGIN, END, block_of, update_readme
from topoloc_paper.text_tables import (
    accuracy_table,
    markdown_of,
    normalization_table,
    targets_table,
)

ROOT = Path(__file__).parents[2]
STORED = ROOT / "docs" / "results" / "paper.json"


def _row(method: str = "surf-vlad", nodes: str = "D_thresh 2 m", **more: Any) -> dict[str, Any]:
    row = {
        "dataset": "lab",
        "queries": "day",
        "method": method,
        "nodes": nodes,
        "weights": "none needed",
        "paper_m": 0.0202,
        "paper_deg": 0.35,
    }
    errors = {
        "num_queries": 20,
        "num_localized": 18,
        "median_translation_m": 0.0081,
        "median_rotation_deg": 0.12,
    }
    return row | errors | {"topological_accuracy": 0.9, "neighbour_accuracy": 1.0} | more


def test_the_journal_matches_the_stored_results():
    page = (ROOT / "docs" / "journal" / "paper.md").read_text(encoding="utf-8")
    assert block_of(json.loads(STORED.read_text(encoding="utf-8"))) in page


def test_stored_results_name_the_weights_of_every_row():
    results = json.loads(STORED.read_text(encoding="utf-8"))
    assert all(row["weights"] for row in results["accuracy"])
    assert markdown_of(results).count("\n| ") > len(results["accuracy"])


def test_a_row_has_its_number_of_queries_and_the_skipped_runs():
    text = accuracy_table(
        [
            _row(),
            _row("cnn-fc", missing="PyTorch is not installed"),
            _row(median_translation_m=None, num_localized=0),
        ]
    ).markdown()
    assert "0.81 cm, 0.12° (18 of 20)" in text
    assert "2.02 cm, 0.35°" in text
    assert "not run: PyTorch is not installed" in text
    assert "none of 20 localized" in text


def test_html_is_escaped():
    assert "<script>" not in accuracy_table([_row(weights="<script>")]).html()


def test_the_gain_of_normalisation_is_the_removed_share_of_the_error():
    rows = [
        _row(normalization=kind, median_translation_m=metres)
        for kind, metres in (("none", 0.02), ("paper", 0.015), ("wide", 0.01))
    ]
    assert "+25 %" in normalization_table(rows).markdown()


@pytest.mark.parametrize(
    ("as_paper", "own", "verdict"),
    [
        (0.009, 0.02, "| reached |"),
        (0.02, 0.009, "| reached with topoloc's own nodes |"),
        (0.02, 0.03, "| missed |"),
    ],
)
def test_a_target_is_reached_or_it_is_not(as_paper: float, own: float, verdict: str):
    table = [
        _row(median_translation_m=as_paper),
        _row(nodes="default nodes", median_translation_m=own),
    ]
    speed = [
        {"dataset": "lab", "method": "surf-vlad", "quartiles_s": {"total": [0.03, 0.05, 0.06]}}
    ]
    text = targets_table(targets.rows(table, [], speed)).markdown()
    assert verdict in text
    assert "missed: surf-vlad 50 ms" in text


def test_the_change_that_helps_most_is_named():
    plain = _row(part="", change="as it is", median_translation_m=0.02)
    other = _row(part="map", change="denser nodes", median_translation_m=0.01)
    (row,) = targets.rows(
        [_row()], [plain, other, _row(part="coarse", change="x", median_translation_m=0.0195)], []
    )
    assert row["helps"] == "map: denser nodes takes 50 % off the error"
    (row,) = targets.rows([_row()], [plain], [])
    assert "none of the changes" in row["helps"]


def test_the_readme_is_changed_between_its_markers_alone(tmp_path: Path):
    results = json.loads(STORED.read_text(encoding="utf-8"))
    file = tmp_path / "README.md"
    file.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    update_readme(file, results)
    text = file.read_text()
    assert text.startswith(f"before\n{BEGIN}\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "old" not in text
    file.write_text("no markers")
    with pytest.raises(TopolocError, match="between"):
        update_readme(file, results)
    assert file.read_text() == "no markers"
