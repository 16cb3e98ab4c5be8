"""Render a wall of equal panels one metre apart, seen by a stereo camera that moves along it. SLAM
must handle lost frames there.

The wall runs along the world's +x, 1.6 m in front of the camera. Its texture repeats exactly. Tests
may add boards, all different.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from room_frames import FrameList
from tiny_world import BASELINE, LEVEL_FROM_CAM, Panel, render, right_pose, smooth_texture
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoFrame

PERIOD, STEP = 1.0, 0.12
CAMERA = Camera.pinhole(320, 200, 200.0, 200.0, 159.5, 99.5)
_HALF, _FROM = 12, -3.0
_WALL, _UP_DOWN, _RIGHT = 1.6, np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])


@cache
def wall(boards: tuple[float, ...] = ()) -> list[Panel]:
    """Return the wall from x = -3 m to 21 m, above a plain floor. Boards are 0.6 m wide."""
    one = smooth_texture(7, (PERIOD / 2, 1.2))
    panels = [
        Panel(
            np.array([_FROM + _HALF, _WALL, 0.0]),
            _RIGHT,
            _UP_DOWN,
            (float(_HALF), 1.2),
            np.tile(one, (1, 2 * _HALF)),
        )
    ]
    for number, x in enumerate(boards):
        panels.append(
            Panel(
                np.array([x, _WALL - 0.05, 0.1]),
                _RIGHT,
                _UP_DOWN,
                (0.3, 0.5),
                smooth_texture(50 + number, (0.3, 0.5)),
            )
        )
    return panels


def pose_at(x: float) -> Rigid3:
    """Return world_from_cam of a camera that moves along the wall and sways a little."""
    sway = exp_so3(np.array([0.0, 0.0, 0.02 * np.sin(2.1 * x)])) @ exp_so3(
        np.array([0.01 * np.cos(3.0 * x), 0.0, 0.0])
    )
    return Rigid3(
        sway @ LEVEL_FROM_CAM, np.array([x, 0.02 * np.sin(3.0 * x), 0.01 * np.cos(5.0 * x)])
    )


@cache
def _frame(x: float, boards: tuple[float, ...]) -> StereoFrame:
    pose, panels = pose_at(x), wall(boards)
    left, right = (
        render(panels, p, CAMERA, noise_seed=round(1000 * x) + k)[0]
        for k, p in enumerate((pose, right_pose(pose)))
    )
    return StereoFrame(
        f"{x:.2f}",
        0,
        left,
        CAMERA,
        right,
        StereoRig.rectified(CAMERA, BASELINE),
        world_from_cam=pose,
    )


def walk_along(
    places: Sequence[float], times: Sequence[float], boards: tuple[float, ...] = ()
) -> FrameList:
    """Return frames at these places (metres along the wall) and times (seconds)."""
    frames = [
        replace(_frame(float(x), boards), t_ns=round(t * 1e9))
        for x, t in zip(places, times, strict=True)
    ]
    return FrameList(frames, "wall")
