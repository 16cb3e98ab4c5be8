"""Test folders of Stray Scanner, which the tests write themselves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import assert_same_pose, assert_slices, pose, write
from topoloc.errors import CalibrationError, RecordingError, TopolocError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import as_monocular, recording_notes

SIZE, NUM_FRAMES = (64, 48), 4
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"


def row(index: int, *more: float) -> str:
    w, x, y, z = pose(index).quat_wxyz()
    numbers = (*pose(index).translation, x, y, z, w, *more)
    return f"{100.25 + index / 60:.6f}, {index:06d}, " + ", ".join(map(repr, map(float, numbers)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write four frames. Depth has a quarter of the image size, and one corner has
    no confidence."""
    root = tmp_path / "scan"
    root.mkdir()
    fourcc = cv2.VideoWriter_fourcc(*"mp4v")  # pyright: ignore[reportAttributeAccessIssue]
    writer = cv2.VideoWriter(str(root / "rgb.mp4"), fourcc, 60.0, SIZE)
    for index in range(NUM_FRAMES):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 40 * index, np.uint8))
        write(root / "depth" / f"{index:06d}.png", np.full((12, 16), 1000 + index, np.uint16))
        confidence = np.full((12, 16), 2, np.uint8)
        confidence[:6, :8] = 0
        write(root / "confidence" / f"{index:06d}.png", confidence)
    writer.release()
    (root / "odometry.csv").write_text("\n".join([HEADER, *map(row, range(NUM_FRAMES))]))
    (root / "camera_matrix.csv").write_text("50.0, 0.0, 32.0\n0.0, 51.0, 23.0\n0.0, 0.0, 1.0\n")
    return root


def test_frames(folder: Path):
    assert find_format(folder) == "stray_scanner"
    sequence = open_sequence(folder)
    assert sequence.names == ["000000", "000001", "000002", "000003"]
    assert sequence.t_ns[1] - sequence.t_ns[0] == pytest.approx(1e9 / 60, abs=1000)
    frame = sequence[2]
    assert abs(float(frame.image.mean()) - 80.0) < 6
    assert frame.camera == Camera.pinhole(*SIZE, 50.0, 51.0, 32.0, 23.0)
    assert_same_pose(frame.world_from_cam, pose(2))
    assert_same_pose(sequence.poses[3], pose(3))
    assert frame.depth is not None
    assert frame.depth.camera == frame.camera.rescaled(16, 12)
    assert frame.depth.depth[10, 12] == pytest.approx(1.002)
    assert np.isnan(frame.depth.depth[:6, :8]).all()
    assert as_monocular(sequence)[2].depth is None
    assert_slices(sequence)


def test_rows_of_some_frames_and_a_lens_for_each(folder: Path):
    rows = [row(index, 50.0 + index, 51.0, 32.0, 23.0) for index in (1, 3, 7)]
    (folder / "odometry.csv").write_text("\n".join([f"{HEADER}, fx, fy, cx, cy", *rows]))
    sequence = open_sequence(folder)
    assert sequence.names == ["000001", "000003"]
    frame = sequence[1]
    assert abs(float(frame.image.mean()) - 120.0) < 6
    assert frame.camera is not None
    assert frame.camera.fx == 53.0
    assert frame.depth is not None
    assert frame.depth.depth[10, 12] == pytest.approx(1.003)
    assert "1 of 3 rows have no frame in rgb.mp4" in recording_notes(sequence)[0]


def replace(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (replace("odometry.csv", "qw", "w"), RecordingError, "line 1: no column qw"),
        (replace("odometry.csv", "100.25", "x"), RecordingError, "line 2: not 9 finite"),
        (replace("odometry.csv", ", 000001", ", 000000"), RecordingError, "do not increase"),
        (replace("odometry.csv", "100.25", "100.99"), RecordingError, "do not increase"),
        (replace("camera_matrix.csv", "50.0,", "50.0"), RecordingError, "camera_matrix"),
        (replace("camera_matrix.csv", "32.0", "320.0"), CalibrationError, "picture of about 641"),
        (lambda folder: (folder / "rgb.mp4").unlink(), RecordingError, r"rgb\.mp4"),
    ],
)
def test_malformed_folders_are_refused(
    folder: Path, change: Callable[[Path], None], error: type[TopolocError], says: str
):
    change(folder)
    with pytest.raises(error, match=says) as caught:
        open_sequence(folder)
    assert "\n" not in str(caught.value)


def test_a_row_that_is_no_pose(folder: Path):
    zeros = ", ".join(["0"] * 7)
    (folder / "odometry.csv").write_text(f"{HEADER}\n1.0, 0, {zeros}\n")
    with pytest.raises(TrajectoryError, match="frame 0: qx qy qz qw is no rotation"):
        open_sequence(folder)
