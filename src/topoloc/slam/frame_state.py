"""What odometry carries from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int

from topoloc.geometry.rigid import Rigid3
from topoloc.slam.disparity import MeasuredView
from topoloc.slam.keyframes import KeyFrame


@dataclass(frozen=True, eq=False)
class FramePose:
    """Where a frame is: relative to a key frame, so that it moves with it."""

    frame_idx: int
    keyframe: KeyFrame
    cam_from_keyframe: Rigid3
    view_from_cam: Rigid3

    def world_from_cam(self) -> Rigid3:
        """The pose of the frame's own camera, which rectification may have turned."""
        return (self.cam_from_keyframe @ self.keyframe.cam_from_world).inverse() @ self.view_from_cam


@dataclass(eq=False)
class Tracks:
    """The points being followed: where they are in the last frame, where in the last key frame, and their landmarks."""

    landmark_ids: Int[np.ndarray, " n"]
    points_img: Float32[np.ndarray, "n 2"]
    points_ref: Float32[np.ndarray, "n 2"]

    def select(self, rows: np.ndarray) -> Tracks:
        return Tracks(self.landmark_ids[rows], self.points_img[rows], self.points_ref[rows])


@dataclass(eq=False)
class LastFrame:
    """The frame before."""

    measured: MeasuredView
    cam_from_world: Rigid3
