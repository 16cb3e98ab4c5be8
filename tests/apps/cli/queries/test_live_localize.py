"""Test `topoloc localize` on a live camera, over HTTP from this machine."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mjpeg_camera import mjpeg_camera
from room_stream import room_stream
from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.recordings.trajectory import Trajectory

NUMBERS = f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}"


@pytest.mark.parametrize("options", [(), ("--single",)])
def test_the_newest_pictures_are_localized(
    room_map: Path, tmp_path: Path, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
):
    stream = room_stream()[:12]
    results, found = tmp_path / "results.jsonl", tmp_path / "found.tum"
    with mjpeg_camera([grey for _, grey, _ in stream], 0.15) as url:
        command = [
            "localize",
            str(room_map),
            url,
            "--camera",
            NUMBERS,
            "--json",
            str(results),
            "--tum",
            str(found),
            *options,
        ]
        assert main(command) == 0
    printed = capsys.readouterr()
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    assert f"{url} ended after 12 images, {len(lines)} were localized" in printed.err
    assert len(lines) >= 3
    assert lines[-1]["query"] == "000011"  # the last image is never dropped
    assert all(line["localized"] for line in lines)
    assert ("state" in lines[0]) is not bool(options)
    for line, pose in zip(lines, Trajectory.read(found).world_from_cam, strict=True):
        assert np.linalg.norm(pose.translation - stream[int(line["query"])][2].translation) < 0.05


@pytest.mark.parametrize(
    ("inputs", "status", "said"),
    [
        (["rtsp://127.0.0.1:9/none"], 1, "does not answer"),
        (["rtsp://127.0.0.1:9/none", "--camera", NUMBERS], 1, "does not answer"),
        (
            ["rtsp://127.0.0.1:9/none", "http://127.0.0.1:9/a", "--camera", NUMBERS],
            2,
            "must be the only input",
        ),
        (
            ["rtsp://127.0.0.1:9/none", "--camera", NUMBERS, "--odometry", "odometry.tum"],
            2,
            "recorded stream",
        ),
    ],
)
def test_invalid_options_are_refused(
    room_map: Path, inputs: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
):
    assert main(["localize", str(room_map), *inputs]) == status
    assert said in capsys.readouterr().err
