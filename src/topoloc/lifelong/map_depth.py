"""Locate the features of single images with known poses by the landmarks of a map.

Images of a single camera that are metres apart triangulate few points. But the map knows the
surfaces that they show, in whatever light. A feature lies at the depth of the landmarks that are
projected beside it, and its descriptor is that of the new light.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features
from topoloc.geometry.rig import points_from_depth
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.mapping_frames import MappingFrame, MappingImage, PointLocator
from topoloc.mapping.nodes import find_nearest_nodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import as_rows
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas, select_certain_points
from topoloc.recordings.frame_preparation import PreparedFrame


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
        is_single = view.right_grey is None and view.depth is None
        if is_single and frame.index in self._learnt:
            landmarks = _project_landmarks(self._topomap, image)
            for kind, features in image.features.items():
                own, by_map = located[kind], _locate_beside(landmarks, features, image)
                located[kind] = MetricPoints(
                    np.where(own.valid[:, None], own.points_cam, by_map.points_cam),
                    np.where(own.valid[:, None, None], own.covariances, by_map.covariances),
                    own.valid | by_map.valid,
                )
        return located, others


def _project_landmarks(topomap: TopoMetricMap, image: MappingImage) -> Float[np.ndarray, "m 4"]:
    """Return the pixel, the inverse depth (1/m) and its standard deviation of each landmark of the
    nearest nodes that an image shows."""
    num_nodes, min_depth, pose, config = 4, 0.1, image.world_from_cam, topomap.config
    nearest = as_rows(find_nearest_nodes(pose, topomap.node_poses, config.lambda_rot, num_nodes))
    shown = list[np.ndarray]()
    for node in (layer.nodes[row] for layer in topomap.layers.values() for row in nearest):
        known, axis = LocalMap.of_node(node), pose.rotation[:, 2]
        points = pose.inverse().apply(known.points_world)
        pixels, sigmas = image.camera.img_from_cam(points), np.sqrt(known.covariances @ axis @ axis)
        rows = (points[:, 2] > min_depth) & image.camera.is_in_image(pixels)
        z = points[rows, 2:]
        shown.append(np.hstack([pixels[rows], 1.0 / z, sigmas[rows, None] / z**2]))
    return np.concatenate(shown)


def _locate_beside(
    landmarks: Float[np.ndarray, "m 4"], features: Features, image: MappingImage
) -> MetricPoints:
    """Return the positions of an image's features (camera frame, metres) by its `landmarks`. They
    are invalid where landmarks are few or lie on several surfaces."""
    num_beside, radius_px, floor = 10, 25.0, 0.01  # floor: relative sigma of a depth, at least
    points_img, inverse = features.points_img.astype(np.float64), np.full(len(features), np.nan)
    spread = inverse
    if len(landmarks) > num_beside and len(features):
        offsets = landmarks[None, :, :2] - points_img[:, None]
        nearest = np.argpartition((offsets**2).sum(axis=2), num_beside, axis=1)[:, :num_beside]
        offsets = np.take_along_axis(offsets, nearest[:, :, None], axis=1)
        radii = offsets / (radius_px * image.camera.radius_scale)
        inverse, spread = _fit_surfaces(radii, landmarks[nearest, 2], landmarks[nearest, 3])
    points_cam = points_from_depth(points_img, 1.0 / inverse, image.camera)
    sigma_z = np.hypot(spread, floor * inverse) / inverse**2
    return select_certain_points(points_cam, sigma_z, image.camera, keypoint_sigmas(features))


def _fit_surfaces(
    offsets: Float[np.ndarray, "n k 2"],
    inverse_depths: Float[np.ndarray, "n k"],
    sigmas: Float[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Fit a plane to the landmarks beside each feature. Return its inverse depth (1/m) at the
    feature, NaN without a surface, and the spread of the landmarks around it.

    `offsets` are pixels from the feature, in radii: landmarks outside of the circle do not count.
    The inverse depth of a plane is linear in the pixels.
    """
    # The largest spread of one surface, a landmark's sigma beyond its own, and the usual change of
    # the inverse depth within the radius: relative to the inverse depth.
    max_spread, own_sigma, slope = 0.06, 0.02, 0.2
    gate, min_beside, min_share = 3.0, 4, 0.7  # sigmas; landmarks on the surface, and their share
    squares = (offsets**2).sum(axis=2)
    is_near = agrees = squares < 1.0
    num_near = is_near.sum(axis=1)
    mean = (is_near * inverse_depths).sum(axis=1) / np.maximum(num_near, 1) + 1e-9
    sigmas = np.hypot(sigmas, own_sigma * mean[:, None])
    design = np.concatenate([np.ones_like(squares)[..., None], offsets], axis=2)
    prior = np.diag([1e-9, slope**-2, slope**-2]) / mean[:, None, None] ** 2
    fit, residuals = np.zeros((len(mean), 3, 1)), inverse_depths
    for _ in range(3):
        weights = agrees * np.exp(-2.0 * squares) / sigmas**2
        weighted = design.transpose(0, 2, 1) * weights[:, None]
        fit = np.linalg.solve(weighted @ design + prior, weighted @ inverse_depths[..., None])
        residuals = inverse_depths - (design @ fit)[..., 0]
        agrees = is_near & (np.abs(residuals) < gate * sigmas)
    num, inverse = agrees.sum(axis=1), fit[:, 0, 0]
    spread = np.sqrt((agrees * residuals**2).sum(axis=1) / np.maximum(num - 1, 1))
    is_surface = (num >= min_beside) & (num > min_share * num_near) & (inverse > 0.0)
    return np.where(is_surface & (spread < max_spread * inverse), inverse, np.nan), spread
