"""Check that a bag equals its source recording: images, times, calibration and poses."""

from __future__ import annotations

import os
import resource
import sys
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
from topoloc.apps.formats.bags import bag as bag_module, messages
from topoloc.errors import (
    CalibrationError,
    MissingExtraError,
    RecordingError,
    TrajectoryError,
    UnreadableImageError,
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
        np.testing.assert_array_equal(node.points_cam, other.points_cam)


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


def test_a_missing_topic_is_named_with_the_existing_ones(
    bag_of: BagOf, tmp_path: Path, complaint: Callable[..., str]
):
    path = bag_of("ros2")
    said = complaint("build", path, tmp_path / "map.topo", "--topics", "left=/left/image_raw")
    assert "no topic /left/image_raw for left; did you mean /left/image_rect?" in said
    assert "/right/image_rect (sensor_msgs/msg/Image)" in said
    assert "/tf (tf2_msgs/msg/TFMessage), which cannot be" not in said
    assert "/tf is tf2_msgs/msg/TFMessage, which cannot be left" in complaint(
        "slam", path, tmp_path / "o.tum", "--topics", "left=/tf"
    )
    assert "no role 'lft'; did you mean left?" in complaint(
        "slam", path, tmp_path / "o.tum", "--topics", "lft=/tf"
    )
    with bag_writer(tmp_path / "none", "ros2") as write:
        by_odometry(write, 10**18, Rigid3.identity())
    with pytest.raises(
        RecordingError, match=r"no topic of pictures; there are /odom \(nav_msgs/msg/Odometry\)"
    ):
        open_sequence(tmp_path / "none")


def test_topics_of_a_format_without_them_are_refused(tiny_recording: Path):
    with pytest.raises(RecordingError, match="a recording of format kitti takes no topics"):
        open_sequence(tiny_recording, topics="left=/a")


def test_a_pair_needs_calibration(tmp_path: Path):
    pixels = np.zeros((48, 64), np.uint8)
    with bag_writer(tmp_path / "bag", "ros2") as write:
        for topic in ("/cam0/image_raw", "/cam1/image_raw"):
            write(topic, "sensor_msgs/msg/Image", 10**18, image(pixels, 10**18))
    with pytest.raises(CalibrationError, match="no calibration of the left and right camera"):
        open_sequence(tmp_path / "bag")
    (tmp_path / "bag" / "camera.json").write_text(
        '{"width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 31, "cy": 24, "baseline": 0.1}'
    )
    rig = open_sequence(tmp_path / "bag")[0].rig
    assert rig is not None
    assert rig.baseline == pytest.approx(0.1)


def write_mono(path: Path, width: int, height: int, **fields: object) -> Path:
    """Write a bag with one image of this size and a calibration with these fields."""
    pixels = np.zeros((height, width), np.uint8)
    with bag_writer(path, "ros2") as write:
        write("/image_raw", "sensor_msgs/msg/Image", 10**18, image(pixels, 10**18))
        write("/camera_info", "sensor_msgs/msg/CameraInfo", 10**18, info(CAMERA, 10**18, **fields))
    return path


def test_binning_and_region_of_interest(tmp_path: Path):
    fx, fy, cx, cy = CAMERA.intrinsics
    full, binned = {"binning_x": 2, "binning_y": 4}, (fx / 2, fy / 4, cx / 2, cy / 4)
    part = {"x_offset": 8, "y_offset": 4, "width": 40, "height": 20}
    cut = ((fx / 2), fy, (cx - 8) / 2, cy - 4)
    for number, (size, fields, intrinsics) in enumerate(
        (
            ((32, 12), full, binned),
            ((64, 48), full, (fx, fy, cx, cy)),  # of the binned image, as some drivers write it
            ((20, 20), {"roi": part, "binning_x": 2}, cut),
            ((64, 48), {"roi": {}}, (fx, fy, cx, cy)),
        )
    ):
        sequence = open_sequence(write_mono(tmp_path / str(number), *size, **fields))
        assert sequence[0].camera == Camera.pinhole(*size, *intrinsics)


def test_an_uncalibrated_camera_needs_a_calibration(tmp_path: Path):
    bag = write_mono(tmp_path / "bag", 64, 48, k=np.zeros(9), p=np.zeros(12))
    assert open_sequence(bag)[0].camera is None
    assert open_sequence(bag, camera="50,51,31,24")[0].camera == Camera.pinhole(
        64, 48, 50.0, 51.0, 31.0, 24.0
    )
    (bag / "camera.json").write_text(
        '{"width": 64, "height": 48, "fx": 55, "fy": 55, "cx": 31, "cy": 24}'
    )
    assert open_sequence(bag)[0].camera.fx == 55.0
    assert open_sequence(bag, camera="50,51,31,24")[0].camera.fx == 50.0


def test_a_given_camera_keeps_the_baseline_of_a_rectified_pair(bag_of: BagOf):
    path = bag_of("ros2")
    own = open_sequence(path)[0].rig
    width, height = own.left.width, own.left.height
    sequence = open_sequence(path, camera=f"222,222,{(width - 1) / 2},{(height - 1) / 2}")
    rig = sequence[0].rig
    assert (rig.left.fx, rig.baseline) == (222.0, own.baseline)
    assert sequence[0].camera == rig.left


def test_registered_depth_may_be_coarser(tmp_path: Path):
    depth = np.full((12, 16), 1500, np.uint16)
    with bag_writer(tmp_path / "bag", "ros2") as write:
        kind = "sensor_msgs/msg/Image"
        write("/rgb/image_raw", kind, 10**18, image(np.zeros((48, 64), np.uint8), 10**18))
        write("/rgb/camera_info", "sensor_msgs/msg/CameraInfo", 10**18, info(CAMERA, 10**18))
        write("/depth_registered/image", kind, 10**18, image(depth, 10**18, "16UC1"))
    found = open_sequence(tmp_path / "bag")[0].depth
    assert found.camera == CAMERA.rescaled(16, 12)
    np.testing.assert_array_equal(found.depth, np.full((12, 16), 1.5, np.float32))


def test_a_picture_of_another_size_than_its_camera(tmp_path: Path):
    with bag_writer(tmp_path / "bag", "ros2") as write:
        write(
            "/image_raw",
            "sensor_msgs/msg/Image",
            10**18,
            image(np.zeros((24, 32), np.uint8), 10**18),
        )
        write("/camera_info", "sensor_msgs/msg/CameraInfo", 10**18, info(CAMERA, 10**18))
    with pytest.raises(UnreadableImageError, match="32x24 pixels, but its camera is of 64x48"):
        open_sequence(tmp_path / "bag")[0]


@pytest.mark.parametrize(
    ("kind", "library"), [("ros1", "rosbags"), ("ros2", "rosbags"), ("ros2-mcap", "mcap")]
)
def test_without_the_extra_it_is_named(
    kind: str, library: str, bag_of: BagOf, monkeypatch: pytest.MonkeyPatch
):
    path = bag_of(kind)
    messages._typestore.cache_clear()
    for name in [
        name for name in sys.modules if name.split(".")[0] == library or name.endswith(".mcap_file")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        MissingExtraError, match=r"need the extra bags: pip install 'topoloc\[bags\]'"
    ):
        open_sequence(path)


@pytest.mark.parametrize("kind", ["ros1", "ros2", "ros2-mcap"])
def test_opening_reads_no_picture(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of 48 MB of images, opening reads the headers. A frame reads its own two images."""
    path = tmp_path / ("big.bag" if kind == "ros1" else "big")
    camera = Camera.pinhole(2000, 1000, 900.0, 900.0, 1000.0, 500.0)
    with bag_writer(path, kind) as write:
        for index in range(12):
            t_ns = 10**18 + index * 10**8
            for topic, baseline in ((LEFT, 0.0), (RIGHT, 0.1)):
                write(
                    topic,
                    "sensor_msgs/msg/Image",
                    t_ns,
                    image(np.full((1000, 2000), index, np.uint8), t_ns),
                )
                write(
                    topic.replace("image_rect", "camera_info"),
                    "sensor_msgs/msg/CameraInfo",
                    t_ns,
                    info(camera, t_ns, baseline),
                )
    read: list[int] = []
    plain = bag_module.Bag.read
    monkeypatch.setattr(
        bag_module.Bag,
        "read",
        lambda self, *args: read.append(len(data := plain(self, *args))) or data,
    )
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sequence = open_sequence(path)
    assert len(sequence) == 12
    assert sum(read) < 10_000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000
    read.clear()
    assert sequence[7].image[3, 3] == 7
    assert 2 * 2_000_000 < sum(read) < 2 * 2_100_000


@pytest.mark.parametrize("is_compressed", [False, True])
@pytest.mark.parametrize("factor", [4, 16, 64, 257])
def test_bits_in_use_are_those_of_the_whole_recording(
    walk: StereoSequence, bag_of: BagOf, factor: int, is_compressed: bool
):
    """The camera has 10, 12, 14 or 16 bits. Its darkest images may use fewer."""
    sequence = open_sequence(bag_of("ros2", factor=factor, is_compressed=is_compressed))
    for index in range(len(walk)):
        read, frame = sequence[index], walk[index]
        for pixels, expected in ((read.image, frame.image), (read.right, frame.right)):
            assert pixels is not None
            assert expected is not None
            np.testing.assert_allclose(pixels.astype(float), expected.astype(float), atol=1.5)
