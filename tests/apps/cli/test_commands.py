"""Run the commands end to end: their printed lines, their files, and equal results in two runs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from documented_json import EVIDENCE, POSE, PROVENANCE, SIGMAS, STAGES, read_lines, without_times

from built_room import unseen_views
from topoloc.apps.cli import main
from topoloc.apps.cli.queries.localize import Localizer
from topoloc.geometry.alignment import translation_error
from topoloc.recordings.open import open_sequence
from topoloc.recordings.trajectory import Trajectory


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
    lines = read_lines(results)
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
    assert [without_times(line) for line in again] == [without_times(line) for line in lines]


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
    assert [line["query"] for line in read_lines(results)] == photos
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
        answers.append(without_times(json.loads(capsys.readouterr().out)))
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
    lines = read_lines(results)
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
    assert len(read_lines(results)) == 2
    assert os.listdir(tmp_path) == ["results.jsonl"]
