"""Compute the 3-D positions of a single image's features from other images with known poses:
structure from known motion.

Each other image gives a depth for every matched feature, if the match lies on the epipolar line.
Depths of a feature that agree are fused, weighted by their certainty. If several other images show
the feature, two must agree: a match may lie on its line by chance. One image suffices if no other
shows the feature, as among few photos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import match_features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import points_from_depth
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.points.metric_points import MetricPoints, select_certain_points


@dataclass(frozen=True, eq=False)
class SourceImage:
    """Hold another image of the place: its features, their standard deviations (pixels), its camera
    and its pose relative to the image."""

    features: Features
    sigmas_px: Float[np.ndarray, " m"]
    camera: Camera
    other_from_cam: Rigid3


def triangulate_from_motion(
    features: Features,
    sigmas_px: Float[np.ndarray, " n"],
    camera: Camera,
    others: Sequence[SourceImage],
    pose_sigma_px: float = 0.5,
    min_images: int = 1,
) -> MetricPoints:
    """Return the 3-D positions (camera frame, metres) of the features of an image taken by
    `camera`. `sigmas_px` are their standard deviations.

    Args:
        pose_sigma_px: standard deviation that pose errors add to that of a key point.
        min_images: minimum number of other images whose depths of a feature agree. With 2, wrong
            poses locate hardly any feature.
    """
    # Maximum distance of a match from its epipolar line, and of two depths from each other, in
    # standard deviations.
    gate = 3.0
    normalized = camera.normalized_from_img(features.points_img.astype(np.float64))
    own_sigma = sigmas_px / camera.fx
    seen = [
        _estimate_inverse_depths(features, normalized, own_sigma, other, gate, pose_sigma_px)
        for other in others
    ]
    inverse, sigma, per_sigma = (
        np.stack([row[k] for row in seen]) if seen else np.zeros((0, len(features)))
        for k in range(3)
    )
    least = np.nan_to_num(per_sigma, nan=np.inf).min(axis=0, initial=np.inf)
    own = own_sigma * np.where(np.isfinite(least), least, 0.0)
    joined, sigma_joined = _fuse_depths(inverse, sigma, own, gate, min_images)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 1.0 / joined
        sigma_z = depth**2 * sigma_joined
        points_cam = points_from_depth(features.points_img.astype(np.float64), depth, camera)
    return select_certain_points(points_cam, sigma_z, camera, sigmas_px)


def _estimate_inverse_depths(
    features: Features,
    normalized: Float[np.ndarray, "n 2"],
    own_sigma: Float[np.ndarray, " n"],
    other: SourceImage,
    gate: float,
    pose_sigma_px: float,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return each feature's inverse depth (1/m) from one other image, and two parts of its
    uncertainty.

    The second value is its standard deviation without the uncertainty of the feature's own position
    (`own_sigma`, plane z = 1). The third is the factor by which that position's uncertainty adds to
    it. All are NaN without a match on the epipolar line.
    """
    inverse, sigma, per_sigma = (np.full(len(features), np.nan) for _ in range(3))
    matches = match_features(
        features.descriptors, other.features.descriptors, MatchingConfig(ratio=0.85)
    )
    rows, columns = matches.query_idx.astype(np.int64), matches.train_idx
    found = other.camera.normalized_from_img(other.features.points_img[columns].astype(np.float64))
    rays = np.column_stack([normalized[rows], np.ones(len(rows))]) @ other.other_from_cam.rotation.T
    t = other.other_from_cam.translation
    # A point at depth 1/w is projected to (rays + w t)[:2] / (rays + w t)[2]. w is the least
    # squares solution of this equation times its denominator.
    along = found * t[2] - t[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        w = np.sum(along * (rays[:, :2] - found * rays[:, 2:]), axis=1) / np.sum(along**2, axis=1)
        depth_ratio = rays[:, 2] + w * t[2]
        projected = (rays[:, :2] + w[:, None] * t[:2]) / depth_ratio[:, None]
        slope = np.linalg.norm(t[:2] - projected * t[2], axis=1) / np.abs(depth_ratio)
        noise = np.hypot(other.sigmas_px[columns], pose_sigma_px) / other.camera.fx
        off_line = np.linalg.norm(projected - found, axis=1)
        good = (w > 0.0) & (depth_ratio > 0.0) & (slope > 0.0)
        good &= off_line < gate * np.hypot(noise, own_sigma[rows])
        inverse[rows[good]] = w[good]
        sigma[rows[good]] = (noise / slope)[good]
        per_sigma[rows[good]] = (1.0 / slope)[good]
    return inverse, sigma, per_sigma


def _fuse_depths(
    inverse: Float[np.ndarray, "k n"],
    sigma: Float[np.ndarray, "k n"],
    own_sigma: Float[np.ndarray, " n"],
    gate: float,
    min_images: int,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return one inverse depth per feature with its standard deviation. It is fused from the
    largest set of agreeing depths, or NaN if no two of several agree.

    The uncertainty of the feature's own position (`own_sigma`) is common to all depths, so fusion
    does not reduce it.
    """
    columns = np.arange(inverse.shape[1])
    if len(inverse) == 0:
        return np.full(len(columns), np.nan), np.full(len(columns), np.nan)
    spread = gate * np.sqrt(sigma[:, None] ** 2 + sigma[None] ** 2 + own_sigma**2)
    with np.errstate(invalid="ignore"):
        # an unknown depth (NaN) agrees with none
        agrees = np.abs(inverse[:, None] - inverse[None]) <= spread
    support = agrees.sum(axis=1)
    best = np.lexsort((np.nan_to_num(sigma, nan=np.inf), -support), axis=0)[0]
    chosen = agrees[best, :, columns].T
    weights = np.where(chosen, 1.0 / np.where(chosen, sigma, 1.0) ** 2, 0.0)
    total, num_found = weights.sum(axis=0), np.isfinite(inverse).sum(axis=0)
    enough = support[best, columns] >= np.clip(num_found, min_images, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        joined = (weights * np.where(chosen, inverse, 0.0)).sum(axis=0) / total
        sigma_joined = np.sqrt(1.0 / total + own_sigma**2)
    return np.where(enough, joined, np.nan), np.where(enough, sigma_joined, np.nan)


def select_source_images(world_from_cams: Sequence[Rigid3], index: int) -> list[int]:
    """Return the images that locate the features of image `index`, in any order of images.

    Near images that look the same way come first. Of images in about one direction and distance
    only the first is taken, so that a dense video gives baselines of several lengths.
    """
    # Maximum number; radians between the viewing directions, beyond which hardly any feature
    # matches; and the least distance of two sources, as a share of the distance to the image.
    max_images, max_turn, min_apart = 12, 0.9, 0.35
    centres = positions_of(world_from_cams)
    axes = np.array([pose.rotation[:, 2] for pose in world_from_cams])
    turns = np.arccos(np.clip(axes @ axes[index], -1.0, 1.0))
    distances = np.linalg.norm(centres - centres[index], axis=1)
    usable = np.flatnonzero((turns < max_turn) & (distances > 1e-6))
    chosen: list[int] = []
    for k in usable[np.argsort((distances * (1.0 + 2.0 * turns))[usable], kind="stable")].tolist():
        apart = np.linalg.norm(centres[chosen] - centres[k], axis=1)
        if np.all(apart > min_apart * distances[k]):
            chosen.append(k)
        if len(chosen) == max_images:
            break
    return chosen
