"""Test `topoloc benchmark` on the tiny room: all parts, the page, and a second run on
stored results."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from built_room import unseen_views, write_pictures
from topoloc.apps.cli import main
from topoloc_paper import benchmark
from topoloc_paper.datasets import Dataset
from topoloc_paper.settings import PaperConfig, WeightFiles


@pytest.fixture
def room(tiny_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Replace the lab of the quick run by the tiny room, train for one epoch, and return --out."""
    queries = {
        "day": str(write_pictures(tmp_path / "day", unseen_views()[:4])),
        "night": str(write_pictures(tmp_path / "night", unseen_views()[:2])),
    }
    elsewhere = str(write_pictures(tmp_path / "elsewhere", unseen_views(seed=1, step=6.0)))
    place = Dataset(
        "lab",
        "A tiny room",
        (str(tiny_recording),),
        queries,
        1.0,
        sweep=(0.4, 1.0),
        elsewhere=(elsewhere,),
    )
    monkeypatch.setattr(benchmark, "quick_datasets", lambda: [place])
    tiny = replace(
        PaperConfig.for_quick_run(WeightFiles()), epochs=1, posenet_epochs=1, max_colmap_images=6
    )
    monkeypatch.setattr(PaperConfig, "for_quick_run", staticmethod(lambda weights: tiny))
    return tmp_path / "out"


@pytest.mark.slow
def test_the_paper_is_made_again_and_only_once(room: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("torch", reason="torch is not installed")
    assert main(["benchmark", "paper", "--quick", "--out", str(room)]) == 0
    printed = capsys.readouterr().out
    assert "0 done" not in printed
    results = json.loads((room / "results.json").read_text())
    methods = {row["method"] for row in results["accuracy"]}
    assert methods == {"posenet", "cnn-fc", "cnn-nn", "vlad-nn", "surf-vlad"}
    assert all(
        "scratch" in row["weights"]
        for row in results["accuracy"]
        if row["method"] not in ("surf-vlad",)
    )
    ours = [
        row
        for row in results["accuracy"]
        if row["method"] == "surf-vlad" and row["queries"] == "day"
    ]
    assert all(row["num_localized"] == 4 and row["median_translation_m"] < 0.02 for row in ours)
    assert {row["peer"] for row in results["peers"]} == {
        "topoloc",
        "the paper's step",
        "pycolmap, SIFT",
        "retrieval only",
    }
    few, many = sorted(results["nodes"], key=lambda row: row["num_nodes"])
    assert few["bytes"] < many["bytes"]
    assert {row["change"] for row in results["ablation"]} >= {
        "as it is",
        "nearest nodes given",
        "OpenCV's PnP",
    }
    page = (room / "report.html").read_text(encoding="utf-8")
    assert page.count("<section>") >= 9
    assert not re.search(r'(src|href)="http', page), "the page must stand alone"
    names = {path.name for path in (room / "figures").iterdir()}
    assert {
        "lab_from_above.svg",
        "nodes.png",
        "times.svg",
        "topological_accuracy.png",
        "posenet_lab.svg",
        "lab_normalized.png",
    } <= names
    assert main(["benchmark", "nodes", "--quick", "--out", str(room)]) == 0
    assert "stages: 0 done" in capsys.readouterr().out
    assert json.loads((room / "results.json").read_text())["nodes"] == results["nodes"]


def test_a_part_makes_its_own_tables_alone(room: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["benchmark", "nodes", "--quick", "--out", str(room), "--json", "-"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert [row["d_thresh"] for row in results["nodes"]] == [0.4, 1.0]
    assert "accuracy" not in results
    assert not (room / "report.html").exists()


def test_without_recordings_there_are_no_queries(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = str(tmp_path / "out")
    assert main(["benchmark", "paper", "--at-hand", "--data", str(tmp_path), "--out", out]) == 1
    assert "nothing to ask" in capsys.readouterr().err
    assert main(["benchmark", "paper", "--worlds", "moon", "--out", out]) == 2
    assert "moon" in capsys.readouterr().err
