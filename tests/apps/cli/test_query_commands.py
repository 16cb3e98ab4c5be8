"""Test the commands that query a map: JSON, reports, times and limits."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from documented_json import EVALUATION, EVIDENCE, PROVENANCE, read_lines, without_times

from built_room import unseen_views
from peak_memory import PEAK_KB
from topoloc.apps.cli import main
from topoloc.apps.cli.queries.localize import Localizer
from topoloc.localization.result import NotLocalized, result_from_json


def test_evaluate_writes_the_documented_json(
    room_map: Path,
    queries: Path,
    elsewhere: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    evaluations = []
    for number, report in ((0, ["--report", str(tmp_path / "0.html")]), (1, [])):
        files = ["--json", str(tmp_path / f"{number}.json"), *report]
        assert (
            main(["evaluate", str(room_map), str(queries), "--elsewhere", str(elsewhere), *files])
            == 0
        )
        evaluations.append(json.loads((tmp_path / f"{number}.json").read_text()))
    printed = capsys.readouterr()
    assert "false accepts" in printed.out
    assert printed.out.count("quarter by  hardest to easiest") == 2
    assert printed.err == ""
    evaluation = evaluations[0]
    assert evaluation.keys() >= EVALUATION
    assert evaluation["map"].keys() >= {"num_nodes", "bytes", "length_m"}
    assert evaluation["recall"].keys() >= {"0.05m_5deg", "0.25m_2deg"}
    assert evaluation["num_queries"] == evaluation["num_localized"] == len(unseen_views())
    assert evaluation["median_translation_m"] < 0.01
    assert evaluation["recall"]["0.05m_5deg"] == 1.0
    assert len(evaluation["answers"]) == evaluation["num_queries"] + evaluation["num_elsewhere"]
    assert (evaluation["num_elsewhere"], evaluation["false_accepts"]) == (
        len(unseen_views(1, 4.0)),
        0,
    )
    assert without_times(evaluations[0]) == without_times(evaluations[1])
    page = (tmp_path / "0.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert page.count("<article>") == 8
    assert "Where it is hard" in page
    quarters = {one["by"]: one for one in evaluation["quarters"]}  # the easiest by each
    assert quarters.keys() == {"inliers", "angle", "light"}
    assert quarters["inliers"]["num_right"] == quarters["inliers"]["num_poses"]


def test_a_map_from_truth_moves_the_truth(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shift = np.eye(4)
    shift[0, 3] = 3.0
    (tmp_path / "shift.json").write_text(
        json.dumps({"map_from_truth": shift.tolist(), "note": "three metres to x"})
    )
    options = ["--map-from-truth", str(tmp_path / "shift.json"), "--json", "-"]
    assert main(["evaluate", str(room_map), f"{queries}@0:2", *options]) == 0
    evaluation = json.loads(capsys.readouterr().out)
    assert evaluation["median_translation_m"] == pytest.approx(3.0, abs=0.02)
    assert evaluation["false_accepts"] == 2


def test_a_report_needs_no_truth(
    room_map: Path, elsewhere: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    report = tmp_path / "report.html"
    assert (
        main(["evaluate", str(room_map), "--elsewhere", str(elsewhere), "--report", str(report)])
        == 0
    )
    assert "out-of-map images" in report.read_text()
    assert "median error" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "picture",
    [
        np.zeros((1, 1), np.uint8),
        np.zeros((1, 1500), np.uint8),
        np.zeros((240, 320), np.uint8),
        np.full((240, 320, 3), 255, np.uint8),
        np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8),
        unseen_views(seed=1, step=4.0)[0][0],
    ],
    ids=["1x1", "1x1500", "black", "white", "noise", "another world"],
)
def test_an_out_of_map_image_is_not_localized(
    picture: np.ndarray, room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert cv2.imwrite(str(tmp_path / "query.png"), picture)
    height, width = picture.shape[:2]
    camera = f"260,260,{(width - 1) / 2},{(height - 1) / 2}"
    assert (
        main(
            [
                "localize",
                str(room_map),
                str(tmp_path / "query.png"),
                "--camera",
                camera,
                "--json",
                "-",
            ]
        )
        == 0
    )
    printed = capsys.readouterr()
    line = json.loads(printed.out)
    assert set(line) == EVIDENCE | PROVENANCE | {"reason", "detail", "alternatives"}
    assert not line["localized"]
    assert line["reason"] in ("too_few_matches", "too_few_inliers", "not_in_map")
    assert printed.err == ""


def test_poses_less_precise_than_the_tolerance_are_refused_with_the_pose(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    answers = dict[str, list[dict[str, Any]]]()
    for tolerance in ("0.5,5", "0.001,0.001"):
        out = tmp_path / f"{tolerance}.jsonl"
        main(
            ["localize", str(room_map), str(queries), "--tolerance", tolerance, "--json", str(out)]
        )
        answers[tolerance] = read_lines(out)
    assert all(one["localized"] for one in answers["0.5,5"])
    for given, refused in zip(*answers.values(), strict=True):
        assert refused["reason"] == "imprecise"
        assert refused["detail"].startswith("in the map, but where is known to 0.0")
        (pose,) = refused["alternatives"]
        assert pose["world_from_cam"] == given["world_from_cam"]
        assert pose["covariance"] == given["covariance"]
        read = result_from_json(json.dumps(refused))
        assert isinstance(read, NotLocalized)
        assert read.alternatives[0].covariance is not None
    capsys.readouterr()
    for wrong in ("x", "1", "0,1", "1,nan"):
        assert main(["localize", str(room_map), str(queries), "--tolerance", wrong]) == 2
        printed = capsys.readouterr().err
        assert printed.startswith("error: --tolerance")
        assert printed.count("\n") == 1


def test_a_query_may_be_given_a_time(
    room_map: Path, queries: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    given: list[float | None] = []
    opened = Localizer.__init__

    def told(self: Localizer, *arguments: Any, **settings: Any) -> None:
        opened(self, *arguments, **settings)
        given.append(self.config.max_ms)

    monkeypatch.setattr(Localizer, "__init__", told)
    settings_file = tmp_path / "my.toml"
    settings_file.write_text("[localize]\nmax_ms = 50.0\n")
    by_file = ["--config", str(settings_file)]
    for options in ([], ["--max-ms", "0"], by_file, [*by_file, "--max-ms", "80"]):
        assert (
            main(
                [
                    "localize",
                    str(room_map),
                    str(queries),
                    "--json",
                    str(tmp_path / "a.json"),
                    *options,
                ]
            )
            == 0
        )
        assert all(
            line["localized"] for line in read_lines(tmp_path / "a.json")
        )  # the first hypothesis of each is clear
    assert given == [None, 0.0, 50.0, 80.0]


def test_a_query_without_a_pose_reports_the_time_limit(
    room_map: Path, elsewhere: Path, tmp_path: Path
):
    assert (
        main(
            [
                "localize",
                str(room_map),
                str(elsewhere),
                "--max-ms",
                "0",
                "--json",
                str(tmp_path / "a.json"),
            ]
        )
        == 0
    )
    for line in read_lines(tmp_path / "a.json"):
        assert not line["localized"]
        assert "time was up" in line["detail"]


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_fifty_megapixels_need_little_memory_and_no_matplotlib(room_map: Path, tmp_path: Path):
    picture = cv2.resize(unseen_views()[3][0], (8160, 6120), interpolation=cv2.INTER_NEAREST)
    assert cv2.imwrite(str(tmp_path / "large.jpg"), cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    code = PEAK_KB + (
        "import sys; from topoloc.apps.cli import main\nstatus = main(sys.argv[1:])\n"
        "print(status, peak_kb(), 'matplotlib' in sys.modules)"
    )
    command = [
        sys.executable,
        "-c",
        code,
        "localize",
        str(room_map),
        str(tmp_path / "large.jpg"),
        "--camera",
        "map",
        "--json",
        "-",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.stderr == ""
    line, last = done.stdout.splitlines()
    assert json.loads(line)["query"] == "large.jpg"
    status, peak, matplotlib_loaded = last.split()
    assert (status, matplotlib_loaded) == ("0", "False")
    assert int(peak) < 1_000_000  # kB


@pytest.mark.parametrize(("given", "expected"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_blas_has_one_thread_unless_the_user_sets_more(given: dict[str, str], expected: str):
    environment = {
        name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"
    } | given
    code = (
        "import os, sys, topoloc.apps.cli; print(os.environ['OPENBLAS_NUM_THREADS'], 'numpy' in"
        " sys.modules)"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert said.split() == [expected, "False"]
