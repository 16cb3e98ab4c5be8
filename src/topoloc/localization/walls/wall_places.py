"""Where along the way might a picture have been taken by somebody who comes back?

Who walks back sees to the left what the mapping camera saw to the right, and the other way round. So each side node that looks like one of
the picture's views names a place, about where its wall would be seen as far ahead from the other direction; and where both views name the
same place, far more speaks for it than for a door that looks like another door.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.wall_index import WallIndex
from topoloc.localization.walls.wall_matching import SeenSide


@dataclass(frozen=True, eq=False)
class WallPlaces:
    """Row k: a place that one view names by one side node: where the camera would be, and which way it looks (world), and how alike the two
    are."""

    centres: Float[np.ndarray, "n 3"]
    axes: Float[np.ndarray, "n 3"]
    likeness: Float32[np.ndarray, " n"]
    views: Int[np.ndarray, " n"]
    world_from_cams: list[Rigid3]

    def likeliest(self, num_places: int, apart: float) -> list[Rigid3]:
        """The places (world_from_cam) that both views together name first, `apart` (metres) and more from each other.

        Each view counts with the most alike side node that names the place, within that distance and less than 60 degrees turned.
        """
        left = np.argsort(-self._together(apart), kind="stable")
        chosen: list[int] = []
        while len(left) and len(chosen) < num_places:
            chosen.append(int(left[0]))
            left = left[~self._beside(left, chosen[-1], apart)]
        return [self.world_from_cams[k] for k in chosen]

    def _together(self, apart: float) -> Float[np.ndarray, " n"]:
        """The likeness of each place by both views."""
        total = np.zeros(len(self.likeness))
        for view in np.unique(self.views):
            of_view = np.flatnonzero(self.views == view)
            for k in range(len(total)):
                near = of_view[self._beside(of_view, k, apart)]
                total[k] += self.likeness[near].max() if len(near) else 0.0
        return total

    def _beside(self, rows: Int[np.ndarray, " m"], k: int, apart: float) -> np.ndarray:
        near = np.linalg.norm(self.centres[rows] - self.centres[k], axis=1) < apart
        return near & (self.axes[rows] @ self.axes[k] > 0.5)


def name_places(index: WallIndex, seen: list[SeenSide], likeness: list[Float32[np.ndarray, " sides"]]) -> WallPlaces:
    """What each view names by each side node of the other hand: a node of the same hand was seen in the same direction.

    Args:
        likeness: how much each side node looks like each view.
    """
    poses, scores, views = list[Rigid3](), list[float](), list[int]()
    for number, (side, of_view) in enumerate(zip(seen, likeness, strict=True)):
        ahead = -side.view.cam_from_side.rotation[0, 2]  # on the left a side camera's x axis points ahead, on the right back
        for row in range(len(of_view)):
            along = index.middles[row, 0]
            if ahead * along >= 0.0:
                continue
            world_from_side = index.world_from_sides[row] @ Rigid3(np.eye(3), np.array([2.0 * along, 0.0, 0.0]))
            poses.append(world_from_side @ side.view.cam_from_side.inverse())
            scores.append(float(of_view[row]))
            views.append(number)
    return WallPlaces(
        np.array([pose.translation for pose in poses]).reshape(-1, 3),
        np.array([pose.rotation[:, 2] for pose in poses]).reshape(-1, 3),
        np.array(scores, np.float32),
        np.array(views, int),
        poses,
    )
