"""Align matches by correlation with the images of the nodes.

The image of a node around a point is warped as a plane that faces the node, and moved over the
query image. This is adaptive least-squares correlation (Gruen, 1985) with a shift only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.fitted_weights import LastStepWeights
from topoloc.localization.open_map import NodeTemplate
from topoloc.localization.patch_alignment_kernels import align_patches
from topoloc.localization.pose_fit import PointObservations
from topoloc.localization.search import Search
from topoloc.node_ids import NodeId


@dataclass(frozen=True, eq=False)
class PreciseMatches(PointObservations):
    """Hold matches of all feature types. `sigmas_px` is the standard deviation of each pixel."""

    node_ids: Int[np.ndarray, " n"]
    similarities: Float[np.ndarray, " n"]
    sigmas_px: Float[np.ndarray, " n"]

    def select(self, rows: np.ndarray) -> PreciseMatches:
        """Return the given rows."""
        return PreciseMatches(*(getattr(self, field.name)[rows] for field in fields(self)))


def align(
    search: Search,
    matches: PreciseMatches,
    cam_from_world: Rigid3,
    reach_px: int,
    weights: LastStepWeights,
) -> PreciseMatches:
    """Align matches by correlation with the node's images. Matches that do not correlate are
    dropped."""
    camera = search.query.camera
    node_ids, node_of_match = np.unique(matches.node_ids, return_inverse=True)
    templates = [search.map.template(search.map.topomap.row_of(NodeId(int(k)))) for k in node_ids]
    size = np.array([template.image.shape for template in templates]).reshape(-1, 2)
    images = np.zeros((len(templates), *size.max(axis=0, initial=1)), np.uint8)
    for k, template in enumerate(templates):
        images[k, : size[k, 0], : size[k, 1]] = template.image
    predicted, centres, warps = _compute_warps(
        matches, cam_from_world, camera, templates, node_of_match
    )
    pixels, correlations = align_patches(
        search.query.grey, images, size, node_of_match, predicted, centres, warps, reach_px
    )
    rows = np.flatnonzero(correlations > weights.correlations[0])
    sigmas = np.interp(correlations[rows], weights.correlations, weights.aligned_sigmas_px)
    return replace(
        matches.select(rows), points_img=pixels[rows].astype(np.float32), sigmas_px=sigmas
    )


def _compute_warps(
    matches: PreciseMatches,
    cam_from_world: Rigid3,
    camera: Camera,
    templates: Sequence[NodeTemplate],
    node_of_match: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Return the pixel of each point in the query and in the node's image, and the derivative of
    the second by the first on a plane that faces the node."""
    rotations = np.array([one.world_from_cam.rotation for one in templates])[node_of_match]
    origins = np.array([one.world_from_cam.translation for one in templates])[node_of_match]
    in_query = cam_from_world.apply(matches.points_world)
    in_node = np.einsum("nji,nj->ni", rotations, matches.points_world - origins)
    step = 0.01 * in_node[:, 2:]  # short enough for the derivative of any lens
    axes = np.einsum("ij,njk->kni", cam_from_world.rotation, rotations)[:2]
    predicted = camera.img_from_cam(in_query)
    by_query = [camera.img_from_cam(in_query + step * axis) - predicted for axis in axes]
    centres, by_node = np.empty_like(predicted), np.empty((2, *predicted.shape))
    cameras = [template.camera for template in templates]
    for node_camera in set(cameras):
        rows = np.flatnonzero(np.array([one == node_camera for one in cameras])[node_of_match])
        centres[rows] = node_camera.img_from_cam(in_node[rows])
        for k in range(2):
            moved = in_node[rows] + step[rows] * np.eye(3)[k]
            by_node[k, rows] = node_camera.img_from_cam(moved) - centres[rows]
    (a, c), (b, d) = (one.T for one in by_query)
    with np.errstate(divide="ignore", invalid="ignore"):  # a plane seen from its edge
        inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    return predicted, centres, np.einsum("jni,jkn->nik", by_node, inverse)
