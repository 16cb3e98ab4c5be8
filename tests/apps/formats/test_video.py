"""Test videos written by OpenCV: frame order, times, calibration, and broken files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import assert_slices
from topoloc.apps.formats import video
from topoloc.errors import CalibrationError, RecordingError, TrajectoryError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import find_format, open_sequence

SIZE = (64, 48)
CAMERA = Camera.pinhole(*SIZE, 50.0, 50.0, 31.5, 23.5)
NUM_FRAMES = 12


def write_video(path: Path, greys: list[int], codec: str = "mp4v", rate: float = 25.0) -> Path:
    """Write frames of uniform grey."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate, SIZE)
    assert writer.isOpened()
    for grey in greys:
        writer.write(np.full((SIZE[1], SIZE[0], 3), grey, np.uint8))
    writer.release()
    return path


@pytest.fixture
def film(tmp_path: Path) -> Path:
    return write_video(tmp_path / "walk.mp4", [20 * number for number in range(NUM_FRAMES)])


@pytest.mark.parametrize(
    ("suffix", "codec"), [(".mp4", "mp4v"), (".avi", "MJPG"), (".mkv", "mp4v"), (".MP4", "mp4v")]
)
def test_frames_come_in_order_with_the_times_of_the_container(
    tmp_path: Path, suffix: str, codec: str
):
    path = write_video(
        tmp_path / f"walk{suffix}", [20 * number for number in range(NUM_FRAMES)], codec
    )
    assert find_format(path) == "video"
    sequence = open_sequence(path)
    assert len(sequence) == NUM_FRAMES
    np.testing.assert_allclose(
        np.array(sequence.t_ns) / 1e9, np.arange(NUM_FRAMES) / 25.0, atol=2e-3
    )
    for number in range(NUM_FRAMES):
        frame = sequence[number]
        assert frame.image.shape == (48, 64, 3)
        assert abs(float(frame.image.mean()) - 20 * number) < 6
        assert frame.camera is None
        assert frame.name == sequence.names[number] == f"{number:06d}"


def test_frames_may_be_read_in_any_order_and_selected(film: Path):
    sequence = open_sequence(film)
    for number in (7, 2, 2, 11, 0, -1):
        assert abs(float(sequence[number].image.mean()) - 20 * (number % NUM_FRAMES)) < 6
    with pytest.raises(IndexError):
        sequence[NUM_FRAMES]
    assert_slices(sequence)
    part = open_sequence(f"{film}@3::4")
    assert [round(float(frame.image.mean()) / 20) for frame in (part[0], part[1])] == [3, 7]


def test_calibration_and_truth_lie_beside_it(film: Path):
    (film.parent / "camera.json").write_text(json.dumps(CAMERA.to_json()))
    film.with_suffix(".tum").write_text("0 1 2 3 0 0 0 1\n0.44 1 2 4 0 0 0 1\n")
    sequence = open_sequence(film)
    assert sequence[4].camera == CAMERA
    assert sequence.poses[0] is not None
    np.testing.assert_allclose(sequence.poses[0].translation, [1, 2, 3])
    film.with_suffix(".tum").write_text("900 1 2 3 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match=r"walk\.tum"):
        open_sequence(film)


def test_a_camera_of_another_size_is_refused(film: Path):
    (film.parent / "camera.json").write_text(
        json.dumps(Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0).to_json())
    )
    with pytest.raises(CalibrationError, match=r"640x480.*64x48"):
        open_sequence(film)


def test_a_given_camera_replaces_the_one_beside_the_video(film: Path):
    (film.parent / "camera.json").write_text(json.dumps(CAMERA.to_json()))
    given = Camera.pinhole(*SIZE, 60.0, 61.0, 31.5, 23.5)
    assert open_sequence(film, camera="60,61,31.5,23.5")[3].camera == given
    (film.parent / "other.json").write_text(
        json.dumps(Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0).to_json())
    )
    fault = r"walk\.mp4: of 64x48, the camera of 640x480"
    with pytest.raises(CalibrationError, match=fault):
        open_sequence(film, camera=film.parent / "other.json")


@pytest.mark.parametrize(
    "content", [b"", b"no video at all", b"\x00\x00\x00\x18ftypmp42" + bytes(200)]
)
def test_other_files_are_one_line(
    tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]
):
    path = tmp_path / "broken.mp4"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"broken\.mp4"):
        open_sequence(path)
    assert "Traceback" not in capfd.readouterr().err


def test_a_film_that_was_cut_off_ends_with_its_last_whole_frame(tmp_path: Path):
    rng = np.random.default_rng(0)
    path = tmp_path / "cut.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, SIZE)
    for _ in range(NUM_FRAMES):
        writer.write(rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8))
    writer.release()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    sequence = open_sequence(path)
    assert 1 < len(sequence) < NUM_FRAMES
    assert sequence[len(sequence) - 1].image.shape == (48, 64, 3)


class _Clock:
    """Stand in for a reader whose container gives these times."""

    def __init__(self, milliseconds: list[float]) -> None:
        self._left = list(milliseconds)
        self._now = 0.0

    def grab(self) -> bool:
        if not self._left:
            return False
        self._now = self._left.pop(0)
        return True

    def get(self, _: int) -> float:
        return self._now


@pytest.mark.parametrize("milliseconds", [[0.0, 40.0, 20.0], [0.0, 40.0, 40.0]])
def test_a_clock_that_does_not_advance_is_an_error_with_the_frame(
    film: Path, milliseconds: list[float], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(video, "_open_capture", lambda _: _Clock(milliseconds))
    with pytest.raises(
        RecordingError, match=r"frame 2: at 0\.0\d0 s, but the frame before is at 0\.040 s"
    ):
        video._read_times(film, 25.0)


def test_a_container_without_times_goes_by_its_rate(film: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(video, "_open_capture", lambda _: _Clock([0.0, 0.0, 0.0]))
    assert video._read_times(film, 50.0) == ([0, 20_000_000, 40_000_000], ())
    # the decoder holds two frames back
    monkeypatch.setattr(video, "_open_capture", lambda _: _Clock([40.0, 60.0, 0.0, 0.0]))
    t_ns, (note,) = video._read_times(film, 50.0)
    assert t_ns == [0, 20_000_000, 40_000_000, 60_000_000]
    assert "2 of 4 frames have no time" in note
    monkeypatch.setattr(video, "_open_capture", lambda _: _Clock([0.0, 0.0, 0.0]))
    with pytest.raises(RecordingError, match="rate"):
        video._read_times(film, 0.0)


def test_a_frame_of_another_resolution_is_unreadable_alone(
    film: Path, monkeypatch: pytest.MonkeyPatch
):
    sequence = video.open_video(film)

    class Larger:
        """Return an image of another size from the third frame on."""

        def __init__(self) -> None:
            self.number = -1

        def grab(self) -> bool:
            self.number += 1
            return True

        def retrieve(self) -> tuple[bool, np.ndarray]:
            return True, np.zeros((96, 128, 3) if self.number >= 2 else (48, 64, 3), np.uint8)

    monkeypatch.setattr(video, "_open_capture", lambda _: Larger())
    assert sequence[1].image.shape == (48, 64, 3)
    with pytest.raises(
        UnreadableImageError, match=r"128x96 pixels, but the first frame is of 64x48"
    ):
        sequence[2]
