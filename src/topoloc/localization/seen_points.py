"""Map points that one picture has been found to show: what can be followed from there without asking the map again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Row k: the pixel at which a map point was found, its world position (metres) and the covariance of that (m^2)."""

    points_img: Float32[np.ndarray, "n 2"]
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]

    def __len__(self) -> int:
        return len(self.points_img)

    def select(self, rows: np.ndarray) -> SeenPoints:
        return SeenPoints(self.points_img[rows], self.points_world[rows], self.covariances[rows])

    def in_image(self, scale: float) -> SeenPoints:
        """The same in a picture that is `scale` times as wide."""
        points_img = ((self.points_img + np.float32(0.5)) * np.float32(scale) - np.float32(0.5)).astype(np.float32)
        return SeenPoints(points_img, self.points_world, self.covariances)
