"""Test joins of submaps across a gap: many weak image pairs together suffice, one object in two
rooms does not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from aliased_wall import walk_along

import tiny_world
from room_frames import RIG, FrameList, walk
from topoloc.geometry.alignment import absolute_trajectory_errors
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.points.metric_points import measured_view
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.slam.keyframes import FramePose, KeyFrame, Landmarks, PlaceFeatures
from topoloc.slam.loop_closure import find_links, match_keyframes
from topoloc.slam.odometry import Odometry
from topoloc.slam.place_matching import extract_place_features, match_places
from topoloc.slam.slam import run_slam
from topoloc.slam.submap_joins import find_joins, group_submaps

HERE, BEYOND = np.arange(0.0, 4.8, 0.4), np.arange(6.0, 10.8, 0.4)
GAP_S = 2.0
AROUND = (
    0.8  # radians by which the camera has turned in the gap: a strip at the edge is in both parts
)


def frames(
    places: np.ndarray, panels: list[tiny_world.Panel], turn: float = 0.0, start_s: float = 0.0
) -> list[StereoFrame]:
    """Return frames a tenth of a second apart, with the camera rotated to the left by
    `turn` radians."""
    made = []
    for i, place in enumerate(places):
        path = tiny_world.path_pose(float(place))
        pose = Rigid3(exp_so3(np.array([0.0, 0.0, turn])) @ path.rotation, path.translation)
        noise = 10 * round(1000 * start_s) + 2 * i
        left, right = (
            tiny_world.render(panels, p, noise_seed=noise + k)[0]
            for k, p in enumerate((pose, tiny_world.right_pose(pose)))
        )
        t_ns = round(1e9 * start_s) + i * 100_000_000
        made.append(
            StereoFrame(
                f"{t_ns}.png", t_ns, left, tiny_world.CAMERA, right, RIG, world_from_cam=pose
            )
        )
    return made


def tracked(*recordings: FrameList) -> tuple[list[KeyFrame], list[FramePose]]:
    """Return key frames and frame poses of odometry alone."""
    keyframes: list[KeyFrame] = []
    landmarks, poses = Landmarks(), []
    for number, recording in enumerate(recordings):
        odometry = Odometry(number, keyframes, landmarks)
        for i, frame in enumerate(recording.frames):
            poses += odometry.process(i, frame, measured_view(frame))
        poses += odometry.finish()
    return keyframes, poses


def looking_at(*recordings: StereoSequence):
    def look(keyframe: KeyFrame) -> PlaceFeatures:
        return extract_place_features(
            prepare_frame(recordings[keyframe.recording][keyframe.frame_idx])
        )

    return look


def test_weak_pairs_at_both_sides_of_a_gap_join_without_a_lost_frame(
    monkeypatch: pytest.MonkeyPatch,
):
    limit = 120  # no single image pair suffices, except for joins
    for module, function in (("odometry", match_places), ("loop_closure", match_keyframes)):
        strict = partial(function, min_inliers=limit)
        monkeypatch.setattr(f"topoloc.slam.{module}.{function.__name__}", strict)
    room = tiny_world.room()
    walked = FrameList([*frames(HERE, room), *frames(BEYOND, room, AROUND, GAP_S)])
    result = run_slam(walked)
    assert (result.num_submaps, result.num_joined, result.num_lost) == (2, 2, 0)
    found = [pose for pose in result.poses[0] if pose is not None]
    assert len(found) == len(walked)
    assert (
        absolute_trajectory_errors([pose for pose in walked.poses if pose is not None], found).max()
        < 0.02
    )


@pytest.fixture(scope="module")
def two_rooms() -> tuple[FrameList, FrameList]:
    """Return frames of two rooms that share one board at the same place and differ in all else."""
    here, there = tiny_world.room(), tiny_world.room(3)
    return FrameList(frames(HERE, here)), FrameList(
        frames(HERE + 0.1, [*there[:3], here[3], there[4]], start_s=10.0)
    )


def test_a_board_in_two_rooms_does_not_join_them(
    two_rooms: tuple[FrameList, FrameList], monkeypatch: pytest.MonkeyPatch
):
    keyframes, _ = tracked(*two_rooms)
    assert find_links(keyframes) == []
    assert find_joins(keyframes, [], looking_at(*two_rooms)) == []
    monkeypatch.setattr("topoloc.slam.submap_joins._is_join_verified", lambda *_: True)
    deceived = find_joins(keyframes, [], looking_at(*two_rooms))
    assert len(deceived) > 0
    assert set(group_submaps(keyframes, deceived).values()) == {0}


def test_equal_panels_join_nothing():
    """Each recording is shorter than a panel, so that no other place contradicts a join."""
    places, times = np.arange(0.0, 1.0, 0.12), list(0.1 * np.arange(9))
    here, there = (walk_along(list(places + start), times) for start in (0.0, 10.06))
    keyframes, _ = tracked(here, there)
    assert find_joins(keyframes, [], looking_at(here, there)) == []


def test_unlocalized_frames_at_the_end_are_a_submap():
    """Six frames of another place are fewer than relocalization tries."""
    here, there = walk(list(HERE[:6])), walk(list(HERE[:6]), seed=3)
    later = [replace(frame, t_ns=frame.t_ns + 2_000_000_000) for frame in there.frames]
    keyframes, poses = tracked(FrameList([*here.frames, *later]))
    assert [pose.frame_idx for pose in poses] == list(range(12))
    assert {keyframe.submap for keyframe in keyframes} == {0, 1}
    assert [pose.keyframe.submap for pose in poses] == [0] * 6 + [1] * 6
