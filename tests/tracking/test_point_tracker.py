"""Track map points through the rendered room, with known depth of each pixel and known poses."""

from __future__ import annotations

import numpy as np
import pytest

import tiny_world
from room_stream import room_stream
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.localization.pose_fit import PointObservations
from topoloc.points.point_tracking import find_corners
from topoloc.tracking.point_tracker import PointTracker

CAMERA = tiny_world.CAMERA


@pytest.fixture
def follower() -> PointTracker:
    _, grey, pose = room_stream()[0]
    depth = tiny_world.render(tiny_world.room(), pose)[1]
    corners = find_corners(grey, np.zeros((0, 2)))
    z = depth[np.rint(corners[:, 1]).astype(int), np.rint(corners[:, 0]).astype(int)]
    corners, z = corners[np.isfinite(z)], z[np.isfinite(z)]
    points_cam = (
        np.column_stack([CAMERA.normalized_from_img(corners.astype(np.float64)), np.ones(len(z))])
        * z[:, None]
    )
    seen = PointObservations(
        corners, pose.apply(points_cam), np.tile(1e-6 * np.eye(3), (len(z), 1, 1))
    )
    return PointTracker(grey, seen, pose.inverse(), CAMERA)


def test_the_motion_is_measured_to_millimetres(follower: PointTracker):
    first, last = room_stream()[0][2], room_stream()[0][2]
    for _, grey, pose in room_stream()[1:6]:
        followed = follower.track_points(grey, last.inverse())
        assert followed is not None
        truth = pose.inverse() @ first
        assert translation_error(followed.cam_from_ref, truth) < 0.006
        assert rotation_error(followed.cam_from_ref, truth) < np.deg2rad(0.15)
        assert followed.num_inliers >= 100
        last = pose
    assert followed.shift_px > 5.0
    assert 0.6 < followed.tracked_ratio <= 1.0


def test_another_picture_has_no_pose(follower: PointTracker):
    elsewhere = tiny_world.render(tiny_world.room(seed=5), room_stream()[0][2])[0]
    assert follower.track_points(elsewhere, room_stream()[0][2].inverse()) is None
    assert follower.track_points(np.full_like(elsewhere, 90), room_stream()[0][2].inverse()) is None
    found_again = follower.track_points(room_stream()[1][1], room_stream()[0][2].inverse())
    assert found_again is not None, "a picture that failed changes nothing"


def test_points_are_spread_and_too_few_are_none():
    _, grey, pose = room_stream()[0]
    none = PointObservations(np.zeros((0, 2), np.float32), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert (
        PointTracker(grey, none, pose.inverse(), CAMERA).track_points(grey, pose.inverse()) is None
    )
