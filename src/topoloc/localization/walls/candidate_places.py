"""Where along the way might a picture have been taken by somebody who comes back?

Who walks back sees to the left what the mapping camera saw to the right, and the other way round.
So each side node that looks like one of the picture's views names a place, about where its wall
would be seen as far ahead from the other direction; and where both views name the same place, far
more speaks for it than for a door that looks like another door.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from topoloc.features.virtual_views import VirtualView
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.virtual_view_index import VirtualViewIndex

_NUM_CANDIDATES = 64  # of the side nodes that a view looks like, those that may name a place first
# cosine of the angle between the ways in which two cameras look that stand in the same place
_MIN_DIRECTION_COSINE = 0.5


@dataclass(frozen=True, eq=False)
class CandidatePlaces:
    """The places that one view names, row k by one side node: `rotations` and `centres` are those
    of the camera (world_from_cam, metres), `likeness` says how alike the two look."""

    rotations: Float[np.ndarray, "n 3 3"]
    centres: Float[np.ndarray, "n 3"]
    likeness: Float32[np.ndarray, " n"]

    @staticmethod
    def of(
        view: VirtualView, index: VirtualViewIndex, likeness: Float32[np.ndarray, " sides"]
    ) -> CandidatePlaces:
        """By all side nodes of the other hand: one of the same hand was seen by who walked the same
        way.

        Args:
            likeness: how much each side node looks like the view.
        """
        ahead = -view.cam_from_virtual.rotation[
            0, 2
        ]  # on the left a side camera's x axis points ahead, on the right back
        along = index.middles[:, 0]
        rows = np.flatnonzero(ahead * along < 0.0)
        centres = index.positions[rows] + 2.0 * along[rows, None] * index.rotations[rows, :, 0]
        return CandidatePlaces(
            index.rotations[rows] @ view.cam_from_virtual.rotation.T, centres, likeness[rows]
        )

    def near(self, other: CandidatePlaces, apart: float) -> Bool[np.ndarray, "n m"]:
        """Is each of these the same place as each of the others, `apart` metres from it at most and
        less than 60 degrees turned?"""
        away = np.linalg.norm(self.centres[:, None] - other.centres[None], axis=2)
        return (away < apart) & (
            self.rotations[:, :, 2] @ other.rotations[:, :, 2].T > _MIN_DIRECTION_COSINE
        )

    def rows(self, rows: Int[np.ndarray, " m"]) -> CandidatePlaces:
        return CandidatePlaces(self.rotations[rows], self.centres[rows], self.likeness[rows])


def select_likeliest_places(
    candidates: list[CandidatePlaces], num_places: int, apart: float
) -> list[Rigid3]:
    """The places (world_from_cam) that all views together name first, `apart` (metres) and more
    from each other.

    Each view counts with the most alike side node by which it names the place.
    """
    chosen: list[Rigid3] = []
    if not candidates:
        return chosen
    first = [
        view.rows(np.argsort(-view.likeness, kind="stable")[:_NUM_CANDIDATES])
        for view in candidates
    ]
    places = CandidatePlaces(
        *(
            np.concatenate([getattr(view, name) for view in first])
            for name in ("rotations", "centres", "likeness")
        )
    )
    total_similarity = np.zeros(len(places.likeness))
    for view in candidates:
        total_similarity += np.where(places.near(view, apart), view.likeness, 0.0).max(
            axis=1, initial=0.0
        )
    same, left = places.near(places, apart), np.ones(len(total_similarity), bool)
    for k in np.argsort(-total_similarity, kind="stable"):
        if len(chosen) == num_places:
            break
        if left[k]:
            chosen.append(Rigid3(places.rotations[k], places.centres[k]))
            left &= ~same[k]
    return chosen
