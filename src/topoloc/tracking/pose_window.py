"""The last localized pictures adjusted together: each knows where it is in the map, and how the
camera moved from one to the next.

Localizing has a centimetre of noise, following points a tenth of it. A pose graph over the last few
localized pictures (`slam/pose_graph.py`; node 0 is the world) takes from each what it knows best,
with a loss under which a wrong localization loses its say.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import Between
from topoloc.geometry.rigid import Rigid3
from topoloc.slam.pose_graph import Edge, PoseGraphConfig, optimize_pose_graph


@dataclass(frozen=True)
class PoseWindowConfig:
    """How many localized pictures, and how they are weighed."""

    size: Annotated[int, Between(1, 1000)] = 10
    """Localized pictures that are adjusted together."""
    graph: PoseGraphConfig = field(
        default_factory=lambda: PoseGraphConfig(max_steps=5, min_step=1e-4)
    )


@dataclass(frozen=True, eq=False)
class _Entry:
    """Covariances of left perturbations; of the first entry of a window the motion says nothing."""

    cam_from_world: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    cam_from_before: Rigid3
    motion_covariance: Float[np.ndarray, "6 6"]


class PoseWindow:
    """The last few localized pictures."""

    def __init__(self, config: PoseWindowConfig) -> None:
        self._config = config
        self._entries: deque[_Entry] = deque(maxlen=config.size)
        self._smoothed: deque[Rigid3] = deque(maxlen=config.size)
        self._covariance = np.zeros((6, 6))  # of the last one of these

    def clear(self) -> None:
        self._entries.clear()
        self._smoothed.clear()

    def add(
        self,
        cam_from_world: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        cam_from_before: Rigid3,
        motion_covariance: Float[np.ndarray, "6 6"],
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """The smoothed cam_from_world of a picture that was localized at `cam_from_world`,
        `cam_from_before` after the last one added, and the covariance of its left perturbation.
        """
        if self._smoothed:
            adjoint = cam_from_before.adjoint()
            before = adjoint @ self._covariance @ adjoint.T + motion_covariance
            both = before @ np.linalg.solve(before + covariance, covariance)
            self._covariance = (both + both.T) / 2.0  # symmetric but for rounding
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
        poses = optimize_pose_graph([Rigid3.identity(), *self._smoothed], edges, self._config.graph)
        self._smoothed = deque(poses[1:], maxlen=self._config.size)
        return self._smoothed[-1], self._covariance
