"""Test SLAM as a whole, on a rendered room with exact truth and on short real recordings, in good
and bad light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tiny_world
import topoloc
from room_frames import FrameList, blackened, changed, depth_frame, stereo_frame, walk
from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.alignment import absolute_trajectory_errors
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.slam.slam import SlamResult, run_slam

PLACES = np.arange(0.0, 9.0, 0.4)


@pytest.fixture(scope="module")
def walked() -> SlamResult:
    return run_slam(walk(PLACES))


def errors(sequence: StereoSequence, poses: list[Rigid3 | None]) -> np.ndarray:
    both = [
        (true, pose)
        for true, pose in zip(sequence.poses, poses, strict=True)
        if true is not None and pose is not None
    ]
    return absolute_trajectory_errors([true for true, _ in both], [pose for _, pose in both])


def test_a_walk_through_the_room_is_found_to_millimetres(walked: SlamResult):
    assert walked.num_lost == 0
    assert walked.num_submaps == walked.num_joined == 1
    assert walked.num_keyframes < len(PLACES)
    assert errors(walk(PLACES), walked.poses[0]).max() < 0.005
    assert np.nanmedian(walked.right_residuals_px) < 0.5
    first = walked.poses[0][0]
    assert first is not None
    np.testing.assert_allclose(first.matrix(), np.eye(4), atol=1e-12)


def test_twice_the_same_recording_is_twice_the_same_trajectory(walked: SlamResult):
    again = run_slam(walk(PLACES))
    for a, b in zip(walked.poses[0], again.poses[0], strict=True):
        assert a is not None
        assert b is not None
        assert a.matrix().tobytes() == b.matrix().tobytes()


def test_depth_images_do_as_well():
    sequence = FrameList(
        [replace(depth_frame(float(p)), t_ns=i * 100_000_000) for i, p in enumerate(PLACES[:12])]
    )
    result = run_slam(sequence)
    assert result.num_lost == 0
    assert errors(sequence, result.poses[0]).max() < 0.01


def test_a_wrong_angle_between_the_cameras_is_found_by_moving():
    """All disparities are one pixel too large. Without the bias, points would be too near, by a
    share that grows with depth."""
    sequence = walk(PLACES)
    shifted = [
        replace(f, right=np.roll(f.right, -1, axis=1))
        for f in sequence.frames
        if f.right is not None
    ]
    result = run_slam(FrameList(shifted))
    assert result.disparity_bias_px[0] == pytest.approx(1.0, abs=0.3)
    assert errors(sequence, result.poses[0]).max() < 0.03


def test_a_dark_moment_is_survived_and_its_frames_have_no_pose():
    sequence = walk(PLACES)
    dark = changed(sequence, {i: blackened(sequence[i]) for i in range(8, 12)})
    result = run_slam(dark)
    assert [i for i, pose in enumerate(result.poses[0]) if pose is None] == [8, 9, 10, 11]
    assert result.num_submaps == 1
    assert errors(dark, result.poses[0]).max() < 0.01


def test_dropped_frames_are_bridged():
    kept = [i for i in range(len(PLACES)) if i not in (5, 6, 7, 13)]
    whole = walk(PLACES)
    result = run_slam(FrameList([whole[i] for i in kept]))
    assert result.num_lost == 0
    assert errors(FrameList([whole[i] for i in kept]), result.poses[0]).max() < 0.01


def test_elsewhere_after_a_long_darkness_is_a_submap_of_its_own_and_the_smaller_one_is_left_out():
    here, there = walk(PLACES[:6]), walk(PLACES[:8], seed=3)
    frames = [*here.frames, *[blackened(here[0])] * 12, *there.frames]
    timed = FrameList([replace(frame, t_ns=i * 100_000_000) for i, frame in enumerate(frames)])
    result = run_slam(timed)
    assert (result.num_submaps, result.num_joined) == (2, 1)
    assert all(pose is None for pose in result.poses[0][:18])
    assert all(pose is not None for pose in result.poses[0][18:])
    (apart,) = result.apart[0]  # its poses are known among themselves
    assert [pose is not None for pose in apart] == [True] * 6 + [False] * 20
    assert errors(here, apart[:6]).max() < 0.02


def test_the_same_place_after_a_long_darkness_is_joined_again():
    here, later = walk(PLACES[:14]), walk(PLACES[2:14] + 0.1)
    frames = [*here.frames, *[blackened(here[0])] * 12, *later.frames]
    timed = FrameList([replace(frame, t_ns=i * 100_000_000) for i, frame in enumerate(frames)])
    result = run_slam(timed)
    assert (result.num_submaps, result.num_joined) == (2, 2)
    assert errors(timed, result.poses[0]).max() < 0.02


def test_two_recordings_of_one_place_share_a_world():
    first, second = walk(PLACES[:16]), walk(PLACES[14:2:-1] + 0.2, name="back")
    result = run_slam([first, second])
    assert result.num_joined == 2
    assert result.num_loops > 0
    both = FrameList([*first.frames, *second.frames])
    assert errors(both, [*result.poses[0], *result.poses[1]]).max() < 0.02


def test_a_recording_of_another_place_is_not_joined():
    result = run_slam([walk(PLACES[:8]), walk(PLACES[:8], seed=3, name="elsewhere")])
    assert (result.num_submaps, result.num_joined) == (2, 1)
    assert not any(result.poses[1])


def test_a_camera_that_stands_still_makes_one_keyframe():
    frames = [replace(stereo_frame(2.0), t_ns=i * 100_000_000) for i in range(60)]
    result = run_slam(FrameList(frames))
    assert result.num_keyframes == 1
    positions = np.array([pose.translation for pose in result.poses[0] if pose is not None])
    assert len(positions) == 60
    assert np.abs(positions).max() < 1e-3


def test_left_and_right_swapped_are_noticed():
    sequence = walk(PLACES[:3])
    swapped = [
        replace(f, image=f.right, right=f.image) for f in sequence.frames if f.right is not None
    ]
    with pytest.raises(RecordingError, match="room: left and right pictures are swapped"):
        run_slam(FrameList(swapped))


def test_a_baseline_in_millimetres_is_noticed():
    rig = StereoRig.rectified(tiny_world.CAMERA, 1000 * tiny_world.BASELINE)
    with pytest.raises(CalibrationError, match="room: a baseline of 120 m; is it in millimetres"):
        run_slam(FrameList([replace(stereo_frame(0.0), rig=rig)]))


def test_pairs_of_different_moments_are_noticed():
    sequence = walk(PLACES)
    late = [
        replace(a, right=b.right)
        for a, b in zip(sequence.frames, sequence.frames[2:], strict=False)
    ]
    with pytest.raises(RecordingError, match="room: left and right pictures are no pairs"):
        run_slam(FrameList(late))


def test_nothing_but_darkness_is_an_error():
    sequence = walk(PLACES[:3])
    with pytest.raises(RecordingError, match="room: none of the 3 frames could be tracked"):
        run_slam(FrameList([blackened(frame) for frame in sequence.frames]))


def test_a_street_is_driven_along(shared: Path):
    sequence = topoloc.open_sequence(f"{shared}/data/kitti/sequences/street1@0:12")
    result = run_slam(sequence)
    assert result.num_lost == 0
    assert errors(sequence, result.poses[0]).max() < 0.1


def test_distorted_unrectified_pairs_are_tracked(shared: Path):
    result = run_slam(topoloc.open_sequence(f"{shared}/data/euroc/v1_01_part@0:10"))
    assert result.num_lost == 0
    assert np.nanmedian(result.right_residuals_px) < 0.7
