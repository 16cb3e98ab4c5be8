"""Where on earth a map's world lies: told of its first picture, or fitted to places of its
trajectory, or to known points.

The fit is rigid: a map is metric already. It is robust, for GNSS is off by many metres beside a
wall, and it knows about where up is, for heights of GNSS are poor and a straight walk alone would
leave a roll open. What the points do not determine is an error, never a guess.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from topoloc.errors import GeoreferenceError
from topoloc.geometry.alignment import nearest_rotation
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3

UP_ENU = np.array([0.0, 0.0, 1.0])
AXES = {
    f"{sign}{name}": (1.0 if sign == "" else -1.0) * np.eye(3)[k]
    for k, name in enumerate("xyz")
    for sign in ("", "-")
}
_LEVEL_SIGMA, _CAMERA_SIGMA = math.radians(2.0), math.radians(10.0)
"""How far up is from where it should be: of worlds with z up, which somebody levelled, and of those
of a camera held by hand."""
_MIN_HORIZONTAL_NORM = math.sin(math.radians(10.0))
_MAX_HEIGHT = (
    100_000.0  # metres above the ellipsoid, or below it; a map of what lies there is a mistake
)
_MIN_SIGMA = 0.01  # metres; nobody measures better
_MAX_ROTATION_SIGMA = math.radians(5.0)
_MAX_RESIDUAL_SHARE = 0.25
_MAX_SCALE = 1.05
_NUM_SAMPLES, _NUM_STEPS = 300, 10
_MEDIAN_NORM = 1.538  # of a 3-D Gaussian, in standard deviations of one axis
_GATE = 4.0


@dataclass(frozen=True, eq=False)
class UpDirection:
    """The direction of the world that is up, and how far (radians, standard deviation) that may be
    from the truth."""

    axis: str
    sigma: float

    @property
    def world(self) -> Float[np.ndarray, "3"]:
        return AXES[self.axis]


@dataclass(frozen=True, eq=False)
class GeoreferenceFit:
    """`residuals_m[k]` is what the fit leaves of point k; those that are not `is_inlier` are off by
    more than the others allow for."""

    georeference: Georeference
    residuals_m: Float[np.ndarray, " n"]
    is_inlier: Bool[np.ndarray, " n"]


def estimate_up_direction(
    world_from_cams: Sequence[Rigid3], axis: str | None = None
) -> UpDirection:
    """The axis of the world that is nearest to the mapping cameras' mean up, or the one that is
    named.

    Raises:
        GeoreferenceError: no such axis.
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
    """The picture `world_from_cam` was taken at `origin`, looking to `heading_deg` (degrees
    clockwise from true north).

    Raises:
        GeoreferenceError: it looks up or down, so that no heading says how the world is turned; or
            nobody was at this height.
    """
    _check_heights([origin])
    view = world_from_cam.rotation[:, 2]
    level = view - (view @ up.world) * up.world
    if np.linalg.norm(level) < _MIN_HORIZONTAL_NORM:
        raise GeoreferenceError(
            f"the first picture looks up or down (up is {up.axis}), so it has no heading; known"
            " points do: --points"
        )
    north = level / np.linalg.norm(level)  # of a world that is turned until the picture looks north
    axes = np.array([np.cross(north, up.world), north, up.world])
    heading = math.radians(heading_deg)
    turn = np.array(
        [
            [math.cos(heading), math.sin(heading), 0.0],
            [-math.sin(heading), math.cos(heading), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    rotation = turn @ axes
    return Georeference(origin, Rigid3(rotation, -rotation @ world_from_cam.translation), "origin")


def fit_georeference(
    points_world: Float[np.ndarray, "n 3"],
    places: Sequence[GeoPoint],
    source: str,
    up: UpDirection | None = None,
) -> GeoreferenceFit:
    """The rigid transform that brings points of the world (metres) to their places on earth; its
    origin is the first place.

    Least median of squares over triples, then least squares with Cauchy's weights; four points and
    fewer are all believed. `up` is one more measurement of the rotation.

    Raises:
        GeoreferenceError: fewer than three points, or they leave the rotation open, contradict each
            other, or are of another scale.
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
    is_inlier = weights > 0.0
    sigma = _estimate_sigma(pairs, pairs.align(weights), weights)
    enu_from_world = pairs.align(weights, sigma)
    residuals = pairs.residuals(enu_from_world)
    _check_fit(pairs, enu_from_world, weights, sigma)
    rms = float(np.sqrt(np.mean(residuals[is_inlier] ** 2)))
    return GeoreferenceFit(Georeference(origin, enu_from_world, source, rms), residuals, is_inlier)


@dataclass(frozen=True, eq=False)
class _PointPairs:
    """Points in the world and east-north-up (metres), and what is known of up."""

    world: Float[np.ndarray, "n 3"]
    enu: Float[np.ndarray, "n 3"]
    up: UpDirection | None

    def align(self, weights: Float[np.ndarray, " n"], sigma: float = 1.0) -> Rigid3:
        """enu_from_world by weighted least squares; `sigma` (metres) says how much the points count
        beside up."""
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
        return np.linalg.norm(enu_from_world.apply(self.world) - self.enu, axis=1)


def _robust_weights(pairs: _PointPairs) -> Float[np.ndarray, " n"]:
    """Cauchy's weights, 0 for points off by more than `_GATE` standard deviations."""
    rng, num_points = np.random.default_rng(0), len(pairs.world)
    best, min_median = Rigid3.identity(), math.inf
    for _ in range(_NUM_SAMPLES):
        weights = np.zeros(num_points)
        weights[rng.choice(num_points, 3, replace=False)] = 1.0
        sample = pairs.align(weights)
        median = float(np.median(pairs.residuals(sample)))
        best, min_median = (sample, median) if median < min_median else (best, min_median)
    weights, enu_from_world, sigma = (
        np.ones(num_points),
        best,
        max(min_median / _MEDIAN_NORM, _MIN_SIGMA),
    )
    for _ in range(_NUM_STEPS):
        scaled = pairs.residuals(enu_from_world) / (math.sqrt(3.0) * sigma)
        weights = np.where(scaled < _GATE, 1.0 / (1.0 + (scaled / 2.385) ** 2), 0.0)
        enu_from_world = pairs.align(weights, sigma)
        sigma = _estimate_sigma(pairs, enu_from_world, weights)
    return weights


def _estimate_sigma(
    pairs: _PointPairs, enu_from_world: Rigid3, weights: Float[np.ndarray, " n"]
) -> float:
    """Standard deviation of one coordinate of the points that are used, metres; of six numbers that
    were fitted nothing is learned."""
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
    """Hold that the points say where the map lies. Raises GeoreferenceError."""
    is_inlier = weights > 0.0
    offsets = pairs.world[is_inlier] - pairs.world[is_inlier].mean(axis=0)
    extent, left = (
        float(np.linalg.norm(offsets, axis=1).max()),
        f"residuals of {math.sqrt(3.0) * sigma:.2f} m",
    )
    if 2 * int(is_inlier.sum()) < len(is_inlier):
        raise GeoreferenceError(
            f"only {int(is_inlier.sum())} of {len(is_inlier)} points agree with each other: these"
            " are not the map's places"
        )
    _check_scale(
        offsets,
        (pairs.enu[is_inlier] - pairs.enu[is_inlier].mean(axis=0)) @ enu_from_world.rotation,
    )
    information = np.sum(offsets**2) * np.eye(3) - offsets.T @ offsets
    information = information / sigma**2
    if pairs.up is not None:
        information = (
            information + (np.eye(3) - np.outer(pairs.up.world, pairs.up.world)) / pairs.up.sigma**2
        )
    rotation_sigma = 1.0 / math.sqrt(max(float(np.linalg.eigvalsh(information)[0]), 1e-12))
    if rotation_sigma > _MAX_ROTATION_SIGMA:
        about = f"{math.degrees(min(rotation_sigma, math.pi)):.0f} degrees"
        raise GeoreferenceError(
            f"the points leave the rotation open by {about}: on one line, or too close together"
            f" ({extent:.2f} m) for {left}"
        )
    if math.sqrt(3.0) * sigma > _MAX_RESIDUAL_SHARE * extent:
        raise GeoreferenceError(
            f"{left} over an extent of {extent:.2f} m: these are not the map's places"
        )


def _check_scale(offsets: Float[np.ndarray, "n 3"], true_offsets: Float[np.ndarray, "n 3"]) -> None:
    """Hold that no other length of the metre explains the residuals."""
    scale = float(np.sum(true_offsets * offsets)) / max(float(np.sum(offsets**2)), 1e-12)
    is_better = np.sum((true_offsets - scale * offsets) ** 2) < 0.1 * np.sum(
        (true_offsets - offsets) ** 2
    )
    if is_better and scale > 0.0 and not 1.0 / _MAX_SCALE < scale < _MAX_SCALE:
        raise GeoreferenceError(
            f"the places are {scale:.3g} times as far apart as in the map: not the same metres"
        )
