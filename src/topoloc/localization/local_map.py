"""Hold the part of the map that a query is matched with: pooled node points in the world frame."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.mapping.topomap import TopoNode


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Hold map points. Row k: descriptor, world position (metres), covariance (m^2), radius and
    node.

    `radii` (metres) bounds the position error of a point. `sizes` is the diameter (metres) of the
    described patch, and `directions` the unit vector (world) of its orientation. The size and angle
    of its key point in another camera follow from these.
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
        """Return a node's points in the world frame."""
        world_from_cam = node.summary.world_from_cam
        lower = np.zeros((len(node.points_cam), 3, 3))
        lower[:, *np.tril_indices(3)] = node.point_sqrt_covs
        root = world_from_cam.rotation @ lower
        covariances = root @ root.transpose(0, 2, 1)
        # three sigmas over all directions, plus 1 cm for errors outside the covariance
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
        """Return the points of several nodes."""
        return LocalMap(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(LocalMap)
            )
        )
