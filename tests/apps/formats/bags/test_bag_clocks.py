"""Test header times that begin anew, or are all the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from bag_writing import LEFT, RIGHT, SUFFIXES, Write, bag_writer, by_odometry, by_tf, image, info

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import recording_notes

Poses = Callable[[Write, int, Rigid3], None]
CAMERA = Camera.pinhole(8, 6, 5.0, 5.0, 3.5, 2.5)
SECOND, PERIOD = 10**9, 10**8
COLOUR, DEPTH = "/rgb/image_raw", "/depth_registered/image"
INFOS = {LEFT: "/left/camera_info", RIGHT: "/right/camera_info", COLOUR: "/rgb/camera_info"}


def write_numbered(
    path: Path,
    kind: str,
    stamps: dict[str, Sequence[int]],
    written: Sequence[int] | None = None,
    poses: Poses = by_odometry,
    order: Sequence[int] | None = None,
) -> StereoSequence:
    """Write and open a bag whose pictures have their number as grey value, and whose poses have it
    as x. `stamps` are the header times of each topic of images."""
    first = stamps[next(iter(stamps))]
    written = written or [10 * SECOND + k * PERIOD for k in range(len(first))]
    with bag_writer(path / f"bag{SUFFIXES[kind]}", kind) as write:
        for k in order or range(len(first)):
            for topic, times in stamps.items():
                pixels, encoding = np.full((6, 8), k + 1, np.uint8), "mono8"
                if topic == DEPTH:
                    pixels, encoding = pixels.astype(np.uint16) * 1000, "16UC1"
                else:
                    calibration = info(CAMERA, times[k], 0.1 * (topic == RIGHT))
                    write(INFOS[topic], "sensor_msgs/msg/CameraInfo", written[k], calibration)
                its = image(pixels, times[k], encoding)
                write(topic, "sensor_msgs/msg/Image", written[k] + 1_000_000, its)
            pose = Rigid3(np.eye(3), np.array([float(k), 0.0, 0.0]))
            poses(
                lambda topic, type_name, _, fields, k=k: write(
                    topic, type_name, written[k] + 2_000_000, fields
                ),
                first[k],
                pose,
            )
    return open_sequence(path / f"bag{SUFFIXES[kind]}")


def assert_in_order(sequence: StereoSequence, numbers: Sequence[int]) -> None:
    assert [int(sequence[row].image[0, 0]) - 1 for row in range(len(sequence))] == list(numbers)
    assert (np.diff(sequence.t_ns) > 0).all()


def assert_posed_in_order(sequence: StereoSequence, numbers: Sequence[int]) -> None:
    assert_in_order(sequence, numbers)
    assert [pose and round(pose.translation[0], 6) for pose in sequence.poses] == list(numbers)


# In the second part times lie between those of the first, or repeat them.
RESET = {
    "two parts": [
        *(SECOND + PERIOD * k for k in range(9)),
        *(SECOND + PERIOD * k + 30_000_000 for k in range(7)),
    ],
    "three loops": [SECOND + PERIOD * (k % 6) for k in range(18)],
    "to before the first": [
        *(9 * SECOND + PERIOD * k for k in range(6)),
        *(PERIOD * k for k in range(6)),
    ],
    "from zero": [PERIOD * (k % 8) for k in range(16)],
}


@pytest.mark.parametrize("poses", [by_odometry, by_tf])
@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap-zstd"])
@pytest.mark.parametrize("name", RESET)
def test_parts_of_a_clock_that_was_set_back_follow_each_other(
    name: str, kind: str, poses: Poses, tmp_path: Path
):
    times = RESET[name]
    delayed = [time + 2_000_000 for time in times]
    sequence = write_numbered(tmp_path, kind, {LEFT: times, RIGHT: delayed}, poses=poses)
    assert_posed_in_order(sequence, range(len(times)))
    for row in range(len(times)):
        np.testing.assert_array_equal(sequence[row].image, sequence[row].right)
    (note,) = recording_notes(sequence)
    assert "the clock of /left/image_rect goes back by" in note
    assert "the 2 parts" in note or name == "three loops"


@pytest.mark.parametrize("kind", ["ros1", "ros2", "ros2-mcap"])
def test_a_recorder_may_have_the_clock_that_is_set_back(kind: str, tmp_path: Path):
    times = RESET["two parts"]
    stamps = {COLOUR: times, DEPTH: [time - 5_000_000 for time in times]}
    sequence = write_numbered(tmp_path, kind, stamps, [time + 3_000_000 for time in times])
    assert_posed_in_order(sequence, range(16))
    assert all(sequence[row].depth.depth[0, 0] == row + 1 for row in range(16))


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap-zstd"])
@pytest.mark.parametrize(
    "order",
    [
        sorted(range(40), key=str),  # files listed by name: 0, 1, 10, 11
        [*range(20, 40), *range(20)],
        [1, 0, 3, 2, 5, 4, 7, 6, *range(8, 40)],
        [*range(5), *range(9, 14), *range(5, 9), *range(14, 40)],
    ],
)
def test_messages_of_one_clock_may_lie_in_any_order(order: list[int], kind: str, tmp_path: Path):
    times = [5 * SECOND + PERIOD * k for k in range(40)]
    sequence = write_numbered(tmp_path, kind, {LEFT: times, RIGHT: times}, times, order=order)
    assert_posed_in_order(sequence, range(40))
    assert recording_notes(sequence) == []


@pytest.mark.parametrize("kind", ["ros1-lz4", "ros2-mcap"])
@pytest.mark.parametrize("time", [0, 7 * SECOND])
def test_constant_header_times_are_replaced_by_those_of_writing(
    time: int, kind: str, tmp_path: Path
):
    sequence = write_numbered(tmp_path, kind, {LEFT: [time] * 8, RIGHT: [time] * 8})
    assert_in_order(sequence, range(8))
    assert "the header times of /left/image_rect are 0 or the same" in recording_notes(sequence)[0]


def test_header_times_of_whole_seconds_are_replaced(tmp_path: Path):
    times = [(k // 5 + 3) * SECOND for k in range(20)]
    assert_in_order(write_numbered(tmp_path, "ros2", {LEFT: times}), range(20))


@pytest.mark.parametrize("constant", [COLOUR, DEPTH])
def test_constant_times_of_one_topic(constant: str, tmp_path: Path):
    """The poses have header times. The other topic keeps them, too."""
    times = [10 * SECOND + PERIOD * k for k in range(8)]
    stamps = {topic: [SECOND] * 8 if topic == constant else times for topic in (COLOUR, DEPTH)}
    sequence = write_numbered(tmp_path, "ros2", stamps)
    assert_in_order(sequence, range(8))
    assert all(sequence[row].depth.depth[0, 0] == row + 1 for row in range(8))
    if constant == DEPTH:
        assert_posed_in_order(sequence, range(8))


def test_poses_of_one_time_get_those_of_writing(tmp_path: Path):
    def poses(write: Write, t_ns: int, pose: Rigid3) -> None:
        by_odometry(write, SECOND, pose)

    times = [10 * SECOND + 2_000_000 + PERIOD * k for k in range(8)]
    assert_posed_in_order(write_numbered(tmp_path, "ros2", {LEFT: times}, poses=poses), range(8))


def test_a_robot_that_stands_has_poses(tmp_path: Path):
    def poses(write: Write, t_ns: int, _: Rigid3) -> None:
        by_tf(write, t_ns, Rigid3.identity())

    times = [10 * SECOND + PERIOD * k for k in range(8)]
    sequence = write_numbered(tmp_path, "ros2", {LEFT: times}, poses=poses)
    assert all(pose is not None for pose in sequence.poses)
    assert recording_notes(sequence) == []


def test_pictures_that_are_lost_to_equal_times_are_counted(tmp_path: Path):
    times = [SECOND + PERIOD * max(k, 3) for k in range(10)]
    sequence = write_numbered(tmp_path, "ros2", {LEFT: times})
    assert len(sequence) == 7
    assert "3 pictures of /left/image_rect have the time of another one" in "".join(
        recording_notes(sequence)
    )


def test_a_topic_that_was_recorded_twice_is_no_loss(tmp_path: Path):
    with bag_writer(tmp_path / "bag", "ros2") as write:
        for k in range(6):
            for _ in range(2):
                its = image(np.full((6, 8), k, np.uint8), SECOND + PERIOD * k)
                write("/image_raw", "sensor_msgs/msg/Image", 2 * SECOND + PERIOD * k, its)
    sequence = open_sequence(tmp_path / "bag")
    assert len(sequence) == 6
    assert recording_notes(sequence) == []
