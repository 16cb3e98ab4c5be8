"""Build the training data of a coarse localizer: small mapping images, their nodes, and their
distances to all nodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.stored_images import decode_stored_image
from topoloc_training.network_images import ImageShape, RgbImage

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """The mapping images of a map.

    `jpegs` are their pictures, `world_from_cams` their poses, `node_ids` the node nearest to each
    by Eq. 1 and `node_distances` (metres) D_total of each image to each node; `d_thresh` (metres)
    and `lambda_rot` (metres a radian) are those of Eq. 1.
    """

    jpegs: Sequence[bytes]
    world_from_cams: Sequence[Rigid3]
    node_ids: Int[np.ndarray, " n"]
    node_distances: Float[np.ndarray, "n nodes"]
    d_thresh: float
    lambda_rot: float

    @property
    def num_nodes(self) -> int:
        return self.node_distances.shape[1]

    def image_distances(self) -> Float[np.ndarray, "n n"]:
        """D_total of Eq. 1 (metres) between the images."""
        centres = np.stack([pose.translation for pose in self.world_from_cams])
        rotations = np.stack([pose.rotation for pose in self.world_from_cams]).reshape(
            len(centres), 9
        )
        angles = np.arccos(np.clip((rotations @ rotations.T - 1.0) / 2.0, -1.0, 1.0))
        return np.linalg.norm(centres[:, None] - centres[None], axis=2) + self.lambda_rot * angles


def decode_pictures(training_set: TrainingSet) -> tuple[list[RgbImage], ImageShape]:
    """Return the mapping images in colour, and the most frequent size.

    Raises:
        MapError: an image is damaged.
    """
    pictures = [decode_stored_image(jpeg) for jpeg in training_set.jpegs]
    shapes = np.array([picture.shape[1::-1] for picture in pictures])
    sizes, counts = np.unique(shapes, axis=0, return_counts=True)
    width, height = sizes[int(counts.argmax())]
    return pictures, ImageShape(int(width), int(height))
