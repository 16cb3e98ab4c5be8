"""Test the reading of gyroscopes beside a stream, and `topoloc follow --imu` as it is typed."""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_world import path_pose, render, room
from topoloc import CalibrationError, RecordingError
from topoloc.apps.cli import main
from topoloc.apps.robots.config import RobotConfig
from topoloc.apps.robots.imu import make_gyroscope, read_imu, take_from_file, take_from_topic
from topoloc.apps.robots.ros_node import RosNode
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3

CAM_FROM_IMU = exp_so3(np.array([0.4, -1.9, 0.7]))


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        (
            "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
            "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]",
            ["1403715273262142976,0.1,0.2,0.3,9.8,0,0", "1403715273267142976,0.4,0.5,0.6,9.8,0,0"],
        ),
        (  # Sensor Logger
            "time,seconds_elapsed,z,y,x",
            ["1403715273262142976,0.1,0.3,0.2,0.1", "1403715273267142976,0.105,0.6,0.5,0.4"],
        ),
        (  # phyphox
            '"Time (s)";"Gyroscope x (rad/s)";"Gyroscope y (rad/s)";"Gyroscope z (rad/s)"',
            ["1403715273.262142976;1E-1;2E-1;3E-1", "1403715273.267142976;0.4;0.5;0.6"],
        ),
        (
            "Timestamp[nanosec], gx[deg/s], gy[deg/s], gz[deg/s], ax[m/s^2], ay[m/s^2], az[m/s^2]",
            [
                ",".join(["1403715273262142976", *(str(math.degrees(k / 10)) for k in (1, 2, 3))]),
                ",".join(["1403715273267142976", *(str(math.degrees(k / 10)) for k in (4, 5, 6))]),
            ],
        ),
        (None, ["1403715273262142976,0.1,0.2,0.3", "1403715273267142976,0.4,0.5,0.6"]),
    ],
)
def test_files_of_phones_and_of_euroc_are_read_alike(
    header: str | None, rows: list[str], tmp_path: Path
):
    file = tmp_path / "imu.csv"
    file.write_text("\n".join([header, *rows] if header else rows) + "\n\n")
    samples = read_imu(file)
    assert [t_ns for t_ns, _ in samples] == [1403715273262142976, 1403715273267142976]
    np.testing.assert_allclose(
        [rate for _, rate in samples], [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no samples of a gyroscope"),
        ("time,x,y,z\n1,0,0,0\n", "no samples of a gyroscope"),
        ("time,accel_x,accel_y,accel_z\n1,0,0,0\n2,0,0,0\n", "line 1: no columns of a gyroscope"),
        ("time,x,y,z\n1,0,0,0\n2,0,nan,0\n", "line 3: '2,0,nan,0' lacks"),
        ("time,x,y,z\n1,0,0,0\n2,0\n", "line 3: '2,0' lacks"),
        ("time,x,y,z\n2,0,0,0\n1,0,0,0\n", "line 3: time 1 is not after the one before"),
    ],
)
def test_files_that_are_no_gyroscope_are_refused_in_one_line(text: str, words: str, tmp_path: Path):
    file = tmp_path / "imu.csv"
    file.write_text(text)
    with pytest.raises(RecordingError) as caught:
        read_imu(file)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_clock_is_refused_at_the_first_image(tmp_path: Path):
    file = tmp_path / "imu.csv"
    file.write_text("".join(f"{100 + k / 100:.2f},0,0,0\n" for k in range(200)))
    with pytest.raises(RecordingError, match=r"100\.000 to 101\.990 s, do not hold .* 5\.000 s"):
        take_from_file(file)(5_050_000_000)
    take = take_from_file(file)
    assert [len(list(take(100_000_000_000 + k * 500_000_000))) for k in (1, 2)] == [51, 50]


@pytest.mark.parametrize("text", ["1,0,0", "1,0,0,0,0", "2,0,0,0", "nan,0,0,1", "x,0,0,0"])
def test_a_rotation_that_is_none_is_refused(text: str):
    with pytest.raises(CalibrationError, match="no rotation; a quaternion w,x,y,z"):
        make_gyroscope(text)


def _write_walk(folder: Path, num: int) -> list[Rigid3]:
    """Write images of a hand that turns the camera, thirty a second, and return their poses."""
    poses = [
        path_pose(3.0 + 0.1 * k)
        @ Rigid3(
            exp_so3(0.12 * np.array([np.sin(0.7 * k), np.sin(0.9 * k), np.sin(1.3 * k)])),
            np.zeros(3),
        )
        for k in range(num)
    ]
    folder.mkdir()
    for k, pose in enumerate(poses):
        cv2.imwrite(str(folder / f"{k:06d}.png"), render(room(), pose, noise_seed=900 + k)[0])
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6f}\n" for k in range(num)))
    return poses


def _write_imu(file: Path, poses: list[Rigid3], sign: float = 1.0) -> None:
    """Write the rates of the poses in axes of an IMU, left-handed if `sign` is -1."""
    lines = ["#timestamp [ns],w_x,w_y,w_z"]
    for k, (before, after) in enumerate(pairwise(poses)):
        turn = log_so3(before.rotation.T @ after.rotation) / 0.1
        rate = sign * CAM_FROM_IMU.T @ turn
        times = range(100_000_000 * k, 100_000_000 * (k + 1), 10_000_000)
        lines += [",".join([str(time), *(f"{value:.9f}" for value in rate)]) for time in times]
    file.write_text("\n".join(lines))


def test_a_walk_finds_the_axes_of_its_gyroscope_or_names_what_is_wrong(
    room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    poses, imu = _write_walk(tmp_path / "walk", 40), tmp_path / "imu.csv"
    command = ["follow", str(room_map), str(tmp_path / "walk"), "--camera", "map", "--imu"]
    _write_imu(imu, poses)
    assert main([*command, str(imu)]) == 0
    (line,) = [one for one in capsys.readouterr().err.splitlines() if "gyroscope" in one]
    found = re.search(r"--cam-from-imu (\S+), bias", line)
    assert found is not None
    rotation = make_gyroscope(found[1])._given
    assert rotation is not None
    assert Rigid3(rotation.T @ CAM_FROM_IMU, np.zeros(3)).angle() < np.radians(3.0)
    _write_imu(imu, poses, sign=-1.0)
    assert main([*command, str(imu)]) == 0
    (line,) = [one for one in capsys.readouterr().err.splitlines() if "gyroscope" in one]
    assert line.startswith(f"warning: {imu}: the gyroscope is not used: the axes are left-handed")


def test_options_that_need_each_other_are_named(complaint: Callable[..., str], room_map: Path):
    assert "--cam-from-imu needs --imu" in complaint(
        "follow", room_map, "walk", "--cam-from-imu", "1,0,0,0", status=2
    )
    words = complaint("follow", room_map, "ros:/camera/image_raw", "--imu", "imu.csv", status=2)
    assert "give --imu ros:TOPIC" in words
    words = complaint("follow", room_map, "walk", "--imu", "ros:/imu", status=2)
    assert "give --imu FILE" in words


def test_a_topic_of_ros_gives_its_samples_in_order():
    pytest.importorskip("cyclonedds", reason="the extra ros is not installed")
    domain = 100 + os.getpid() % 100
    nodes = [RosNode(RobotConfig(domain=domain)) for _ in range(2)]
    take = take_from_topic(nodes[0], "ros:/imu")
    ros = nodes[1].messages
    write = nodes[1].create_writer("/imu", ros.Imu)
    zero, heard = ros.Vector3(0.0, 0.0, 0.0), list[tuple[int, list[float]]]()
    end, k = time.monotonic() + 10.0, 0
    while len(heard) < 5 and time.monotonic() < end:
        k += 1
        header = ros.Header(ros.Time(7, k), "imu_link")
        rate = ros.Vector3(0.1, 0.2, 0.3)
        still = ros.Quaternion(0.0, 0.0, 0.0, 1.0), [0.0] * 9
        write(ros.Imu(header, *still, rate, [0.0] * 9, zero, [0.0] * 9))
        time.sleep(0.02)
        heard += [(t_ns, rate.tolist()) for t_ns, rate in take(0)]
    for node in nodes:
        node.close()
    assert len(heard) >= 5
    assert [t_ns for t_ns, _ in heard] == sorted({t_ns for t_ns, _ in heard})
    assert heard[0][0] > 7_000_000_000
    assert heard[0][1] == [0.1, 0.2, 0.3]
    with pytest.raises(RecordingError, match="no topic of ROS; ros:/imu is expected"):
        take_from_topic(nodes[0], "ros:/a b")
