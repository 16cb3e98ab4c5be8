"""Check that calibration errors of some percent are refused with the right value, and that this
value solves the fault. Right recordings pass."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tiny_world
from room_frames import FrameList, depth_frame, stereo_frame
from topoloc.errors import TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import Recording, with_poses
from topoloc.slam import calibration_checks
from topoloc.slam.calibration_checks import find_image_faults
from topoloc.slam.depth_checks import find_depth_shift
from topoloc.slam.pose_checks import check_poses

PLACES = [0.4 * k for k in range(20)]


def with_rig(frame: StereoFrame, camera: Camera, baseline: float) -> StereoFrame:
    return replace(frame, camera=camera, rig=StereoRig.rectified(camera, baseline))


def with_focal(recording: Recording, factor: float) -> Recording:
    """Return the recording with its focal length multiplied by this factor."""
    assert recording.right is not None
    c = recording.right.rig.left
    camera = Camera.pinhole(c.width, c.height, factor * c.fx, factor * c.fy, c.cx, c.cy)
    rig = StereoRig.rectified(camera, recording.right.rig.baseline)
    return replace(recording, camera=camera, right=replace(recording.right, rig=rig))


def open_recording(path: Path) -> Recording:
    sequence = open_sequence(path)
    assert isinstance(sequence, Recording)
    return sequence


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_the_remedy_for_a_wrong_baseline_works(factor: float):
    frames = [stereo_frame(place) for place in PLACES]
    check_poses(FrameList(frames))
    wrong = factor * tiny_world.BASELINE
    with pytest.raises(TrajectoryError, match=r"depth is 1\d % (more|less) .*a baseline") as caught:
        check_poses(FrameList([with_rig(one, tiny_world.CAMERA, wrong) for one in frames]))
    message = str(caught.value)
    found = float(message.partition("a baseline of ")[2].partition(" m")[0])
    assert found == pytest.approx(tiny_world.BASELINE, rel=0.03)
    assert message.index("baseline") < message.index("--poses scale=")
    check_poses(FrameList([with_rig(one, tiny_world.CAMERA, found) for one in frames]))


def test_the_remedy_for_a_wrong_unit_of_poses_works():
    sequence = FrameList([stereo_frame(place) for place in PLACES])
    wrong = [Rigid3(one.rotation, 1.15 * one.translation) for one in sequence.poses if one]
    with pytest.raises(TrajectoryError, match=r"depth is 1\d % less") as caught:
        check_poses(with_poses(sequence, list(wrong)))
    scale = float(re.findall(r"--poses scale=([\d.]+)", str(caught.value))[0])
    mended = [Rigid3(one.rotation, scale * one.translation) for one in wrong]
    assert scale == pytest.approx(1 / 1.15, rel=0.03)
    check_poses(with_poses(sequence, list(mended)))


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_the_remedy_for_a_wrong_focal_length_works(shared: Path, factor: float):
    right = open_recording(shared / "data" / "zed_lab" / "session2")
    assert right.camera is not None
    with pytest.raises(TrajectoryError, match="a focal length of about") as caught:
        check_poses(with_focal(right, factor))
    found = float(str(caught.value).partition("of about ")[2].partition(" px")[0])
    assert found == pytest.approx(right.camera.fx, rel=0.06)
    check_poses(with_focal(right, found / right.camera.fx))
    (note,) = find_image_faults(with_poses(with_focal(right, factor), [None] * len(right)))
    assert "a focal length of about" in note


@pytest.mark.parametrize(
    ("logs", "is_wrong"),
    [
        ((0.06, 0.27, 0.29, 0.34, 0.59), False),  # a corridor whose focal length is right
        ((0.09, 0.1, 0.1, 0.11, 0.12), True),
        ((-0.09, -0.1, -0.1, -0.11, -0.12), True),
        ((0.1, 0.1, 0.1, 0.1), False),  # too few
        ((0.0, 0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1), False),
        ((0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1), True),
    ],
)
def test_a_focal_length_is_accused_if_nearly_all_steps_agree(
    logs: tuple[float, ...], is_wrong: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(calibration_checks, "_estimate_focal_errors", lambda steps: list(logs))
    sequence = FrameList([stereo_frame(place) for place in PLACES[:2]])
    problem = calibration_checks._find_focal_problem(sequence, [])
    assert (problem is not None) == is_wrong


def test_a_right_recording_without_poses_has_no_fault(shared: Path):
    assert find_image_faults(open_sequence(shared / "data" / "euroc" / "v1_01_part")) == []


def test_a_street_names_the_focal_length_as_well(shared: Path):
    """Without rotations, a wrong focal length looks like a wrong baseline."""
    street = open_recording(shared / "data" / "kitti" / "sequences" / "street1")
    check_poses(street)
    with pytest.raises(TrajectoryError, match=r"a baseline of .* or the focal length is wrong"):
        check_poses(with_focal(street, 1.15))


def test_a_disparity_error_of_half_a_pixel_is_no_fault(shared: Path):
    """Depth in this street is 12 % larger than its poses show: half a pixel of
    disparity at 75 m."""
    check_poses(open_sequence(shared / "data" / "kitti" / "sequences" / "street2@25:51"))


@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_times_of_another_unit_are_noted(factor: float):
    frames = [
        replace(stereo_frame(place), t_ns=round(factor * k * 1e8))
        for k, place in enumerate(PLACES[:8])
    ]
    notes = find_image_faults(FrameList(frames))
    assert any("are the times in m" in note for note in notes)
    assert find_image_faults(FrameList([stereo_frame(place) for place in PLACES[:8]])) == []


def shift_depth(frame: StereoFrame, columns: int) -> StereoFrame:
    assert frame.depth is not None
    return replace(
        frame, depth=replace(frame.depth, depth=np.roll(frame.depth.depth, columns, axis=1))
    )


def test_depth_of_another_view_is_noted(shared: Path):
    kitchen = open_sequence(shared / "data" / "seven_scenes" / "kitchen" / "seq-01@0:160:20")
    frames = [kitchen[k] for k in range(len(kitchen))]
    assert find_depth_shift(FrameList(frames)) is None
    note = find_depth_shift(FrameList([shift_depth(one, -24) for one in frames]))
    assert note is not None
    right, down = re.findall(r"moved by (-?\d+), (-?\d+) px", note)[0]
    assert 20 <= int(right) <= 36
    assert abs(int(down)) <= 6


def test_rendered_depth_passes():
    assert find_depth_shift(FrameList([depth_frame(place) for place in PLACES[:8]])) is None
