"""Test recordings as programs and devices write them: each opens, and each of its
frames is read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from topoloc.errors import CalibrationError
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.slam.pose_checks import check_poses


@pytest.fixture
def cases(shared: Path) -> Path:
    """Return the folder of these recordings."""
    folder = shared / "cases" / "turn3"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}")
    return folder


def kind(sequence: StereoSequence, index: int) -> str:
    """Return stereo, depth or image, after reading the frame."""
    frame = sequence[index]
    if frame.depth is not None:
        assert frame.camera is not None
        assert np.isfinite(frame.depth.depth).mean() > 0.5
        assert frame.depth.depth.shape == (frame.depth.camera.height, frame.depth.camera.width)
        return "depth"
    return "image" if frame.right is None else "stereo"


@pytest.mark.parametrize(
    ("name", "num_frames", "expected", "has_poses"),
    [
        ("depth_coarser_than_colour", 6, "depth", False),
        ("transforms_backslashes", 12, "image", True),
        ("bag_binning", 12, "stereo", True),
        ("bag_rvl_depth", 3, "depth", True),
        ("bag_uncalibrated", 12, "stereo", False),
        ("ros_left_right_yaml", 12, "stereo", True),
        ("euroc_times_differ", 12, "stereo", True),
        ("nerfcapture_depth_path", 6, "depth", True),
        ("stray_scanner", 6, "depth", True),
        ("colmap_exif_orientation", 12, "image", True),
        ("colmap_simple_radial_fisheye", 12, "image", True),
        ("tum_names_with_spaces", 6, "depth", True),
    ],
)
def test_a_recording_is_read(
    cases: Path, name: str, num_frames: int, expected: str, has_poses: bool
):
    sequence = open_sequence(cases / name)
    assert [kind(sequence, index) for index in range(len(sequence))] == [expected] * num_frames
    assert all((pose is not None) == has_poses for pose in sequence.poses)


def test_a_video_whose_last_frames_have_no_time(cases: Path):
    notes: list[str] = []
    folder = cases / "avi_with_b_frames"
    sequence = open_sequence(folder / "walk.avi", camera=folder / "camera.json", warn=notes.append)
    assert [round(t_ns / 1e6) for t_ns in sequence.t_ns] == [200 * index for index in range(24)]
    assert notes == [f"{folder / 'walk.avi'}: 2 of 24 frames have no time; times are from its 5 Hz"]


@pytest.mark.parametrize("is_given", [True, False])
def test_a_recording_without_sensor_yaml(cases: Path, is_given: bool):
    notes: list[str] = []
    folder = cases / "tumvi_without_sensor_yaml"
    camera = folder / "dso" / "camchain.yaml" if is_given else None
    sequence = open_sequence(folder, camera=camera, warn=notes.append)
    assert [kind(sequence, index) for index in range(len(sequence))] == ["stereo"] * 12
    assert len(notes) == 1
    assert "no T_cam_imu" in notes[0]


def test_a_negative_focal_length_is_named_and_mended(cases: Path, tmp_path: Path):
    folder = Path(shutil.copytree(cases / "icl_negative_fy", tmp_path / "walk"))
    with pytest.raises(CalibrationError, match=r"camera\.json.* fy = -190 .*write fy = 190$"):
        open_sequence(folder)
    file = folder / "camera.json"
    text = file.read_text().replace("-190", "190")
    file.unlink()
    file.write_text(text)
    assert kind(open_sequence(folder), 0) == "depth"


def test_short_steps_accuse_no_poses(cases: Path):
    """With few points, the direction of a short step is wrong by 70 degrees. The
    poses are right."""
    check_poses(open_sequence(cases / "colmap_simple_radial_fisheye"))
