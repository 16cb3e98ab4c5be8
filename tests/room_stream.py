"""Render the room of `tiny_world` as a stream: thirty images per second along its path,
with exact truth."""

from __future__ import annotations

from functools import cache

import numpy as np

from tiny_world import path_pose, render, room
from topoloc.geometry.rigid import Rigid3

INTERVAL_NS = 33_333_333
NUM_PICTURES = 40


@cache
def room_stream() -> list[tuple[int, np.ndarray, Rigid3]]:
    """Return (t_ns, grey image, world_from_cam) along the path, about two centimetres per image."""
    panels = room()
    poses = [path_pose(2.0 + 0.15 * number) for number in range(NUM_PICTURES)]
    return [
        (number * INTERVAL_NS, render(panels, pose, noise_seed=400 + number)[0], pose)
        for number, pose in enumerate(poses)
    ]


@cache
def far_away(num: int = 5) -> list[tuple[np.ndarray, Rigid3]]:
    """Return images of the far end of the path, at least 0.8 m from the start of the stream."""
    panels = room()
    poses = [path_pose(10.5 + 0.1 * number) for number in range(num)]
    return [
        (render(panels, pose, noise_seed=700 + number)[0], pose)
        for number, pose in enumerate(poses)
    ]
