"""The part of the map that a query is matched with: the points of its candidate nodes, thrown
together, in the world frame."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.mapping.topomap import TopoNode


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Row k: a map point with its descriptor, world position (metres), covariance (m^2), radius of
    doubt (metres), and node.

    `sizes` is the diameter (metres) of what the descriptor describes, `directions` the unit vector
    of its orientation: from these follows how large and how turned a camera elsewhere must see it.
    """

    descriptors: Float32[np.ndarray, "n d"]
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    radii: Float[np.ndarray, " n"]
    node_ids: Int[np.ndarray, " n"]
    sizes: Float[np.ndarray, " n"]
    directions: Float[np.ndarray, "n 3"]

    @staticmethod
    def of_node(node: TopoNode) -> LocalMap:
        """A node's points, moved into the world."""
        world_from_cam = node.summary.world_from_cam
        lower = np.zeros((len(node.points_cam), 3, 3))
        lower[:, *np.tril_indices(3)] = node.point_sqrt_covs
        root = world_from_cam.rotation @ lower
        covariances = root @ root.transpose(0, 2, 1)
        # three standard deviations of the worst direction, and a centimetre for what no covariance
        # knows
        radii = 0.01 + 3.0 * np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        points_world = world_from_cam.apply(node.points_cam.astype(np.float64))
        node_ids = np.full(len(radii), node.summary.node_id)
        f = node.features
        sizes = f.sizes_px.astype(np.float64) / node.camera.fx * node.points_cam[:, 2]
        angles = f.angles.astype(np.float64)
        directions = (
            np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
            @ world_from_cam.rotation.T
        )
        return LocalMap(
            f.descriptors, points_world, covariances, radii, node_ids, sizes, directions
        )

    @staticmethod
    def concatenate(parts: list[LocalMap]) -> LocalMap:
        """The points of several nodes."""
        return LocalMap(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(LocalMap)
            )
        )
