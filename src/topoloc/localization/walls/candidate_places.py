"""Select places along the trajectory where an image in the reverse direction may have been taken.

In the reverse direction the left side shows what the mapping camera saw on the right. So each
virtual view similar to one of the image's views gives a candidate place. It is the place from which
the wall would be seen as far ahead in the other direction. Two views that agree on a place are much
stronger evidence than one door that resembles another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from topoloc.features.virtual_views import VirtualView
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.walls.virtual_view_index import VirtualViewIndex

# minimum cosine between the viewing directions of two cameras in the same place
_MIN_DIRECTION_COSINE = 0.5


@dataclass(frozen=True, eq=False)
class CandidatePlaces:
    """Hold the candidate places of one view of the image, row k from one virtual view of the map.

    `rotations` and `centres` are camera poses (world_from_cam, metres). `likeness` is the
    similarity of the two views.
    """

    rotations: Float[np.ndarray, "n 3 3"]
    centres: Float[np.ndarray, "n 3"]
    likeness: Float32[np.ndarray, " n"]

    @staticmethod
    def of(
        view: VirtualView, index: VirtualViewIndex, likeness: Float32[np.ndarray, " sides"]
    ) -> CandidatePlaces:
        """Return the places of all virtual views of the opposite side.

        Those of the same side belong to the mapped direction.

        Args:
            likeness: similarity of each virtual view of the map to the view.
        """
        ahead = -view.cam_from_virtual.rotation[
            0, 2
        ]  # a left camera's x axis points ahead, a right one's back
        along = index.middles[:, 0]
        rows = np.flatnonzero(ahead * along < 0.0)
        centres = index.positions[rows] + 2.0 * along[rows, None] * index.rotations[rows, :, 0]
        return CandidatePlaces(
            index.rotations[rows] @ view.cam_from_virtual.rotation.T, centres, likeness[rows]
        )

    def near(self, other: CandidatePlaces, apart: float) -> Bool[np.ndarray, "n m"]:
        """Return whether two places agree, for each pair.

        They do within `apart` metres and 60 degrees.
        """
        away = np.linalg.norm(self.centres[:, None] - other.centres[None], axis=2)
        return (away < apart) & (
            self.rotations[:, :, 2] @ other.rotations[:, :, 2].T > _MIN_DIRECTION_COSINE
        )

    def rows(self, rows: Int[np.ndarray, " m"]) -> CandidatePlaces:
        """Return the given rows."""
        return CandidatePlaces(self.rotations[rows], self.centres[rows], self.likeness[rows])


def select_likeliest_places(
    candidates: list[CandidatePlaces], num_places: int, apart: float
) -> list[Rigid3]:
    """Return the likeliest places (world_from_cam) of all views, at least `apart` metres apart.

    Each view adds the similarity of its best virtual view at the place.
    """
    chosen: list[Rigid3] = []
    if not candidates:
        return chosen
    first = [
        view.rows(np.argsort(-view.likeness, kind="stable")[:64])  # the most similar ones
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
