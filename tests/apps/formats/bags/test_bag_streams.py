"""Test topics, calibrations and depth of bags: missing, contradictory or in part."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_writing import (
    LEFT,
    RIGHT,
    bag_writer,
    by_odometry,
    image,
    info,
)

from topoloc.apps.formats.bags import bag as bag_module, messages
from topoloc.errors import (
    CalibrationError,
    MissingExtraError,
    RecordingError,
    UnreadableImageError,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence

BagOf = Callable[..., Path]
CAMERA = Camera.pinhole(64, 48, 50.0, 51.0, 31.0, 24.5)


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
