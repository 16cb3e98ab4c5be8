"""Georeference a map's world: from the pose of its first image, the trajectory's places, or control
points.

The fit is rigid, because a map is metric already. It is robust, because GNSS can be off by many
metres beside a wall. It uses an approximate up direction, because GNSS heights are poor and a
straight trajectory leaves the roll undetermined. If the points do not determine the transform, an
error is raised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from topoloc import GeoPoint, Georeference, GeoreferenceError, Rigid3
from topoloc.apps.core_names import find_least_median, nearest_rotation

UP_ENU = np.array([0.0, 0.0, 1.0])
AXES = {
    f"{sign}{name}": (1.0 if sign == "" else -1.0) * np.eye(3)[k]
    for k, name in enumerate("xyz")
    for sign in ("", "-")
}
_LEVEL_SIGMA, _CAMERA_SIGMA = math.radians(2.0), math.radians(10.0)
"""Sigmas of the up direction: of levelled worlds with z up, and of worlds of a hand-held camera."""
_MIN_HORIZONTAL_NORM = math.sin(math.radians(10.0))
_MAX_HEIGHT = 100_000.0  # metres above or below the ellipsoid; larger heights are mistakes
_MIN_SIGMA = 0.01  # metres; the best realistic accuracy
_MAX_ROTATION_SIGMA = math.radians(5.0)
_MAX_RESIDUAL_SHARE = 0.25
_MAX_SCALE = 1.05
_NUM_SAMPLES, _NUM_STEPS = 300, 10
_MEDIAN_NORM = 1.538  # of a 3-D Gaussian, in standard deviations of one axis
_GATE = 4.0


@dataclass(frozen=True, eq=False)
class UpDirection:
    """Hold the up direction of the world and its standard deviation in radians."""

    axis: str
    sigma: float

    @property
    def world(self) -> Float[np.ndarray, "3"]:
        """Return the unit vector of the direction in the world."""
        return AXES[self.axis]


@dataclass(frozen=True, eq=False)
class GeoreferenceFit:
    """Hold a georeference and the residual of each point (metres). Points with `is_inlier` False
    are outliers."""

    georeference: Georeference
    residuals_m: Float[np.ndarray, " n"]
    is_inlier: Bool[np.ndarray, " n"]


def estimate_up_direction(
    world_from_cams: Sequence[Rigid3], axis: str | None = None
) -> UpDirection:
    """Return the named axis, or the axis of the world nearest to the mean up direction of the
    mapping cameras.

    Raises:
        GeoreferenceError: there is no such axis.
    """
    if axis is None:
        mean = -np.mean([pose.rotation[:, 1] for pose in world_from_cams], axis=0)
        axis = max(AXES, key=lambda name: float(AXES[name] @ mean))
    if axis not in AXES:
        raise GeoreferenceError(f"up is one of {', '.join(AXES)}, not {axis!r}")
    return UpDirection(axis, _LEVEL_SIGMA if axis == "z" else _CAMERA_SIGMA)


def georeference_from_heading(
    world_from_cam: Rigid3, origin: GeoPoint, heading_deg: float, up: UpDirection
) -> Georeference:
    """Return the georeference from the place (`origin`) and heading of one image. The heading is
    that of its optical axis, in degrees clockwise from true north. `up` is the up direction of the
    world.

    Raises GeoreferenceError if the image looks up or down, so it has no heading, or the height is
    implausible.
    """
    _check_heights([origin])
    view = world_from_cam.rotation[:, 2]
    level = view - (view @ up.world) * up.world
    if np.linalg.norm(level) < _MIN_HORIZONTAL_NORM:
        raise GeoreferenceError(
            f"the first picture looks up or down (up is {up.axis}), so it has no heading; known"
            " points do: --points"
        )
    north = level / np.linalg.norm(level)  # rows: east, north, up if the image looked north
    axes = np.array([np.cross(north, up.world), north, up.world])
    turn = np.concatenate([np.zeros(3), -math.radians(heading_deg) * UP_ENU])
    rotation = Rigid3.exp(turn).rotation @ axes
    return Georeference(origin, Rigid3(rotation, -rotation @ world_from_cam.translation), "origin")


def fit_georeference(
    points_world: Float[np.ndarray, "n 3"],
    places: Sequence[GeoPoint],
    source: str,
    up: UpDirection | None = None,
) -> GeoreferenceFit:
    """Fit the rigid transform from points of the world (metres) to their places on earth. The
    origin is the first place. Least median of squares over triples is followed by least squares
    with Cauchy weights. Up to four points are all used as inliers. `up` is an additional
    measurement of the rotation.

    Raises GeoreferenceError if there are fewer than three points, or they leave the rotation
    undetermined, contradict each other, or have another scale.
    """
    if len(points_world) < 3:
        raise GeoreferenceError(
            f"{len(points_world)} points are known in the map; at least 3 are needed"
        )
    _check_heights(places)
    origin = places[0]
    enu_from_ecef = origin.ecef_from_enu().inverse()
    points_enu = np.array([enu_from_ecef.apply(place.ecef()) for place in places])
    if np.linalg.norm(points_enu, axis=1).max() > 1e6:
        raise GeoreferenceError(
            "the places are more than 1000 km apart: latitude first, then longitude, degrees"
        )
    pairs = _PointPairs(points_world, points_enu, up)
    weights = np.ones(len(points_world)) if len(points_world) <= 4 else _robust_weights(pairs)
    is_inlier, sigma = weights > 0.0, _estimate_sigma(pairs, pairs.align(weights), weights)
    enu_from_world = pairs.align(weights, sigma)
    residuals = pairs.residuals(enu_from_world)
    _check_fit(pairs, enu_from_world, weights, sigma)
    rms = float(np.sqrt(np.mean(residuals[is_inlier] ** 2)))
    return GeoreferenceFit(Georeference(origin, enu_from_world, source, rms), residuals, is_inlier)


@dataclass(frozen=True, eq=False)
class _PointPairs:
    """Hold points in the world and in east-north-up (metres), and the up direction if known."""

    world: Float[np.ndarray, "n 3"]
    enu: Float[np.ndarray, "n 3"]
    up: UpDirection | None

    def align(self, weights: Float[np.ndarray, " n"], sigma: float = 1.0) -> Rigid3:
        """Return enu_from_world by weighted least squares. `sigma` (metres) sets the weight of the
        points relative to the up direction."""
        share = weights / weights.sum()
        centre_world, centre_enu = share @ self.world, share @ self.enu
        correlation = ((self.enu - centre_enu) * weights[:, None] / sigma**2).T @ (
            self.world - centre_world
        )
        if self.up is not None:
            correlation = correlation + np.outer(UP_ENU, self.up.world) / self.up.sigma**2
        rotation = nearest_rotation(correlation)
        return Rigid3(rotation, centre_enu - rotation @ centre_world)

    def residuals(self, enu_from_world: Rigid3) -> Float[np.ndarray, " n"]:
        """Return the distance of each pair after the transform, in metres."""
        return np.linalg.norm(enu_from_world.apply(self.world) - self.enu, axis=1)


def _robust_weights(pairs: _PointPairs) -> Float[np.ndarray, " n"]:
    """Return Cauchy weights, 0 for points further off than `_GATE` standard deviations."""
    rng, num_points = np.random.default_rng(0), len(pairs.world)
    samples = (rng.choice(num_points, 3, replace=False) for _ in range(_NUM_SAMPLES))
    weights = np.ones(num_points)
    enu_from_world, min_median = find_least_median(
        (pairs.align(np.isin(np.arange(num_points), sample) * weights) for sample in samples),
        pairs.residuals,
    )
    sigma = max(min_median / _MEDIAN_NORM, _MIN_SIGMA)
    for _ in range(_NUM_STEPS):
        scaled = pairs.residuals(enu_from_world) / (math.sqrt(3.0) * sigma)
        weights = np.where(scaled < _GATE, 1.0 / (1.0 + (scaled / 2.385) ** 2), 0.0)
        enu_from_world = pairs.align(weights, sigma)
        sigma = _estimate_sigma(pairs, enu_from_world, weights)
    return weights


def _estimate_sigma(
    pairs: _PointPairs, enu_from_world: Rigid3, weights: Float[np.ndarray, " n"]
) -> float:
    """Estimate the standard deviation of one coordinate of the inliers, in metres. Six fitted
    parameters reduce the degrees of freedom."""
    is_inlier = weights > 0.0
    squares = float(np.sum(pairs.residuals(enu_from_world)[is_inlier] ** 2))
    return max(math.sqrt(squares / max(3 * int(is_inlier.sum()) - 6, 1)), _MIN_SIGMA)


def _check_heights(places: Sequence[GeoPoint]) -> None:
    for place in places:
        if abs(place.h) > _MAX_HEIGHT:
            raise GeoreferenceError(f"a height of {place.h:g} m above the ellipsoid")


def _check_fit(
    pairs: _PointPairs, enu_from_world: Rigid3, weights: Float[np.ndarray, " n"], sigma: float
) -> None:
    """Check that the points determine the transform. Raises GeoreferenceError."""
    is_inlier = weights > 0.0
    offsets = pairs.world[is_inlier] - pairs.world[is_inlier].mean(axis=0)
    extent = float(np.linalg.norm(offsets, axis=1).max())
    left = f"residuals of {math.sqrt(3.0) * sigma:.2f} m"
    if 2 * int(is_inlier.sum()) < len(is_inlier):
        raise GeoreferenceError(
            f"only {int(is_inlier.sum())} of {len(is_inlier)} points agree with each other: these"
            " are not the map's places"
        )
    enu = pairs.enu[is_inlier]
    _check_scale(offsets, (enu - enu.mean(axis=0)) @ enu_from_world.rotation)
    information = (np.sum(offsets**2) * np.eye(3) - offsets.T @ offsets) / sigma**2
    if pairs.up is not None:
        across = np.eye(3) - np.outer(pairs.up.world, pairs.up.world)
        information = information + across / pairs.up.sigma**2
    rotation_sigma = 1.0 / math.sqrt(max(float(np.linalg.eigvalsh(information)[0]), 1e-12))
    if rotation_sigma > _MAX_ROTATION_SIGMA:
        raise GeoreferenceError(
            "the points leave the rotation open by"
            f" {math.degrees(min(rotation_sigma, math.pi)):.0f} degrees: on one line, or too close"
            f" together ({extent:.2f} m) for {left}"
        )
    if math.sqrt(3.0) * sigma > _MAX_RESIDUAL_SHARE * extent:
        raise GeoreferenceError(
            f"{left} over an extent of {extent:.2f} m: these are not the map's places"
        )


def _check_scale(offsets: Float[np.ndarray, "n 3"], true_offsets: Float[np.ndarray, "n 3"]) -> None:
    """Check that another scale does not explain the residuals. Raises GeoreferenceError."""
    scale = float(np.sum(true_offsets * offsets)) / max(float(np.sum(offsets**2)), 1e-12)
    is_better = np.sum((true_offsets - scale * offsets) ** 2) < 0.1 * np.sum(
        (true_offsets - offsets) ** 2
    )
    if is_better and scale > 0.0 and not 1.0 / _MAX_SCALE < scale < _MAX_SCALE:
        raise GeoreferenceError(
            f"the places are {scale:.3g} times as far apart as in the map: not the same metres"
        )
