"""Test images of a topic: which are used, which are counted as dropped, and their cameras."""

from __future__ import annotations

import re
import threading
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from topoloc.apps.formats.bags import bag_images
from topoloc.apps.robots import ros_images
from topoloc.apps.robots.ros_images import RosImages
from topoloc.apps.robots.ros_node import RosNode, TopicReader
from topoloc.errors import CalibrationError, RecordingError

WIDTH, HEIGHT = 6, 4
RGB = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


class Queue(TopicReader):
    def __init__(self) -> None:
        self.batches: list[list[Any]] = []

    def take(self, num: int) -> list[Any]:
        return self.batches.pop(0) if self.batches else []


class Node(RosNode):
    def __init__(self) -> None:
        self.messages = SimpleNamespace(Image="Image", CompressedImage="JPEG", CameraInfo="Info")
        self.queues: dict[str, Queue] = {}
        self.kinds: dict[str, Any] = {}
        self.domain = 0

    def create_reader(self, name: str, kind: Any, quality: str, callback: Any = None) -> Any:
        self.kinds[name], self.queues[name] = kind, Queue()
        return self.queues[name]


def _header(t_ms: int) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=t_ms // 1000, nanosec=t_ms % 1000 * 1_000_000)
    return SimpleNamespace(stamp=stamp, frame_id="/camera_optical")


def _image(t_ms: int, pixels: np.ndarray = RGB, encoding: str = "rgb8") -> SimpleNamespace:
    """Return an image message with three bytes of padding after each row."""
    rows = np.pad(pixels.reshape(HEIGHT, -1), ((0, 0), (0, 3)))
    return SimpleNamespace(
        header=_header(t_ms), height=HEIGHT, width=WIDTH, encoding=encoding, is_bigendian=0,
        step=rows.shape[1], data=rows.tobytes(),
    )  # fmt: skip


def _info(focal: float = 300.0, model: str = "plumb_bob", **changes: Any) -> SimpleNamespace:
    matrix = np.array([[focal, 0.0, 2.5], [0.0, focal, 1.5], [0.0, 0.0, 1.0]]) * (focal > 0.0)
    projection = np.column_stack([matrix, np.zeros(3)])
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    plain = {
        "header": _header(0), "height": HEIGHT, "width": WIDTH, "distortion_model": model,
        "d": [0.1, 0.0, 0.0, 0.0], "k": matrix.ravel(), "r": np.eye(3).ravel(),
        "p": projection.ravel(), "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**plain | changes)


def _open(
    *batches: list[Any], info: Any = None, topic: str = "/camera/image_raw"
) -> tuple[RosImages, Node, list[str]]:
    node, warnings = Node(), list[str]()
    images = RosImages(node, f"ros:{topic}", info is None, warnings.append)
    node.queues[topic].batches = list(batches)
    if info is not None:
        node.queues["/camera/camera_info"].batches = [[info]]
    return images, node, warnings


def test_the_newest_is_taken_and_the_others_are_counted():
    images, _, _ = _open([_image(100)], [_image(t) for t in (200, 300, 400)], [], [_image(500)])
    taken = [frame.t_ns // 1_000_000 for frame in islice(images.frames(threading.Event()), 3)]
    assert taken == [100, 400, 500]
    assert images.num_dropped == 2
    assert images.frame_id == "camera_optical"


def test_images_faster_than_answers_are_reported():
    batches = [[_image(10 * n + k) for k in range(1, 4)] for n in range(100)]
    images, _, _ = _open(*batches)
    frames = images.frames(threading.Event())
    for _ in islice(frames, 99):
        assert images.describe_load() is None
    next(frames)
    assert images.describe_load() == (
        "images come faster than answers (200 of 300 dropped); lower the rate of the camera or the"
        " size of its images"
    )


def test_older_ones_are_dropped_unless_the_clock_was_set_back():
    images, _, _ = _open(
        [_image(5000)], [_image(4900)], [_image(5000)], [_image(1000)], [_image(1100)]
    )
    taken = [frame.t_ns // 1_000_000 for frame in islice(images.frames(threading.Event()), 3)]
    assert taken == [5000, 1000, 1100]
    assert images.num_dropped == 2


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, RGB[..., 0]]), RGB),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., 0]]), RGB),
        ("mono8", RGB[..., 0], RGB[..., 0]),
    ],
)
def test_pixels_are_rgb_or_grey_without_padding(
    encoding: str, pixels: np.ndarray, expected: np.ndarray
):
    images, _, _ = _open([_image(1, np.ascontiguousarray(pixels), encoding)])
    (frame,) = islice(images.frames(threading.Event()), 1)
    assert np.array_equal(frame.read().image, expected)
    assert frame.read().camera is None  # it is given


def test_compressed_images_have_the_calibration_beside_the_raw_ones():
    topic = "/camera/image_raw/compressed"
    data = cv2.imencode(".png", RGB[..., ::-1])[1].tobytes()
    message = SimpleNamespace(header=_header(7), format="png", data=data)
    images, node, _ = _open([message], info=_info(), topic=topic)
    (frame,) = islice(images.frames(threading.Event()), 1)
    assert node.kinds == {topic: "JPEG", "/camera/camera_info": "Info"}
    assert np.array_equal(frame.read().image, RGB)
    camera = frame.read().camera
    assert camera is not None
    assert (camera.model, camera.fx, camera.cx) == ("OPENCV", 300.0, 2.5)


def test_models_and_rectified_images():
    fisheye = _info(model="equidistant")
    rational = _info(model="rational_polynomial", d=[0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0])
    found = []
    for info, topic in (
        (fisheye, "/camera/image_raw"),
        (rational, "/camera/image_raw"),
        (fisheye, "/camera/image_rect"),
    ):
        images, _, _ = _open([_image(1)], info=info, topic=topic)
        (frame,) = islice(images.frames(threading.Event()), 1)
        camera = frame.read().camera
        assert camera is not None
        found.append(camera.model)
    assert found == ["OPENCV_FISHEYE", "FULL_OPENCV", "PINHOLE"]


def test_binning_belongs_to_the_full_image():
    half = _info(width=2 * WIDTH, height=2 * HEIGHT, binning_x=2, binning_y=2)
    images, _, _ = _open([_image(1)], info=half)
    (frame,) = islice(images.frames(threading.Event()), 1)
    camera = frame.read().camera
    assert camera is not None
    assert (camera.width, camera.fx) == (WIDTH, 150.0)


def test_an_uncalibrated_camera_is_refused():
    images, _, _ = _open([_image(1)], info=_info(0.0))
    (frame,) = islice(images.frames(threading.Event()), 1)
    with pytest.raises(CalibrationError, match=r"K is zero, .* or give --camera FILE"):
        frame.read()


def test_missing_messages_are_named(monkeypatch: pytest.MonkeyPatch):
    now = iter(np.arange(0.0, 1e4, 0.5))
    monkeypatch.setattr(ros_images.time, "monotonic", lambda: float(next(now)))
    images, node, warnings = _open([_image(1)], info=_info())
    node.queues["/camera/camera_info"].batches = [*[[]] * 20, [_info()]]
    (frame,) = islice(images.frames(threading.Event()), 1)
    assert frame.read().camera is not None  # it has waited
    node.queues["/camera/image_raw"].batches = [*[[]] * 60, [_image(2)]]
    assert len(list(islice(images.frames(threading.Event()), 1))) == 1
    assert [line[:60] for line in warnings] == [
        "/camera/camera_info: no calibration, so the images of /camer",
        "/camera/image_raw: no image for 10 s in ROS domain 0; check ",
    ]
    assert images.fault is None


def test_an_image_that_waits_for_its_calibration_says_so(monkeypatch: pytest.MonkeyPatch):
    now, stop = iter(np.arange(0.0, 1e4, 0.5)), threading.Event()
    monkeypatch.setattr(ros_images.time, "monotonic", lambda: float(next(now)))
    images, node, warnings = _open(*[[_image(t)] for t in range(1, 20)], info=_info())
    node.queues["/camera/camera_info"].batches = []
    monkeypatch.setattr(stop, "wait", lambda seconds: images.fault and stop.set())
    assert list(images.frames(stop)) == []
    assert warnings == [images.fault]
    assert images.fault == (
        "/camera/camera_info: no calibration, so the images of /camera/image_raw wait; publish it,"
        " or give --camera FILE"
    )


def _smooth(width: int = 64, height: int = 48) -> np.ndarray:
    """Return a picture of a smooth scene with noise."""
    rng = np.random.default_rng(1)
    rough = cv2.resize(rng.integers(0, 255, (6, 8, 3)).astype(np.uint8), (width, height))
    return np.clip(rough + rng.normal(0.0, 2.0, rough.shape), 0, 255).astype(np.uint8)


def _yuv(label: str, is_yuyv: bool) -> SimpleNamespace:
    picture = _smooth()
    y, u, v = cv2.split(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV))
    chroma = np.where(np.arange(u.shape[1]) % 2 == 0, u, v)
    planes = np.dstack([y, chroma] if is_yuyv else [chroma, y])
    return SimpleNamespace(
        header=_header(1), height=48, width=64, encoding=label, is_bigendian=0,
        step=128, data=planes.tobytes(),
    )  # fmt: skip


@pytest.mark.parametrize(("label", "is_yuyv"), [("yuv422", True), ("yuv422_yuy2", False)])
def test_the_order_of_bytes_is_that_of_the_pixels(label: str, is_yuyv: bool):
    images, _, warnings = _open([_yuv(label, is_yuyv)], [_yuv(label, is_yuyv)])
    for frame in islice(images.frames(threading.Event()), 1):
        assert np.abs(frame.read().image.astype(int) - _smooth()).mean() < 20.0
    assert warnings == [images.notes["pixel_order"]]
    assert warnings[0].startswith(
        f"the bytes of /camera/image_raw are in another order than {label} says"
    )


@pytest.mark.parametrize(("label", "is_yuyv"), [("yuv422", False), ("yuv422_yuy2", True)])
def test_right_labels_are_trusted(label: str, is_yuyv: bool):
    images, _, warnings = _open([_yuv(label, is_yuyv)])
    (frame,) = islice(images.frames(threading.Event()), 1)
    assert np.abs(frame.read().image.astype(int) - _smooth()).mean() < 20.0
    assert (warnings, images.notes) == ([], {})


@pytest.mark.parametrize("topic", ["", "/", "/a b", "/camera//image", "/1st", "/a" * 3 + "/"])
def test_an_invalid_topic_is_refused(topic: str):
    with pytest.raises(RecordingError, match="no topic of ROS"):
        RosImages(Node(), f"ros:{topic}", True, print)


def test_the_table_of_encodings_is_that_of_the_code():
    """32FC1 is depth, which no image of a camera is."""
    text = (Path(__file__).parents[3] / "docs" / "robots.md").read_text(encoding="utf-8")
    section = re.search(r"^\*\*Encodings\.\*\*.*?\n\n(.*?)\n\n", text, re.MULTILINE | re.DOTALL)
    assert section
    rows = [row.split("|")[1] for row in section.group(1).splitlines()[2:]]
    documented = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    known = bag_images._ENCODINGS  # pyright: ignore[reportPrivateUsage]
    assert sorted(documented) == sorted(set(known) - {"32FC1"})


@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_grey_of_16_bits_is_stretched_to_8(encoding: str):
    message = _image(1, RGB[..., 0].astype(np.uint16) * 200, encoding)
    message.header, message.step = _header(1), 2 * WIDTH
    message.data = (RGB[..., 0].astype("<u2") * 200).tobytes()
    images, _, warnings = _open([message])
    (frame,) = islice(images.frames(threading.Event()), 1)
    image = frame.read().image
    assert (image.dtype, image.shape) == (np.uint8, (HEIGHT, WIDTH))
    order = np.argsort(RGB[..., 0], axis=None, kind="stable")
    assert np.all(np.diff(image.ravel()[order].astype(int)) >= 0)
    assert int(image.max()) - int(image.min()) > 100
    assert warnings == []
