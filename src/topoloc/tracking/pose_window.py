"""Smooth the last localized images together.

Localization has about a centimetre of noise, point tracking a tenth of that. A pose graph over the
last few localized images (`slam/pose_graph.py`) combines the two. Its node 0 is the world. A robust
loss limits the influence of a wrong localization.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.slam.pose_graph import Edge, optimize_pose_graph


@dataclass(frozen=True, eq=False)
class _Entry:
    """Hold one localized image. The covariances are those of left perturbations.

    The motion of the first entry is not used.
    """

    cam_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    cam_from_before: Rigid3
    motion_covariance: Float[np.ndarray, "6 6"]


class PoseWindow:
    """Hold the last `size` localized images, which are adjusted together."""

    def __init__(self, size: int = 10) -> None:
        self._entries: deque[_Entry] = deque(maxlen=size)
        self._smoothed: deque[Rigid3] = deque(maxlen=size)
        self._covariance = np.zeros((6, 6))  # of the last one of these

    def clear(self) -> None:
        """Remove all images."""
        self._entries.clear()
        self._smoothed.clear()

    def add(
        self,
        cam_from_world: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        cam_from_before: Rigid3,
        motion_covariance: Float[np.ndarray, "6 6"],
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """Add an image and return its smoothed cam_from_world with the covariance of the left
        perturbation.

        Args:
            cam_from_world: pose at which the image was localized.
            covariance: covariance of its left perturbation.
            cam_from_before: motion since the last added image.
            motion_covariance: covariance of the left perturbation of the motion.
        """
        if self._smoothed:
            adjoint = cam_from_before.adjoint()
            before = adjoint @ self._covariance @ adjoint.T + motion_covariance
            both = before @ np.linalg.solve(before + covariance, covariance)
            self._covariance = (both + both.T) / 2.0  # symmetric up to rounding
        else:
            self._covariance = covariance
        self._smoothed.append(
            cam_from_before @ self._smoothed[-1] if self._smoothed else cam_from_world
        )
        self._entries.append(_Entry(cam_from_world, covariance, cam_from_before, motion_covariance))
        edges = [
            Edge(0, k, entry.cam_from_world, entry.covariance, is_loop=True)
            for k, entry in enumerate(self._entries, start=1)
        ]
        edges += [
            Edge(k - 1, k, entry.cam_from_before, entry.motion_covariance, is_loop=True)
            for k, entry in enumerate(self._entries, start=1)
            if k > 1
        ]
        poses = optimize_pose_graph(
            [Rigid3.identity(), *self._smoothed], edges, max_steps=5, min_step=1e-4
        )
        self._smoothed = deque(poses[1:], maxlen=self._smoothed.maxlen)
        return self._smoothed[-1], self._covariance
