"""Check that stereo pairs which would give a wrong map are refused, whatever the source of poses. A
wrong baseline or depth factor is named before the poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tiny_world
from room_frames import FrameList, walk
from topoloc.errors import RecordingError, TrajectoryError
from topoloc.geometry.rig import StereoRig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.recordings.frame import SequenceView, StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import Recording
from topoloc.slam.input_checks import check_stereo
from topoloc.slam.pose_checks import check_poses

PLACES = [0.0, 0.4, 0.8, 1.2, 1.6]


def swapped(frame: StereoFrame) -> StereoFrame:
    assert frame.right is not None
    return replace(frame, image=frame.right, right=frame.image)


def lowered(frame: StereoFrame, rows: int = 3) -> StereoFrame:
    assert frame.right is not None
    return replace(frame, right=np.roll(frame.right, rows, axis=0))


def test_right_pairs_pass():
    check_stereo(walk(PLACES))


def test_a_recording_without_pairs_passes():
    check_stereo(FrameList([replace(f, right=None, rig=None) for f in walk(PLACES).frames]))


def test_pairs_with_poses_are_checked_before_mapping():
    frames = walk(PLACES).frames
    with pytest.raises(RecordingError, match="left and right pictures are swapped"):
        build_map(FrameList([swapped(frame) for frame in frames]))
    with pytest.raises(RecordingError, match=r"apart vertically .*not rectified as calibrated"):
        build_map(FrameList([lowered(frame) for frame in frames]))


@pytest.mark.parametrize(
    "name", ["zed_lab/session1", "zed_lab/session2", "kitti/sequences/street1", "euroc/v1_01_part"]
)
def test_real_pairs_pass_in_the_right_order_only(shared: Path, name: str):
    sequence = open_sequence(shared / "data" / name)
    check_stereo(sequence)
    frames = [swapped(sequence[k]) for k in (0, 20, 40)]
    with pytest.raises(RecordingError, match="swapped"):
        check_stereo(FrameList(frames))


def test_swapped_folders_with_truth_are_refused(shared: Path):
    case = shared / "cases" / "turn3" / "left_right_swapped_with_poses"
    with pytest.raises(RecordingError, match="left and right pictures are swapped"):
        build_map(case)


def test_a_wrong_baseline_is_named_before_the_poses():
    frames = walk([0.8 * k for k in range(12)]).frames
    narrow = StereoRig.rectified(tiny_world.CAMERA, 0.5 * tiny_world.BASELINE)
    with pytest.raises(TrajectoryError) as caught:
        check_poses(FrameList([replace(frame, rig=narrow) for frame in frames]))
    calibration, _, poses = str(caught.value).partition("otherwise")
    assert "--poses scale=0." in poses
    baseline = float(calibration.partition("a baseline of ")[2].partition(" m")[0])
    assert baseline == pytest.approx(tiny_world.BASELINE, rel=0.03)
    check_poses(
        FrameList(
            [replace(f, rig=StereoRig.rectified(tiny_world.CAMERA, baseline)) for f in frames]
        )
    )


@pytest.mark.parametrize(("units", "wrong"), [(5000.0, 1000.0), (1000.0, 5000.0)])
def test_a_wrong_depth_factor_is_named_before_the_poses(shared: Path, units: float, wrong: float):
    sequence = open_sequence(shared / "data" / "seven_scenes" / "kitchen" / "seq-01@0:120")
    assert isinstance(sequence, SequenceView)
    assert isinstance(sequence.base, Recording)
    assert sequence.base.depth is not None
    depth = replace(sequence.base.depth, units_per_metre=1000.0 * wrong / units)
    with pytest.raises(TrajectoryError, match='a "depth_factor" of 1000, not'):
        check_poses(replace(sequence, base=replace(sequence.base, depth=depth)))
