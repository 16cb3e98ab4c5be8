"""Run `topoloc demo` end to end, on its own recordings and on a small room with
the same folders."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from built_room import unseen_views, write_pictures
from tiny_world import write_stereo_recording
from topoloc.apps.cli import demo, main
from topoloc.demo.recordings import SHIPPED, find_missing_recordings
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.trajectory import Trajectory

SETS = ["day", "night", "other camera", "elsewhere"]


@pytest.fixture(scope="module")
def room(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the tiny room in folders with the names of the demo's folders."""
    folder = tmp_path_factory.mktemp("demo")
    shutil.copytree(tiny_recording, folder / "map_lap1")
    write_stereo_recording(folder / "map_lap2", indices=[0.5, 6.5, 11.5])
    for name, views in (
        ("day", unseen_views()),
        ("night", unseen_views()[:3]),
        ("other_camera", unseen_views()[3:5]),
    ):
        write_pictures(folder / name, views)
    for name, seed in (("corridor", 1), ("street", 2)):
        write_pictures(folder / name, unseen_views(seed=seed, step=6.0))
    shutil.copytree(SHIPPED / "pictures_of_nothing", folder / "pictures_of_nothing")
    return folder


def _rows(evaluation: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in evaluation["recordings"]}


def test_the_demo_maps_localizes_and_reports(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, told = tmp_path / "out", tmp_path / "evaluation.json"
    assert main(["demo", "--recordings", str(room), "--out", str(out), "--json", str(told)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert all(
        any(line.startswith(name) for line in printed.out.splitlines())
        for name in (*SETS, "the paper's Lab")
    )
    assert "2.02 cm, 0.35 deg" in printed.out
    assert str(out / "report.html") in printed.out
    evaluation = json.loads(told.read_text())
    rows = _rows(evaluation)
    assert list(rows) == SETS
    assert {name: row["num_queries"] for name, row in rows.items()} == {
        "day": 9,
        "night": 3,
        "other camera": 2,
        "elsewhere": 0,
    }
    assert all(rows[name]["num_localized"] == rows[name]["num_queries"] for name in SETS)
    assert rows["day"]["median_translation_m"] < 0.01
    assert (rows["elsewhere"]["num_elsewhere"], evaluation["false_accepts"]) == (3 + 3 + 5, 0)
    assert len(TopoMetricMap.load(out / "lab.topo").nodes) == evaluation["map"]["num_nodes"]
    lines = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert [line["query"].partition("/")[0] for line in lines] == ["day"] * 9 + ["night"] * 3 + [
        "other camera"
    ] * 2 + ["elsewhere"] * 11
    found = Trajectory.read(out / "day.tum")
    assert found.t_ns == [number * 100_000_000 for number in range(9)]
    page = (out / "report.html").read_text()
    assert "By night, 100 % of 3 images get a pose" in page
    assert page.count("</article>") == 4 + 6


def test_without_matplotlib_all_but_the_report_is_done(
    room: Path,
    room_map: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    for name in ("report", "figures", "map_figure", "figure_style"):
        monkeypatch.delitem(sys.modules, f"topoloc.apps.report.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(
        demo,
        "_build_lab_map",
        lambda *_: TopoMetricMap.load(shutil.copy(room_map, tmp_path / "lab.topo")),
    )
    monkeypatch.setattr(demo, "ROLES", {"day": "queries", "night": "queries"})
    assert main(["demo", "--recordings", str(room), "--out", str(tmp_path)]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "report: none; a report needs matplotlib: pip install 'topoloc[report]'"
    assert {path.name for path in tmp_path.iterdir()} == {
        "lab.topo",
        "results.jsonl",
        "day.tum",
        "night.tum",
    }


@pytest.mark.slow  # the tests of quickstart and examples use the same recordings
@pytest.mark.skipif(
    bool(find_missing_recordings(SHIPPED)), reason="the demo's recordings are not in this checkout"
)
def test_the_recordings_brought_along_keep_the_promise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["demo", "--out", str(tmp_path / "out"), "--json", "-"]) == 0
    rows = _rows(json.loads(capsys.readouterr().out))
    assert rows["day"]["num_localized"] >= 0.95 * rows["day"]["num_queries"]
    assert rows["day"]["median_translation_m"] < 0.02
    assert rows["day"]["median_rotation_deg"] < 0.35
    assert rows["elsewhere"]["false_accepts"] == 0
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*")) < 12e6


def test_recordings_that_are_not_there_are_named(
    room: Path, tmp_path: Path, complaint: Callable[..., str]
):
    part = tmp_path / "part"
    shutil.copytree(room, part, ignore=shutil.ignore_patterns("night", "street"))
    (tmp_path / "out").mkdir()
    said = complaint("demo", "--recordings", part, "--out", tmp_path / "out")
    assert "(night, street)" in said
    assert "topoloc simulate demo" in said
    assert "no such folder" in complaint(
        "demo", "--recordings", tmp_path / "nowhere", "--out", tmp_path / "out"
    )


def test_a_read_only_folder_is_an_error_before_the_work(
    room: Path, tmp_path: Path, complaint: Callable[..., str]
):
    (tmp_path / "file").write_text("not a folder")
    assert "it is a file" in complaint("demo", "--recordings", room, "--out", tmp_path / "file")
    assert "cannot write" in complaint(
        "demo", "--recordings", room, "--out", tmp_path / "file" / "below"
    )
    (tmp_path / "out" / "report.html").mkdir(parents=True)
    assert "it is a folder" in complaint("demo", "--recordings", room, "--out", tmp_path / "out")
