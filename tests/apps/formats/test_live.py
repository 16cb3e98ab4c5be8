"""Test live sources, such as a local HTTP stream or a video file: old images are dropped, and ends
and stalls are reported."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from mjpeg_camera import mjpeg_camera
from topoloc.apps.formats.live import LiveSource, is_live
from topoloc.errors import RecordingError


def grey_film(path: Path, num_frames: int) -> Path:
    """Write a video whose frame k has grey 10 k."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 30.0, (64, 48))
    for index in range(num_frames):
        writer.write(np.full((48, 64, 3), 10 * index, np.uint8))
    writer.release()
    return path


def greys(num_pictures: int) -> list[np.ndarray]:
    """Return images. Image k has grey 10 k, up to white."""
    return [np.full((48, 64, 3), min(10 * index, 255), np.uint8) for index in range(num_pictures)]


@pytest.mark.parametrize(
    ("source", "live"),
    [
        ("0", True),
        ("/dev/video2", True),
        ("rtsp://user:word@10.0.0.7:554/h264", True),
        ("http://10.0.0.7/video.mjpg", True),
        ("v4l2src device=/dev/video0 ! videoconvert ! appsink", True),
        ("walk.mp4", False),
        ("pictures", False),
        ("session1@0:10", False),
    ],
)
def test_addresses_of_live_sources(source: str, live: bool):
    assert is_live(source) is live


def test_a_folder_named_by_a_number_is_no_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "0").mkdir()
    monkeypatch.chdir(tmp_path)
    assert not is_live("0")


def test_every_picture_of_a_source_that_may_wait(tmp_path: Path):
    with LiveSource(str(grey_film(tmp_path / "a.avi", 8)), keep_all=True) as source:
        pictures = list(source)
    assert [picture.number for picture in pictures] == list(range(8))
    assert [int(picture.image[20, 20, 0]) for picture in pictures] == pytest.approx(
        [10 * index for index in range(8)], abs=2
    )
    assert (np.diff([picture.t_ns for picture in pictures]) > 0).all()


def test_the_newest_picture_of_a_stream_over_http():
    """A reader slower than the camera still gets new images, and the last one."""
    with mjpeg_camera(greys(20), 0.02) as url, LiveSource(url) as source:
        taken = []
        for picture in source:
            taken.append(picture)
            time.sleep(0.1)
    numbers = [picture.number for picture in taken]
    assert numbers[-1] == source.num_read - 1
    assert len(numbers) < source.num_read
    assert (np.diff(numbers) > 0).all()
    for picture in taken:
        assert abs(int(picture.image[20, 20, 1]) - 10 * picture.number) < 4


def test_a_source_that_stalls():
    with mjpeg_camera(greys(4), 0.0, hangs=True) as url, LiveSource(url, stall_s=1.0) as source:
        with pytest.raises(RecordingError, match="no image for 1 s"):
            list(source)
        assert 0 < source.num_read <= 4


def test_stopped_from_outside():
    with mjpeg_camera(greys(1000), 0.01) as url, LiveSource(url) as source:
        for picture in source:
            if picture.number > 3:
                source.stop.set()
        assert source.num_read < 900


@pytest.mark.parametrize(
    "source", ["rtsp://127.0.0.1:9/none", "http://127.0.0.1:9/none.mjpg", "/dev/video99", "997"]
)
def test_a_source_without_an_answer_is_an_error(source: str, capfd: pytest.CaptureFixture[str]):
    with pytest.raises(RecordingError, match="does not answer"):
        LiveSource(source, stall_s=2.0)
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(
    cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER), reason="this OpenCV has GStreamer"
)
def test_pipelines_need_gstreamer():
    with pytest.raises(RecordingError, match="has no GStreamer"):
        LiveSource("videotestsrc ! videoconvert ! appsink")
