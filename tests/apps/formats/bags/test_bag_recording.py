"""Check that a bag equals its source recording: images, times, calibration and poses."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_writing import (
    FEATURE_TYPES,
    LEFT,
    RIGHT,
    Write,
    bag_writer,
    by_odometry,
    by_pose,
    by_tf,
    image,
    info,
    transform,
    write_stereo_bag,
)

from built_room import built_room
from tiny_recordings import assert_slices
from topoloc.errors import (
    RecordingError,
    TrajectoryError,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import as_monocular, recording_notes

BagOf = Callable[..., Path]
CAMERA = Camera.pinhole(64, 48, 50.0, 51.0, 31.0, 24.5)


def assert_same(one: StereoSequence, other: StereoSequence) -> None:
    assert len(one) == len(other)
    assert one.t_ns == other.t_ns
    for index in range(len(one)):
        a, b = one[index], other[index]
        np.testing.assert_array_equal(a.image, b.image)
        assert a.camera == b.camera
        assert a.t_ns == b.t_ns
        assert a.right is not None
        assert b.right is not None
        np.testing.assert_array_equal(a.right, b.right)
        assert a.rig is not None
        assert b.rig is not None
        assert (a.rig.left, a.rig.right, a.rig.is_rectified) == (
            b.rig.left,
            b.rig.right,
            b.rig.is_rectified,
        )
        np.testing.assert_allclose(
            a.rig.right_from_left.matrix(), b.rig.right_from_left.matrix(), atol=1e-9
        )
        assert a.world_from_cam is not None
        assert b.world_from_cam is not None
        np.testing.assert_allclose(a.world_from_cam.matrix(), b.world_from_cam.matrix(), atol=1e-9)


@pytest.mark.parametrize("is_compressed", [False, True], ids=["raw", "compressed"])
@pytest.mark.parametrize("kind", FEATURE_TYPES)
def test_a_bag_is_the_recording_it_was_made_of(
    kind: str, is_compressed: bool, walk: StereoSequence, bag_of: BagOf
):
    path = bag_of(kind, is_compressed=is_compressed)
    assert find_format(path) == ("mcap" if kind == "mcap-zstd" else "rosbag")
    sequence = open_sequence(path)
    assert recording_notes(sequence) == []
    assert_same(walk, sequence)
    assert_same(walk, open_sequence(f"{path}@0:5"))
    assert_slices(sequence)


@pytest.mark.parametrize("poses", [by_tf, by_odometry, by_pose])
def test_poses_come_from_the_available_topics(
    poses: Callable[[Write, int, Rigid3], None], walk: StereoSequence, bag_of: BagOf
):
    sequence = open_sequence(bag_of("ros2", poses=poses))
    assert_same(walk, sequence)
    assert ("it does not say whose they are" in " ".join(recording_notes(sequence))) == (
        poses is by_pose
    )


def test_a_real_recording_as_a_bag(shared: Path, tmp_path: Path):
    lab = open_sequence(shared / "data/zed_lab/session1@0:60:20")
    assert_same(lab, open_sequence(write_stereo_bag(tmp_path / "lab", "ros2", lab)))
    assert_same(lab, open_sequence(write_stereo_bag(tmp_path / "lab.mcap", "mcap-zstd", lab)))


def test_the_parts_of_a_split_bag_are_one_recording(walk: StereoSequence, tmp_path: Path):
    for number, part in enumerate((range(2), range(2, 5))):
        made = write_stereo_bag(tmp_path / f"part{number}", "ros2", _part(walk, part))
        os.renames(next(made.glob("*.db3")), tmp_path / "whole" / f"walk_{number}.db3")
    sequence = open_sequence(tmp_path / "whole")
    assert sequence.t_ns == walk.t_ns
    np.testing.assert_array_equal(sequence[4].image, walk[4].image)


def _part(sequence: StereoSequence, part: range) -> StereoSequence:
    from topoloc.recordings.frame import sequence_subset

    return sequence_subset(sequence, list(part))


def test_given_topics_override_the_guess(walk: StereoSequence, bag_of: BagOf):
    path = bag_of("ros2")
    swapped = {"left": RIGHT, "right": "none", "pose": "none"}
    sequence = open_sequence(path, topics=swapped)
    np.testing.assert_array_equal(sequence[1].image, walk[1].right)
    assert sequence.poses == [None] * len(walk)
    assert sequence[0].right is None
    text = f"left={LEFT}, right={RIGHT},pose=tf"
    assert_same(walk, open_sequence(path, topics=text))


def test_pose_frame_names_the_frame_of_the_poses(walk: StereoSequence, tmp_path: Path):
    """The topic has poses of a body but no frame name. Static TF has the camera's
    place on the body."""
    body_from_cam = Rigid3.exp(np.array([0.1, -0.2, 0.05, 0.3, 1.2, -0.4]))

    def poses(write: Write, t_ns: int, world_from_cam: Rigid3) -> None:
        by_pose(write, t_ns, world_from_cam @ body_from_cam.inverse())
        by_tf(
            lambda topic, *rest: write(topic, *rest) if topic == "/tf_static" else None,
            t_ns,
            world_from_cam,
        )

    path = write_stereo_bag(tmp_path / "body", "ros2", walk, poses)
    sequence = open_sequence(path, topics="left=/left/image_rect,pose=/pose,pose_frame=base_link")
    assert recording_notes(sequence) == []
    assert_same(walk, sequence)
    with pytest.raises(TrajectoryError, match="no fixed transform from left_optical to wheel"):
        open_sequence(path, topics="left=/left/image_rect,pose=/pose,pose_frame=wheel")


def test_poses_between_those_of_the_bag_are_interpolated(tmp_path: Path):
    with bag_writer(tmp_path / "bag", "ros2") as write:
        for index in range(4):
            t_ns = 10**18 + index * 100_000_000
            write(
                "/image_raw",
                "sensor_msgs/msg/Image",
                t_ns,
                image(np.zeros((48, 64), np.uint8), t_ns),
            )
            write("/camera_info", "sensor_msgs/msg/CameraInfo", t_ns, info(CAMERA, t_ns))
            by_odometry(
                write, t_ns - 50_000_000, Rigid3(np.eye(3), np.array([index - 0.5, 0.0, 0.0]))
            )
    sequence = open_sequence(tmp_path / "bag")
    assert [
        None if pose is None else pytest.approx(pose.translation[0]) for pose in sequence.poses
    ] == [0.0, 1.0, 2.0, None]
    assert sequence[0].camera == CAMERA


def test_odometry_is_used_if_tf_does_not_reach_the_camera(walk: StereoSequence, tmp_path: Path):
    def poses(write: Write, t_ns: int, world_from_cam: Rigid3) -> None:
        by_odometry(write, t_ns, world_from_cam)
        write(
            "/tf",
            "tf2_msgs/msg/TFMessage",
            t_ns,
            {"transforms": [transform(world_from_cam, t_ns, "map", "another_robot")]},
        )

    path = write_stereo_bag(tmp_path / "two", "ros2", walk, poses)
    assert_same(walk, open_sequence(path))
    with pytest.raises(
        TrajectoryError, match="no pose of left_optical at the times of the pictures in tf"
    ):
        open_sequence(path, topics="pose=tf")


def test_poses_of_another_time_are_none(walk: StereoSequence, tmp_path: Path):
    path = write_stereo_bag(
        tmp_path / "late",
        "ros2",
        walk,
        lambda write, t_ns, pose: by_odometry(write, t_ns + 10**12, pose),
    )
    sequence = open_sequence(path)
    assert sequence.poses == [None] * len(walk)
    assert recording_notes(sequence) == [
        f"{path}: no pose of left_optical at the times of the pictures in /odom; the recording is"
        " taken as one without poses"
    ]


def test_the_map_of_a_bag_is_that_of_its_recording(
    tiny_recording: Path, room_map: Path, tmp_path: Path
):
    path = write_stereo_bag(tmp_path / "room.bag", "ros1", open_sequence(tiny_recording))
    built, expected = built_room(path), TopoMetricMap.load(room_map)
    assert len(built.nodes) == len(expected.nodes)
    for node, other in zip(built.nodes, expected.nodes, strict=True):
        np.testing.assert_allclose(
            node.summary.world_from_cam.matrix(), other.summary.world_from_cam.matrix(), atol=1e-9
        )
        np.testing.assert_allclose(node.points_cam, other.points_cam, rtol=2**-16)


def test_depth_with_its_own_camera(tmp_path: Path):
    """Unregistered depth in mm has its own camera. TF gives its place beside the colour camera."""
    depth = np.full((48, 64), 1500, np.uint16)
    depth[0, :2] = 0, 65535
    cam_from_depth = Rigid3(np.eye(3), np.array([-0.015, 0.0, 0.0]))
    with bag_writer(tmp_path / "rgbd.bag", "ros1") as write:
        for index in range(3):
            t_ns = 10**18 + index * 33_000_000
            colour = np.full((48, 64, 3), (10, 20, 30 + index), np.uint8)
            write(
                "/camera/color/image_raw",
                "sensor_msgs/msg/Image",
                t_ns,
                image(colour, t_ns, frame="color"),
            )
            write(
                "/camera/color/camera_info",
                "sensor_msgs/msg/CameraInfo",
                t_ns,
                info(CAMERA, t_ns, frame="color"),
            )
            write(
                "/camera/depth/image_rect_raw",
                "sensor_msgs/msg/Image",
                t_ns,
                image(depth, t_ns + 4_000_000, "16UC1", "depth"),
            )
            write(
                "/camera/depth/camera_info",
                "sensor_msgs/msg/CameraInfo",
                t_ns,
                info(CAMERA, t_ns, frame="depth"),
            )
            write(
                "/tf_static",
                "tf2_msgs/msg/TFMessage",
                t_ns,
                {"transforms": [transform(cam_from_depth, t_ns, "color", "depth")]},
            )
    sequence = open_sequence(tmp_path / "rgbd.bag")
    frame = sequence[2]
    assert frame.image[5, 5].tolist() == [10, 20, 32]
    assert frame.depth is not None
    assert frame.depth.depth[1, 1] == 1.5
    assert np.isnan(frame.depth.depth[0, :2]).all()
    np.testing.assert_allclose(frame.depth.cam_from_depth.matrix(), cam_from_depth.matrix())
    assert as_monocular(sequence)[2].depth is None


def test_images_without_a_partner_are_dropped_and_reported(walk: StereoSequence, tmp_path: Path):
    def without(number: int, delay_ns: int = 0) -> StereoSequence:
        path = tmp_path / f"without{number}_{delay_ns}"
        with bag_writer(path, "ros2") as write:
            for index in range(4):
                frame = walk[index]
                assert frame.right is not None
                write(LEFT, "sensor_msgs/msg/Image", frame.t_ns, image(frame.image, frame.t_ns))
                write(
                    "/left/camera_info",
                    "sensor_msgs/msg/CameraInfo",
                    frame.t_ns,
                    info(CAMERA, frame.t_ns),
                )
                write(
                    "/right/camera_info",
                    "sensor_msgs/msg/CameraInfo",
                    frame.t_ns,
                    info(CAMERA, frame.t_ns, 0.1),
                )
                if index != number:
                    write(
                        RIGHT,
                        "sensor_msgs/msg/Image",
                        frame.t_ns,
                        image(frame.right, frame.t_ns + delay_ns),
                    )
        return open_sequence(path)

    sequence = without(1, 3_000_000)
    assert sequence.t_ns == [walk.t_ns[index] for index in (0, 2, 3)]
    assert (
        "1 of 4 pictures of /left/image_rect have none of /right/image_rect (3) within 5 ms and are"
        " left out" in recording_notes(sequence)[0]
    )
    with pytest.raises(
        RecordingError, match=r"4 of 4 pictures .* within 5 ms; the nearest is 20\.0 ms away"
    ):
        without(9, 20_000_000)
