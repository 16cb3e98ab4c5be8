"""Test prepared frames: rectified pairs, and depth registered to the image's camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tiny_world
import topoloc
from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import DepthImage, StereoFrame
from topoloc.recordings.frame_preparation import prepare_frame, register_depth


def test_a_rectified_pair_is_taken_as_it_is(tiny_recording: Path):
    frame = topoloc.open_sequence(tiny_recording)[3]
    view = prepare_frame(frame)
    assert view.picture is frame.image
    assert view.right_grey is frame.right
    assert view.camera == tiny_world.CAMERA
    assert prepare_frame(frame, with_depth=False).right_grey is None


def test_a_rotated_pair_is_rectified_and_returns_its_rotation():
    panels, world_from_left = tiny_world.room(), tiny_world.path_pose(2)
    right_from_left = Rigid3(
        exp_so3(np.array([0.01, 0.03, -0.02])), np.array([-0.12, 0.004, 0.003])
    )
    world_from_right = world_from_left @ right_from_left.inverse()
    camera = Camera("OPENCV", 320, 240, (*tiny_world.CAMERA.params, -0.1, 0.02, 0.0, 0.0))
    left, right = (
        tiny_world.render(panels, pose, camera)[0] for pose in (world_from_left, world_from_right)
    )
    rig = StereoRig(camera, camera, right_from_left)
    frame = StereoFrame("a", 0, left, camera, right=right, rig=rig)
    view = prepare_frame(frame)
    assert view.rig is not None
    assert view.rig.is_rectified
    assert view.right_grey is not None
    np.testing.assert_array_equal(
        prepare_frame(replace(frame, right=None), with_depth=False).grey, view.grey
    )
    world_from_view = world_from_left @ view.view_from_cam.inverse()
    for seen, pose in (
        (view.grey, world_from_view),
        (view.right_grey, world_from_view @ view.rig.right_from_left.inverse()),
    ):
        expected, _ = tiny_world.render(panels, pose, view.camera)
        assert np.median(np.abs(seen.astype(float) - expected)) < 3.0


def test_frames_without_depth_or_calibration_are_refused(tiny_recording: Path):
    frame = topoloc.open_sequence(tiny_recording)[0]
    with pytest.raises(CalibrationError, match=r"000000\.png: no calibration"):
        prepare_frame(replace(frame, camera=None))
    with pytest.raises(RecordingError, match="single pictures only"):
        prepare_frame(replace(frame, right=None, rig=None))


DEPTH_CAMERA = Camera.pinhole(160, 120, 140.0, 140.0, 79.5, 59.5)


def test_registered_depth_equals_depth_of_the_other_camera():
    panels, world_from_depth = tiny_world.room(), tiny_world.path_pose(1)
    cam_from_depth = Rigid3(
        exp_so3(np.array([0.01, -0.02, 0.005])), np.array([-0.03, 0.002, 0.004])
    )
    camera = Camera.pinhole(150, 110, 135.0, 134.0, 74.0, 55.0)
    _, depth = tiny_world.render(panels, world_from_depth, DEPTH_CAMERA)
    _, expected = tiny_world.render(panels, world_from_depth @ cam_from_depth.inverse(), camera)
    registered = register_depth(
        DepthImage(depth.astype(np.float32), DEPTH_CAMERA, cam_from_depth), camera
    )
    known = np.isfinite(registered) & np.isfinite(expected)
    assert known.mean() > 0.85
    error = np.abs(registered - expected)[known]
    assert np.median(error) < 0.01
    assert (error > 0.1).mean() < 0.03  # at the edges of the boards


def test_unregistered_depth_that_is_coarser_than_the_picture_stays_so():
    panels, world_from_depth = tiny_world.room(), tiny_world.path_pose(1)
    cam_from_depth = Rigid3(np.eye(3), np.array([-0.03, 0.002, 0.004]))
    camera = Camera.pinhole(900, 660, 810.0, 804.0, 446.5, 332.5)
    _, depth = tiny_world.render(panels, world_from_depth, DEPTH_CAMERA)
    registered = register_depth(
        DepthImage(depth.astype(np.float32), DEPTH_CAMERA, cam_from_depth), camera
    )
    seen_by = camera.rescaled(*registered.shape[::-1])
    assert seen_by.fx == pytest.approx(DEPTH_CAMERA.fx, rel=0.01)
    _, expected = tiny_world.render(panels, world_from_depth @ cam_from_depth.inverse(), seen_by)
    known = np.isfinite(registered) & np.isfinite(expected)
    assert known.mean() > 0.8
    assert np.median(np.abs(registered - expected)[known]) < 0.01


def test_the_nearest_surface_wins_and_unknown_stays_unknown():
    depth = np.full((120, 160), np.nan, np.float32)
    depth[60, 80], depth[60, 81] = 4.0, 1.0
    coarse = DEPTH_CAMERA.rescaled(16, 12)
    near_last = register_depth(DepthImage(depth, DEPTH_CAMERA, Rigid3.identity()), coarse)
    depth[60, 80], depth[60, 81] = 1.0, 4.0
    near_first = register_depth(DepthImage(depth, DEPTH_CAMERA, Rigid3.identity()), coarse)
    for registered in (near_last, near_first):
        assert registered[6, 8] == 1.0
        assert np.isfinite(registered).sum() == 1


def test_points_outside_of_the_picture_or_behind_are_left_out():
    depth = np.full((120, 160), 1.0, np.float32)
    turned = Rigid3(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    assert np.isnan(register_depth(DepthImage(depth, DEPTH_CAMERA, turned), DEPTH_CAMERA)).all()
    aside = Rigid3(np.eye(3), np.array([0.5, 0.0, 0.0]))
    registered = register_depth(DepthImage(depth, DEPTH_CAMERA, aside), DEPTH_CAMERA)
    assert np.isnan(registered[:, :70]).all()
    assert (registered[:, 70:] == 1.0).all()


def test_registered_depth_of_the_same_camera_is_untouched():
    depth = DepthImage(np.ones((120, 160), np.float32), DEPTH_CAMERA, Rigid3.identity())
    assert register_depth(depth, DEPTH_CAMERA) is depth.depth
