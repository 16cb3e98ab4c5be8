"""Locate the features of single images with known poses by the landmarks of a map.

Images of a single camera that are metres apart triangulate few points. But the map knows the
surfaces that they show, whatever the light. A feature lies at the depth of the landmarks that are
projected beside it. Its descriptor is that of the new light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import points_from_depth
from topoloc.mapping.mapping_frames import MappingFrame, MappingImage, PointLocator
from topoloc.mapping.nodes import find_nearest_nodes
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import as_rows
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas, select_certain_points
from topoloc.recordings.frame_preparation import PreparedFrame


class MapPointLocator(PointLocator):
    """Locate the features of mapping frames in 3-D. What a single camera cannot triangulate is
    located by the landmarks of `topomap`."""

    def __init__(self, frames: Sequence[MappingFrame], topomap: TopoMetricMap) -> None:
        super().__init__(frames, topomap.config)
        self._topomap = topomap

    def locate(
        self, frame: MappingFrame, view: PreparedFrame, image: MappingImage
    ) -> tuple[dict[str, MetricPoints], list[MappingFrame]]:
        """Return as `PointLocator.locate`."""
        located, others = super().locate(frame, view, image)
        if view.right_grey is not None or view.depth is not None:
            return located, others
        landmarks = _project_landmarks(self._topomap, image)
        for kind, features in image.features.items():
            by_map = _locate_beside(features, image.camera, *landmarks)
            own = located[kind].valid
            located[kind] = MetricPoints(
                *(
                    np.where(
                        own.reshape(-1, *[1] * (getattr(by_map, one.name).ndim - 1)),
                        getattr(located[kind], one.name),
                        getattr(by_map, one.name),
                    )
                    for one in fields(MetricPoints)
                )
            )
        return located, others


def _project_landmarks(
    topomap: TopoMetricMap, image: MappingImage
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Return the pixels, inverse depths (1/m) and their standard deviations of the landmarks of the
    nearest nodes in an image."""
    num_nodes = 4
    world_from_cam, config = image.world_from_cam, topomap.config
    nearest = find_nearest_nodes(world_from_cam, topomap.node_poses, config.lambda_rot, num_nodes)
    pixels, inverse, sigmas = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for layer in topomap.layers.values():
        for row in as_rows(nearest):
            node = layer.nodes[row]
            cam_from_node = world_from_cam.inverse() @ node.summary.world_from_cam
            points = cam_from_node.apply(node.points_cam.astype(np.float64))
            roots = np.zeros((len(points), 3, 3))
            roots[:, *np.tril_indices(3)] = node.point_sqrt_covs
            sigma_z = np.linalg.norm(cam_from_node.rotation[2] @ roots, axis=1)
            shown = image.camera.img_from_cam(points)
            rows = (points[:, 2] > 0.1) & image.camera.is_in_image(shown)
            pixels.append(shown[rows])
            inverse.append(1.0 / points[rows, 2])
            sigmas.append(sigma_z[rows] / points[rows, 2] ** 2)
    return np.concatenate(pixels), np.concatenate(inverse), np.concatenate(sigmas)


def _locate_beside(
    features: Features,
    camera: Camera,
    pixels: Float[np.ndarray, "m 2"],
    inverse: Float[np.ndarray, " m"],
    sigmas: Float[np.ndarray, " m"],
) -> MetricPoints:
    """Return the positions of features (camera frame, metres) by the inverse depths of the
    landmarks at `pixels`. A plane has an inverse depth that is linear in the pixels."""
    num_beside, radius_px, min_beside = 10, 25.0, 4
    max_spread = 0.06  # relative; beyond it landmarks lie on several surfaces
    points_img = features.points_img.astype(np.float64)
    offsets = pixels[None] - points_img[:, None]
    squares = (offsets**2).sum(axis=2) / (radius_px * camera.radius_scale) ** 2
    beside = np.argsort(squares, axis=1)[:, :num_beside]
    rows = np.arange(len(features))[:, None]
    near, square = offsets[rows, beside], squares[rows, beside]
    value, sigma = inverse[beside], sigmas[beside]
    known = square < 1.0
    middle = np.nanmedian(np.where(known, value, np.nan), axis=1) if value.size else np.zeros(0)
    weights = known * np.exp(-2.0 * square) / (sigma**2 + (0.01 * middle[:, None]) ** 2)
    scaled = near / (radius_px * camera.radius_scale)
    design = np.concatenate([np.ones_like(scaled[..., :1]), scaled], axis=2)
    fit = np.zeros((len(features), 3))
    for _ in range(3):
        weighted = design * weights[..., None]
        # a slope of a fifth of the depth within the radius is as usual as none
        prior = np.zeros((len(features), 3, 3))
        prior[:, [1, 2], [1, 2]] = 1.0 / (0.2 * middle[:, None]) ** 2
        fit = np.linalg.solve(
            weighted.transpose(0, 2, 1) @ design + prior + 1e-12 * np.eye(3),
            (weighted.transpose(0, 2, 1) @ value[..., None]),
        )[..., 0]
        off = value - (design @ fit[..., None])[..., 0]
        agrees = known & (np.abs(off) < 3.0 * np.hypot(sigma, 0.02 * middle[:, None]))
        weights = np.where(agrees, weights, 0.0)
    num = agrees.sum(axis=1)
    spread = np.sqrt((agrees * off**2).sum(axis=1) / np.maximum(num - 1, 1))
    enough = (num >= min_beside) & (num > 0.7 * known.sum(axis=1)) & (fit[:, 0] > 0)
    enough &= spread < max_spread * middle
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(enough, 1.0 / fit[:, 0], np.nan)
        sigma_z = depth**2 * np.hypot(spread, 0.01 * middle)
    return select_certain_points(
        points_from_depth(points_img, depth, camera), sigma_z, camera, keypoint_sigmas(features)
    )
