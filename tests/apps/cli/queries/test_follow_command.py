"""Test `topoloc follow`: it prints one line per image and stops on a signal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from mjpeg_camera import mjpeg_camera
from topoloc.apps.cli import main

ROOT = Path(__file__).parents[4]


def _lines(capsys: pytest.CaptureFixture[str], *args: object) -> list[str]:
    capsys.readouterr()
    assert main(["follow", *map(str, args)]) == 0
    return capsys.readouterr().out.splitlines()


def test_a_recording_is_answered_as_the_stream_that_it_is(
    room_map: Path, tiny_recording: Path, capsys: pytest.CaptureFixture[str]
):
    followed = [json.loads(line) for line in _lines(capsys, room_map, f"{tiny_recording}@0:4")]
    assert main(["localize", str(room_map), f"{tiny_recording}@0:4", "--json", "-"]) == 0
    localized = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    for one in (*followed, *localized):
        one.pop("times_ms")
    assert followed == localized
    assert followed[0]["state"] == "localized"
    (first, *_) = _lines(capsys, room_map, f"{tiny_recording}@0:1", "--plain")
    assert "localized" in first


def test_a_camera_that_runs_is_followed_until_it_ends(
    room_map: Path, tiny_recording: Path, capsys: pytest.CaptureFixture[str]
):
    pictures = [
        cv2.imread(str(path)) for path in sorted((tiny_recording / "image_0").iterdir())[:4]
    ]
    before_ns = time.time_ns()
    with mjpeg_camera([picture for picture in pictures if picture is not None], 0.5) as url:
        answers = [json.loads(line) for line in _lines(capsys, room_map, url, "--camera", "map")]
    assert 1 <= len(answers) <= 4
    assert answers[0]["state"] == "localized"
    assert before_ns < answers[0]["t_ns"] <= answers[-1]["t_ns"] < time.time_ns()


def test_it_stops_on_a_signal(room_map: Path, tiny_recording: Path, tmp_path: Path):
    """The stream would last for minutes: two thousand images, the same four again and again."""
    pictures = sorted((tiny_recording / "image_0").iterdir())[:4]
    for number in range(2000):
        (tmp_path / f"{number:06d}.png").symlink_to(pictures[number % 4])
    command = [
        sys.executable,
        "-m",
        "topoloc",
        "follow",
        str(room_map),
        str(tmp_path),
        "--camera",
        "map",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        process.send_signal(signal.SIGTERM)
        rest, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (0, "")
    assert first["state"] == "localized"
    lines = [json.loads(line) for line in rest.splitlines()]
    assert len(lines) < 1000


def test_invalid_sources_are_one_line(complaint: Callable[..., str], room_map: Path):
    assert "no such camera or stream" in complaint("follow", room_map, "/dev/video77")
    assert "ros:/a b: no topic of ROS" in complaint("follow", room_map, "ros:/a b")


def test_options_of_robots_need_ros(complaint: Callable[..., str], room_map: Path):
    assert "--planar needs --ros" in complaint("follow", room_map, "0", "--planar", status=2)
    both = ("--ros", "--planar", "--odom", "none")
    assert "--planar is of a robot with odometry" in complaint(
        "follow", room_map, "0", *both, status=2
    )
    assert "--odom needs --ros" in complaint("follow", room_map, "0", "--odom", "none", status=2)
    frame = ("--base-frame", "base_footprint")
    assert "--base-frame needs --ros" in complaint("follow", room_map, "0", *frame, status=2)


def _still_recording(tiny_recording: Path, folder: Path) -> Path:
    """Write a recording of a camera whose images are equal, ten per second for three seconds."""
    picture = min((tiny_recording / "image_0").iterdir()).read_bytes()
    (folder / "images").mkdir(parents=True)
    for number in range(30):
        (folder / "images" / f"{number:06d}.png").write_bytes(picture)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.9f}\n" for k in range(30)))
    (folder / "camera.json").write_bytes((tiny_recording / "camera.json").read_bytes())
    return folder


def test_equal_images_are_no_evidence_unless_they_are_simulated(
    room_map: Path, tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    still = _still_recording(tiny_recording, tmp_path / "still")
    assert main(["follow", str(room_map), str(still)]) == 0
    out, said = capsys.readouterr()
    states = [json.loads(line)["state"] for line in out.splitlines()]
    assert states == ["localized"] * 10 + ["lost"] * 20
    assert said == (
        f"warning: {still}: the images are equal: the camera hangs, or stands in a simulator"
        " without noise; restart its driver, or for a simulator give --simulated of `follow`"
        " (setting track.simulated)\n"
    )
    assert main(["follow", str(room_map), str(still), "--simulated"]) == 0
    out, said = capsys.readouterr()
    answers = [json.loads(line) for line in out.splitlines()]
    assert [one["state"] for one in answers] == ["localized"] * 30
    assert all(one["covariance"] == answers[0]["covariance"] for one in answers)
    assert said == ""
