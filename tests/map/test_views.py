"""Views with the pose of what they see."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tiny_world
import topoloc
from topoloc.errors import RecordingError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.map.views import mapping_view
from topoloc.sequences.frame import StereoFrame


def test_the_pose_turns_with_rectification():
    right_from_left = Rigid3(exp_so3(np.array([0.01, 0.03, -0.02])), np.array([-0.12, 0.004, 0.003]))
    picture, pose = np.zeros((240, 320), np.uint8), tiny_world.path_pose(2)
    camera = Camera("OPENCV", 320, 240, (*tiny_world.CAMERA.params, -0.1, 0.02, 0.0, 0.0))
    frame = StereoFrame("a", 0, picture, camera, right=picture, rig=StereoRig(camera, camera, right_from_left), world_from_cam=pose)
    view = mapping_view(frame)
    assert view.view_from_cam.angle() > 0.005
    np.testing.assert_allclose((view.world_from_cam @ view.view_from_cam).matrix(), pose.matrix(), atol=1e-12)


def test_a_frame_without_a_pose_is_refused(tiny_recording: Path):
    frame = topoloc.open_sequence(tiny_recording)[0]
    assert frame.world_from_cam is not None
    np.testing.assert_array_equal(mapping_view(frame).world_from_cam.matrix(), frame.world_from_cam.matrix())
    with pytest.raises(RecordingError, match=r"000000\.png: no pose"):
        mapping_view(replace(frame, world_from_cam=None))
