"""Locate the features of single images with known poses by the landmarks of a map.

Images of a single camera that are metres apart triangulate few points. But the map knows the
surfaces that they show, in whatever light. A feature lies at the depth of the landmarks that are
projected beside it, and its descriptor is that of the new light.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features
from topoloc.geometry.rig import points_from_depth
from topoloc.mapping.mapping_frames import MappingFrame, MappingImage, PointLocator
from topoloc.mapping.nodes import find_nearest_nodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import as_rows
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas, select_certain_points
from topoloc.recordings.frame_preparation import PreparedFrame

_MIN_BESIDE = 4  # landmarks that give a feature its depth


class MapPointLocator(PointLocator):
    """Locate the features of mapping frames in 3-D. What a single camera cannot triangulate in the
    images `learnt` (by index) is located by the landmarks of `topomap`."""

    def __init__(
        self, frames: Sequence[MappingFrame], topomap: TopoMetricMap, learnt: Collection[int]
    ) -> None:
        super().__init__(frames, topomap.config)
        self._topomap, self._learnt = topomap, learnt

    def locate(
        self, frame: MappingFrame, view: PreparedFrame, image: MappingImage
    ) -> tuple[dict[str, MetricPoints], list[MappingFrame]]:
        """Return as `PointLocator.locate`."""
        located, others = super().locate(frame, view, image)
        has_depth = view.right_grey is not None or view.depth is not None
        if has_depth or frame.index not in self._learnt:
            return located, others
        landmarks = _project_landmarks(self._topomap, image)
        for kind, features in image.features.items():
            own, by_map = located[kind], landmarks.locate_beside(features, image)
            located[kind] = MetricPoints(
                np.where(own.valid[:, None], own.points_cam, by_map.points_cam),
                np.where(own.valid[:, None, None], own.covariances, by_map.covariances),
                own.valid | by_map.valid,
            )
        return located, others


@dataclass(frozen=True, eq=False)
class _ProjectedLandmarks:
    """Hold the pixels of landmarks in an image, their inverse depths (1/m), and the standard
    deviations of these."""

    pixels: Float[np.ndarray, "m 2"]
    inverse_depths: Float[np.ndarray, " m"]
    sigmas: Float[np.ndarray, " m"]

    def locate_beside(self, features: Features, image: MappingImage) -> MetricPoints:
        """Return the positions of the image's features (camera frame, metres). They are invalid
        where the landmarks beside a feature are few or lie on several surfaces."""
        num_beside, radius_px, floor = 10, 25.0, 0.01  # floor: relative sigma of a depth, at least
        camera, points_img = image.camera, features.points_img.astype(np.float64)
        inverse = spread = np.full(len(features), np.nan)
        if len(self.pixels) > num_beside:
            offsets = self.pixels[None] - points_img[:, None]
            squares = (offsets**2).sum(axis=2)
            beside = np.argpartition(squares, num_beside, axis=1)[:, :num_beside]
            near = np.take_along_axis(offsets, beside[:, :, None], axis=1)
            inverse, spread = _fit_surfaces(
                near / (radius_px * camera.radius_scale),
                self.inverse_depths[beside],
                self.sigmas[beside],
            )
        depth = 1.0 / inverse
        sigma_z = depth**2 * np.hypot(spread, floor * inverse)
        points_cam = points_from_depth(points_img, depth, camera)
        return select_certain_points(points_cam, sigma_z, camera, keypoint_sigmas(features))


def _project_landmarks(topomap: TopoMetricMap, image: MappingImage) -> _ProjectedLandmarks:
    """Return the landmarks of the nodes nearest to an image, as it shows them."""
    num_nodes, min_depth = 4, 0.1
    world_from_cam, config = image.world_from_cam, topomap.config
    nearest = find_nearest_nodes(world_from_cam, topomap.node_poses, config.lambda_rot, num_nodes)
    parts = list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
    for node in (layer.nodes[row] for layer in topomap.layers.values() for row in as_rows(nearest)):
        cam_from_node = world_from_cam.inverse() @ node.summary.world_from_cam
        points = cam_from_node.apply(node.points_cam.astype(np.float64))
        roots = np.zeros((len(points), 3, 3))
        roots[:, *np.tril_indices(3)] = node.point_sqrt_covs
        sigma_z = np.linalg.norm(cam_from_node.rotation[2] @ roots, axis=1)
        pixels = image.camera.img_from_cam(points)
        rows = (points[:, 2] > min_depth) & image.camera.is_in_image(pixels)
        z = points[rows, 2]
        parts.append((pixels[rows], 1.0 / z, sigma_z[rows] / z**2))
    return _ProjectedLandmarks(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _fit_surfaces(
    offsets: Float[np.ndarray, "n k 2"],
    inverse_depths: Float[np.ndarray, "n k"],
    sigmas: Float[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Fit a plane to the landmarks beside each feature. Return its inverse depth (1/m) at the
    feature and the spread of the landmarks around it, NaN without a surface.

    `offsets` are pixels from the feature, in radii: landmarks outside of the circle do not count.
    The inverse depth of a plane is linear in the pixels.
    """
    # The largest spread of one surface, a landmark's sigma beyond its own, and the usual change of
    # the inverse depth within the radius: relative to the inverse depth.
    max_spread, own_sigma, slope, gate = 0.06, 0.02, 0.2, 3.0
    squares = (offsets**2).sum(axis=2)
    is_near = squares < 1.0
    num_near = is_near.sum(axis=1)
    mean = (is_near * inverse_depths).sum(axis=1) / np.maximum(num_near, 1) + 1e-9
    sigmas = np.hypot(sigmas, own_sigma * mean[:, None])
    design = np.concatenate([np.ones_like(squares)[..., None], offsets], axis=2)
    prior = np.zeros((len(mean), 3, 3))
    prior[:, 0, 0] = 1e-9 / mean**2
    prior[:, [1, 2], [1, 2]] = 1.0 / (slope * mean[:, None]) ** 2
    agrees, fit, residuals = is_near, np.zeros((len(mean), 3, 1)), inverse_depths
    for _ in range(3):
        weighted = (
            design.transpose(0, 2, 1) * (agrees * np.exp(-2.0 * squares) / sigmas**2)[:, None]
        )
        fit = np.linalg.solve(weighted @ design + prior, weighted @ inverse_depths[..., None])
        residuals = inverse_depths - (design @ fit)[..., 0]
        agrees = is_near & (np.abs(residuals) < gate * sigmas)
    num, inverse = agrees.sum(axis=1), fit[:, 0, 0]
    spread = np.sqrt((agrees * residuals**2).sum(axis=1) / np.maximum(num - 1, 1))
    is_surface = (num >= _MIN_BESIDE) & (num > 0.7 * num_near) & (inverse > 0.0)
    is_surface &= spread < max_spread * inverse
    return np.where(is_surface, inverse, np.nan), spread
