"""Run the commands end to end: their printed lines, their files, and equal results in two runs."""

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

from built_room import unseen_views
from peak_memory import PEAK_KB
from topoloc.apps.cli import main
from topoloc.apps.cli.queries.localize import Localizer
from topoloc.geometry.alignment import translation_error
from topoloc.recordings.open import open_sequence
from topoloc.recordings.trajectory import Trajectory

EVALUATION = {
    "num_queries",
    "num_localized",
    "median_translation_m",
    "median_rotation_deg",
    "recall",
    "topological_accuracy",
}
EVALUATION |= {"false_accepts", "median_times_ms", "map"}
EVIDENCE = {"query", "localized", "candidates", "num_matches", "num_inliers", "times_ms"}
PROVENANCE = {"map", "version", "t_ns", "camera", "features"}
SIGMAS = {"position_sigma_m", "rotation_sigma_deg"}
POSE = {"world_from_cam", "covariance", "probability", "node", "evidence", "noise_share"}
STAGES = {"patch_normalization", "features", "coarse", "matching", "pnp", "total"}


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def _without_times(data: dict[str, Any]) -> dict[str, Any]:
    kept = {
        key: value
        for key, value in data.items()
        if key not in ("times_ms", "median_times_ms", "path")
    }
    return kept | {
        name: [_without_times(part) for part in data[name]]
        for name in ("recordings", "answers")
        if name in data
    }


def test_build_and_info_agree_and_building_twice_gives_the_same_map(
    tiny_recording: Path, room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    target, built, told = tmp_path / "room.topo", tmp_path / "build.json", tmp_path / "info.json"
    assert (
        main(
            ["build", str(tiny_recording), str(target), "--features", "surf", "--json", str(built)]
        )
        == 0
    )
    assert f"{target}: " in capsys.readouterr().out
    assert main(["info", str(target), "--json", str(told)]) == 0
    assert "nodes" in capsys.readouterr().out
    info = json.loads(told.read_text())
    assert info == json.loads(built.read_text())
    assert info["num_nodes"] > 3
    assert info["bytes"] == target.stat().st_size
    assert info["coarse"] == ["surf-vlad"]
    assert target.read_bytes() == room_map.read_bytes()


def test_short_settings_and_a_trajectory_file_reach_the_map(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    options = [
        "--trajectory",
        str(tiny_recording / "truth.tum"),
        "--d-thresh",
        "9",
        "--lambda",
        "0.5",
        "--features",
        "sift",
    ]
    assert (
        main(
            ["build", *options, f"{tiny_recording}@0:3", str(tmp_path / "room.topo"), "--json", "-"]
        )
        == 0
    )
    info = json.loads(capsys.readouterr().out)
    assert info["num_nodes"] == 1
    assert info["config"]["nodes"]["d_thresh"] == 9.0
    assert info["config"]["nodes"]["lambda_rot"] == 0.5
    assert info["config"]["features"]["kind"] == "sift"


def test_inverse_poses_are_named_and_mended(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    truth, inverse, target = (
        open_sequence(tiny_recording),
        tmp_path / "inverse.tum",
        str(tmp_path / "a.topo"),
    )
    Trajectory([pose.inverse() for pose in truth.poses if pose is not None], truth.t_ns).write_tum(
        inverse
    )
    build = [
        "build",
        str(tiny_recording),
        target,
        "--features",
        "surf",
        "--trajectory",
        str(inverse),
    ]
    assert main(build) == 1
    assert "--poses inverse" in capsys.readouterr().err
    assert not Path(target).exists()
    assert main([*build, "--poses", "inverse"]) == 0
    assert main([*build, "--poses", "unchecked"]) == 0
    assert main([*build, "--poses", "upside-down"]) == 1


def test_localize_writes_the_documented_json(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    results, trajectory = tmp_path / "results.jsonl", tmp_path / "found.tum"
    assert (
        main(
            [
                "localize",
                str(room_map),
                str(queries),
                "--json",
                str(results),
                "--tum",
                str(trajectory),
            ]
        )
        == 0
    )
    printed = capsys.readouterr()
    assert printed.err == ""
    lines = _lines(results)
    assert len(printed.out.splitlines()) == len(lines) == len(unseen_views())
    for number, line in enumerate(lines):
        assert set(line) == EVIDENCE | PROVENANCE | SIGMAS | POSE
        assert line["query"] == f"view{number:02d}.png"
        assert np.array(line["covariance"]).shape == (6, 6)
        assert set(line["world_from_cam"]) == {"translation", "quat_wxyz"}
        assert line["times_ms"].keys() >= STAGES
        assert all(
            isinstance(node, int) and isinstance(score, float) for node, score in line["candidates"]
        )
    found = Trajectory.read(trajectory)
    assert found.t_ns == [number * 100_000_000 for number in range(len(lines))]
    for line, pose, (_, truth) in zip(lines, found.world_from_cam, unseen_views(), strict=True):
        np.testing.assert_allclose(
            pose.translation, line["world_from_cam"]["translation"], atol=1e-9
        )
        assert translation_error(pose, truth) < 0.02
    assert main(["localize", str(room_map), str(queries), "--json", "-"]) == 0
    again = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [_without_times(line) for line in again] == [_without_times(line) for line in lines]


def test_single_photos_keep_their_order_in_the_trajectory(
    room_map: Path, queries: Path, tmp_path: Path
):
    photos = [str(queries / f"view{number:02d}.png") for number in (4, 0, 2)]
    results, trajectory = tmp_path / "results.jsonl", tmp_path / "found.tum"
    assert (
        main(
            [
                "localize",
                str(room_map),
                *photos,
                "--camera",
                "map",
                "--json",
                str(results),
                "--tum",
                str(trajectory),
            ]
        )
        == 0
    )
    assert [line["query"] for line in _lines(results)] == photos
    found = Trajectory.read(trajectory)
    assert found.t_ns == [0, 1_000_000_000, 2_000_000_000]
    for pose, number in zip(found.world_from_cam, (4, 0, 2), strict=True):
        assert translation_error(pose, unseen_views()[number][1]) < 0.02


def test_one_calibration_in_three_ways_gives_one_answer(
    room_map: Path, queries: Path, capsys: pytest.CaptureFixture[str]
):
    answers = []
    for camera in ("map", "260,260,159.5,119.5", str(queries / "camera.json")):
        assert (
            main(
                [
                    "localize",
                    str(room_map),
                    str(queries / "view01.png"),
                    "--camera",
                    camera,
                    "--json",
                    "-",
                ]
            )
            == 0
        )
        answers.append(_without_times(json.loads(capsys.readouterr().out)))
    assert answers[0]["localized"]
    assert answers[0] == answers[1] == answers[2]


def test_unreadable_pictures_are_results_and_fail_only_alone(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("no picture")
    broken = [str(tmp_path / "empty.png"), str(tmp_path / "text.jpg")]
    results = tmp_path / "results.jsonl"
    assert (
        main(
            [
                "localize",
                str(room_map),
                *broken,
                str(queries / "view00.png"),
                "--json",
                str(results),
            ]
        )
        == 0
    )
    assert capsys.readouterr().err.startswith(
        "warning: 2 of 3 images could not be read; the first: "
    )
    lines = _lines(results)
    assert [line.get("reason") for line in lines] == ["unreadable", "unreadable", None]
    assert "empty" in lines[0]["detail"]
    assert main(["localize", str(room_map), *broken, "--camera", "map"]) == 1
    errors = capsys.readouterr().err
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1


def test_an_interrupted_run_keeps_its_results(
    room_map: Path,
    queries: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    localize = Localizer.localize
    calls = []

    def until_the_third(self: Localizer, *args: Any, **settings: Any) -> Any:
        calls.append(args)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return localize(self, *args, **settings)

    monkeypatch.setattr(Localizer, "localize", until_the_third)
    results = tmp_path / "results.jsonl"
    assert main(["localize", str(room_map), str(queries), "--json", str(results)]) == 1
    assert (
        capsys.readouterr().err
        == f"error: interrupted (results of the 2 queries before: {results})\n"
    )
    assert len(_lines(results)) == 2
    assert os.listdir(tmp_path) == ["results.jsonl"]


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
    assert _without_times(evaluations[0]) == _without_times(evaluations[1])
    page = (tmp_path / "0.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert page.count("<article>") == 8


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
            line["localized"] for line in _lines(tmp_path / "a.json")
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
    for line in _lines(tmp_path / "a.json"):
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
