"""Test images whose driver names the wrong order of their bytes."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_writing import LEFT, SUFFIXES, bag_writer, image, info, write_stereo_bag

from topoloc.geometry.camera import Camera
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import recording_notes

CAMERA = Camera.pinhole(80, 60, 50.0, 50.0, 39.5, 29.5)
SECOND = 10**9
SAID = "are in another order than"


def picture(number: int) -> np.ndarray:
    """Return a coloured texture on a gradient, (60, 80, 3)."""
    random = np.random.default_rng(number)
    large = cv2.resize(random.uniform(0, 255, (6, 8, 3)), (80, 60), interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(random.normal(0, 40, (60, 80, 1)), (3, 3), 0)[..., None]
    return np.clip(large + fine, 0, 255).astype(np.uint8)


def depth_of(number: int, noise: float = 0.002) -> np.ndarray:
    """Return metres of a slanted wall behind a box, with holes."""
    random = np.random.default_rng(number)
    metres = 2.0 + 0.01 * np.arange(80) + 0.005 * np.arange(60)[:, None] + 0.1 * number
    metres[20:40, 30:60] = 1.1
    metres += random.normal(0, noise, metres.shape)
    metres[random.random(metres.shape) < 0.1] = 0.0
    return metres


def write_rgbd(path: Path, kind: str, depth: list[np.ndarray], encoding: str, flag: int) -> Path:
    with bag_writer(path / f"bag{SUFFIXES[kind]}", kind) as write:
        for k, pixels in enumerate(depth):
            t_ns = SECOND + k * 10**8
            grey = np.zeros((60, 80), np.uint8)
            write("/rgb/image_raw", "sensor_msgs/msg/Image", t_ns, image(grey, t_ns))
            write("/rgb/camera_info", "sensor_msgs/msg/CameraInfo", t_ns, info(CAMERA, t_ns))
            its = image(pixels, t_ns, encoding) | {"is_bigendian": flag}
            write("/depth_registered/image", "sensor_msgs/msg/Image", t_ns, its)
    return path / f"bag{SUFFIXES[kind]}"


@pytest.mark.parametrize("is_right", [True, False], ids=["right", "wrong"])
@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap-zstd"])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("order", "<>")
def test_depth_is_read_in_the_order_in_which_it_is_smooth(
    order: str, encoding: str, kind: str, is_right: bool, tmp_path: Path
):
    metres = [depth_of(k) for k in range(4)]
    kinds = {"16UC1": (1000.0, "u2"), "32FC1": (1.0, "f4")}
    factor, dtype = kinds[encoding]
    stored = [(factor * one).round(6).astype(order + dtype) for one in metres]
    flag = int((order == ">") == is_right)
    sequence = open_sequence(write_rgbd(tmp_path, kind, stored, encoding, flag))
    for row, one in enumerate(metres):
        expected = np.where(one > 0, one, np.nan)
        np.testing.assert_allclose(sequence[row].depth.depth, expected, atol=1.1e-3)
    assert (SAID in "".join(recording_notes(sequence))) != is_right


@pytest.mark.parametrize(
    "pixels",
    [
        np.full((60, 80), 1500),  # a wall
        np.full((60, 80), 0),
        np.random.default_rng(0).integers(1, 65535, (60, 80)),
        1500 + np.random.default_rng(0).integers(-3, 4, (60, 80)),
        256 * np.arange(1, 81) + np.zeros((60, 1), int),
        np.arange(80) + np.zeros((60, 1), int),
        np.where(np.random.default_rng(0).random((60, 80)) < 0.01, 2000, 0),  # lidar
    ],
)
@pytest.mark.parametrize("flag", [0, 1])
def test_depth_that_does_not_tell_its_order_has_the_named_one(
    flag: int, pixels: np.ndarray, tmp_path: Path
):
    stored = [pixels.astype("<>"[flag] + "u2")] * 3
    sequence = open_sequence(write_rgbd(tmp_path, "ros2", stored, "16UC1", flag))
    found = np.nan_to_num(sequence[0].depth.depth) * 1000
    np.testing.assert_allclose(found, np.where(pixels == 65535, 0, pixels), rtol=1e-6)
    assert recording_notes(sequence) == []


@pytest.mark.parametrize(
    ("scale", "decimals", "unit"),
    [
        (1000.0, 0, 1000.0),  # 16UC1, converted
        (1000.0, 6, 1000.0),
        (1.0, 6, 1.0),
        (100.0, 6, 1.0),  # of a drone above
        (1.0, 0, 1.0),
    ],
)
def test_float_depth_in_millimetres_is_told(
    scale: float, decimals: int, unit: float, tmp_path: Path
):
    metres = [depth_of(k) for k in range(4)]
    if scale == 100.0:
        metres[1][:] = 655.34  # of the sky
    stored = [(scale * one).round(decimals).astype("<f4") for one in metres]
    sequence = open_sequence(write_rgbd(tmp_path, "ros2", stored, "32FC1", 0))
    for row, one in enumerate(stored):
        expected = np.where(one > 0, one / unit, np.nan)
        np.testing.assert_allclose(sequence[row].depth.depth, expected, rtol=1e-6)
    notes = recording_notes(sequence)
    assert ["is read in millimetres" in note for note in notes] == [True] * (unit == 1000.0)


@pytest.mark.parametrize("flag", [0, 1])
@pytest.mark.parametrize("factor", [4, 16, 64, 200, 255.996, 257])
def test_pairs_of_16_bits(factor: float, flag: int, walk: StereoSequence, tmp_path: Path):
    """Of little-endian pixels, each flag gives the same pictures."""
    with bag_writer(tmp_path / "bag", "ros2") as write:
        for k in range(len(walk)):
            pixels = (walk[k].image.astype(float) * factor).round().astype("<u2")
            its = image(pixels, walk.t_ns[k], "mono16") | {"is_bigendian": flag}
            write(LEFT, "sensor_msgs/msg/Image", walk.t_ns[k], its)
    sequence = open_sequence(tmp_path / "bag")
    is_told = factor not in (255.996, 257)
    assert bool(recording_notes(sequence)) == bool(flag and is_told)
    for k in range(len(walk)) if is_told or not flag else []:
        white = next(white for white in (1023, 4095, 16383, 65535) if 255 * factor <= white)
        expected = walk[k].image * (factor * 255.0 / white)
        np.testing.assert_allclose(sequence[k].image.astype(float), expected, atol=2.0)


def as_yuv(rgb: np.ndarray, is_uyvy: bool) -> np.ndarray:
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV)
    chroma = np.where(np.arange(rgb.shape[1]) % 2, np.roll(yuv[..., 2], 1, 1), yuv[..., 1])
    return np.stack((chroma, yuv[..., 0]) if is_uyvy else (yuv[..., 0], chroma), axis=-1)


def write_yuv(path: Path, kind: str, encoding: str, pictures: list[np.ndarray]) -> StereoSequence:
    with bag_writer(path / f"bag{SUFFIXES[kind]}", kind) as write:
        for k, pixels in enumerate(pictures):
            its = image(pixels, SECOND + k * 10**8, encoding)
            write("/image_raw", "sensor_msgs/msg/Image", SECOND + k * 10**8, its)
    return open_sequence(path / f"bag{SUFFIXES[kind]}")


@pytest.mark.parametrize("is_grey", [False, True])
@pytest.mark.parametrize("is_right", [True, False], ids=["right", "wrong"])
@pytest.mark.parametrize(
    ("encoding", "kind"),
    [("yuv422", "ros1"), ("uyvy", "ros2"), ("yuv422_yuy2", "mcap-zstd"), ("yuyv", "ros1-lz4")],
)
def test_yuv_is_read_in_the_order_in_which_colour_is_smooth(
    encoding: str, kind: str, is_right: bool, is_grey: bool, tmp_path: Path
):
    pictures = [picture(k) for k in range(3)]
    pictures = [one[..., [1, 1, 1]] if is_grey else one for one in pictures]
    is_uyvy = (encoding in ("yuv422", "uyvy")) == is_right
    sequence = write_yuv(tmp_path, kind, encoding, [as_yuv(one, is_uyvy) for one in pictures])
    for row, one in enumerate(pictures):
        grey = [cv2.cvtColor(its, cv2.COLOR_RGB2GRAY) for its in (sequence[row].image, one)]
        assert np.corrcoef(grey[0].ravel(), grey[1].ravel())[0, 1] > 0.95
    assert (f"{SAID} {encoding} says" in "".join(recording_notes(sequence))) != is_right


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_yuv_that_does_not_tell_its_order_has_the_named_one(encoding: str, tmp_path: Path):
    random = np.random.default_rng(0)
    steps = np.array([60, 180], np.uint8)[np.arange(80) // 20 % 2] + np.zeros((60, 1), np.uint8)
    for number, (luma, chroma) in enumerate(
        [
            (np.full((60, 80), 140), np.full((60, 80), 128)),  # constant grey
            (np.full((60, 80), 140), 128 + random.integers(-9, 10, (60, 80))),  # noise
            (140 + random.integers(-3, 4, (60, 80)), 128 + random.integers(-9, 10, (60, 80))),
            (np.full((60, 80), 140), np.where(np.arange(80) % 2, 255 - steps, steps)),  # stripes
        ]
    ):
        planes = (chroma, luma) if encoding == "yuv422" else (luma, chroma)
        pixels = np.stack(planes, axis=-1).astype(np.uint8)
        (tmp_path / str(number)).mkdir()
        sequence = write_yuv(tmp_path / str(number), "ros2", encoding, [pixels] * 3)
        assert recording_notes(sequence) == []


def test_a_right_pair_is_not_accused(walk: StereoSequence, tmp_path: Path):
    for factor in (0, 4, 64, 257):
        path = write_stereo_bag(tmp_path / f"{factor}", "ros2", walk, factor=factor)
        assert recording_notes(open_sequence(path)) == []
