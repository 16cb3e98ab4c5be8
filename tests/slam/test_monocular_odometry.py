"""Test odometry of a single camera: motion in an unknown unit, and none for a camera
that only rotates."""

from __future__ import annotations

import numpy as np

from tiny_world import CAMERA, path_pose, render, room
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoFrame
from topoloc.slam.monocular_odometry import MonocularOdometry, MonocularSubmap


def _stretches(world_from_cams: list[Rigid3]) -> list[MonocularSubmap]:
    odometry, panels = MonocularOdometry(), room()
    for number, pose in enumerate(world_from_cams):
        picture, _ = render(panels, pose, noise_seed=number)
        odometry.process(number, StereoFrame(f"{number}", number * 100_000_000, picture, CAMERA))
    return odometry.submaps


def test_the_motion_is_found_but_for_its_unit():
    truth = [path_pose(0.5 * number) for number in range(16)]
    (found,) = _stretches(truth)
    stretch = found.submap_from_cams()
    assert list(stretch) == list(range(len(truth)))
    own_from_world = stretch[0] @ truth[0].inverse()
    own = np.array([stretch[k].translation - stretch[0].translation for k in stretch])
    true = np.array(
        [(pose.translation - truth[0].translation) @ own_from_world.rotation.T for pose in truth]
    )
    unit = np.sum(own * true) / np.sum(own * own)
    assert np.linalg.norm(unit * own - true, axis=1).max() < 0.02
    assert max(
        (stretch[k].inverse() @ own_from_world @ truth[k]).angle() for k in stretch
    ) < np.deg2rad(0.5)


def test_a_camera_that_only_turns_has_no_odometry():
    here = path_pose(4.0)
    turns = [
        Rigid3(here.rotation @ exp_so3(np.array([0.0, 0.03 * number, 0.0])), here.translation)
        for number in range(10)
    ]
    assert _stretches(turns) == []
