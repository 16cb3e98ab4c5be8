"""Test links between pieces of a recording: the path within a piece is known, only the
gaps are free."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.points.metric_points import StereoCamera
from topoloc.slam.keyframes import DisparityBias, KeyFrame, KeyFrameObservations
from topoloc.slam.loop_closure import Link, is_reachable
from topoloc.slam.place_matching import PlaceMatch

STEREO = StereoCamera(Camera.pinhole(640, 400, 380.0, 380.0, 319.5, 199.5), 45.0)
NOTHING = KeyFrameObservations(
    np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_)
)
STEP, NUM, GAP = 0.3, 20, 4  # metres and frames, of which ten a second


def walked() -> list[KeyFrame]:
    """Return three pieces of a straight walk along +z, each in its own world frame. GAP frames are
    lost between two of them."""
    keyframes = []
    for submap in range(3):
        own = Rigid3(exp_so3(np.array([0.0, 0.7 * submap, 0.0])), np.array([submap, 2.0, 0.0]))
        for k in range(NUM):
            at = Rigid3(np.eye(3), np.array([0.0, 0.0, -STEP * k]))
            t_ns = 100_000_000 * (submap * (NUM + GAP) + k)
            bias = DisparityBias(0.0, 1.0)
            keyframes.append(KeyFrame(0, k, t_ns, submap, STEREO, at @ own, NOTHING, bias))
    return keyframes


def link(source: int, target: int, ahead: float) -> Link:
    """Return a link: the target sees the same as the source, from `ahead` metres further."""
    target_from_source = Rigid3(np.eye(3), np.array([0.0, 0.0, -ahead]))
    rows = np.zeros(0, int)
    return Link(source, target, PlaceMatch(target_from_source, np.eye(6), rows, rows))


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize(
    ("submaps", "metres_gone", "is_possible"),
    [
        ((0, 1), 1.5, True),  # on as before
        ((0, 1), 0.0, True),  # stood still
        ((0, 1), -1.5, True),  # turned back at once
        ((0, 1), 5.5, False),
        ((0, 1), -2.5, False),
        ((0, 2), 8.7, True),  # 5.7 m in the piece between, 1.5 m in each gap
        ((0, 2), 6.0, True),
        ((0, 2), 0.0, False),  # an equal door: the piece between has led away from it
        ((0, 2), 17.0, False),
    ],
)
def test_a_link_agrees_with_the_path_between(
    submaps: tuple[int, int], metres_gone: float, is_possible: bool, is_reversed: bool
):
    keyframes = walked()
    last, first = NUM * submaps[0] + NUM - 1, NUM * submaps[1]
    source, target, ahead = last - 3, first + 2, metres_gone + 5 * STEP
    if is_reversed:
        source, target, ahead = target, source, -ahead
    assert is_reachable(link(source, target, ahead), keyframes) == is_possible
