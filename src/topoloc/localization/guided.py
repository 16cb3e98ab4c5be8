"""Match map points near their predicted pixels, given an approximate pose.

The ratio test must reject many true matches among thousands of descriptors. Within a few pixels
these matches are safe. The nodes can be selected by the camera position instead of appearance. The
nearest nodes measured their points from nearly the same place.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Float32, Int, Int32

from topoloc.bounds import Between
from topoloc.compiled import kernel
from topoloc.features.feature_types import FeatureType, GuidedThresholds
from topoloc.features.features import Features, Matches
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.pose_fit import LocalMap


@dataclass(frozen=True)
class GuidedConfig:
    """Configure guided matching. `resolved` adds the thresholds of the feature type."""

    num_nodes: Annotated[int, Between(0, 1000)] = 3
    """Number of nodes nearest to the pose proposal (Eq. 1) whose points are searched. 0 keeps the
    proposal as it is."""
    radius_px: Annotated[float, Between(0, 1000)] = 10.0
    """Search radius around the projection of a map point, in pixels of an image whose longer side
    is 640. Scales with the image size."""

    def resolved(
        self, kind: FeatureType, thresholds: GuidedThresholds | None = None
    ) -> ResolvedGuidedConfig:
        """Return the settings with the thresholds of a feature type.

        `thresholds` replaces those of the type for nearby key points. Sizes and angles are not
        compared if the feature type does not measure them.
        """
        limits = asdict(thresholds or kind.guided)
        limits |= {} if kind.has_scale else {"max_scale": math.inf}
        limits |= {} if kind.has_angle else {"max_turn": math.inf}
        return ResolvedGuidedConfig(self.num_nodes, self.radius_px, **limits)


@dataclass(frozen=True, kw_only=True)
class ResolvedGuidedConfig(GuidedConfig):
    """Hold the settings of guided matching for a feature type."""

    max_scale: float
    """Maximum ratio between the measured and the predicted key point size, in either direction."""
    max_turn: float
    """Maximum difference between the measured and the predicted orientation, radians."""
    min_similarity: float
    """Minimum scalar product of the two descriptors."""
    min_margin: float
    """Minimum difference in similarity between the best and the second key point within the
    radius."""


def match_guided(
    features: Features,
    local_map: LocalMap,
    cam_from_world: Rigid3,
    camera: Camera,
    config: GuidedConfig,
) -> Matches:
    """Match key points with map points near the pixels that `cam_from_world` predicts.

    Each key point gets at most one map point, the most similar.
    """
    return match_predicted(
        features, local_map, predict_key_points(local_map, cam_from_world, camera), camera, config
    )


def match_predicted(
    features: Features,
    local_map: LocalMap,
    predicted: Float32[np.ndarray, "n 5"],
    camera: Camera,
    config: GuidedConfig,
) -> Matches:
    """Match as `match_guided` does, with the output of `predict_key_points` given."""
    found, similarities = _match_predictions(features, local_map, predicted, camera, config)
    train_idx = np.flatnonzero(found >= 0)
    train_idx = train_idx[np.argsort(-similarities[train_idx], kind="stable")]
    query_idx, first = np.unique(found[train_idx], return_index=True)
    train_idx = train_idx[first]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * similarities[train_idx], 0.0)).astype(np.float32)
    return Matches(query_idx.astype(np.int32), train_idx.astype(np.int32), distances)


def count_chance_matches(
    features: Features,
    local_map: LocalMap,
    cam_from_world: Rigid3,
    camera: Camera,
    config: GuidedConfig,
) -> int:
    """Count the matches that `match_guided` would find with a wrong pose.

    All map points are searched a third of the image away from their predictions.
    """
    predicted = predict_key_points(local_map, cam_from_world, camera)
    size = np.array([camera.width, camera.height], np.float32)
    predicted[:, :2] = np.mod(predicted[:, :2] + size / 3.0, size)
    found, _ = _match_predictions(features, local_map, predicted, camera, config)
    return len(np.unique(found[found >= 0]))


def _match_predictions(
    features: Features,
    local_map: LocalMap,
    predicted: Float32[np.ndarray, "n 5"],
    camera: Camera,
    config: GuidedConfig,
) -> tuple[Int32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Return the most similar key point near each prediction (-1 for none) and its similarity."""
    assert isinstance(config, ResolvedGuidedConfig), "resolve the configuration first"
    key_points = np.column_stack(
        [features.points_img, features.sizes_px, np.cos(features.angles), np.sin(features.angles)]
    )
    return match_projections(
        predicted,
        local_map.descriptors,
        key_points.astype(np.float32),
        features.descriptors,
        float(camera.width),
        float(camera.height),
        float(config.radius_px * camera.radius_scale),
        np.float32(config.max_scale),
        np.float32(np.cos(config.max_turn) if config.max_turn < math.pi else -math.inf),
        np.float32(config.min_similarity),
        np.float32(config.min_margin),
    )


def select_visible_points(
    points_world: Float[np.ndarray, "n 3"], cam_from_world: Rigid3, camera: Camera
) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, "v 2"]]:
    """Return the rows of the points (metres) in the camera's view, and their pixels."""
    _, pixels = _project_points(points_world, cam_from_world, camera)
    rows = np.flatnonzero(np.isfinite(pixels[:, 0]))
    return rows, pixels[rows]


def count_seen_points(
    local_map: LocalMap, centre: Float[np.ndarray, "3"], cam_from_world: Rigid3, camera: Camera
) -> int:
    """Count the points in the camera's view that it sees from nearly the same side as the node.

    `centre` is the node's position (world).
    """
    min_cosine = 0.6
    rows, _ = select_visible_points(local_map.points_world, cam_from_world, camera)
    points = local_map.points_world[rows]
    rays = points - centre, points + cam_from_world.translation @ cam_from_world.rotation
    lengths = np.prod([np.linalg.norm(one, axis=1) for one in rays], axis=0)
    return int(np.count_nonzero(np.sum(rays[0] * rays[1], axis=1) > min_cosine * lengths))


def _project_points(
    points_world: Float[np.ndarray, "n 3"], cam_from_world: Rigid3, camera: Camera
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Return points in the camera frame (metres) and their pixels, NaN if out of view."""
    if not camera.is_distorted:
        fx, fy, cx, cy = camera.intrinsics
        points_cam, pixels = project_undistorted(
            points_world,
            np.ascontiguousarray(cam_from_world.rotation),
            np.ascontiguousarray(cam_from_world.translation),
            (fx, fy),
            (cx, cy),
            camera.width,
            camera.height,
        )
        if camera.mask is None:
            return points_cam, pixels
    else:
        points_cam = cam_from_world.apply(points_world)
        pixels = camera.img_from_cam(points_cam)
    return points_cam, np.where(camera.is_in_image(pixels)[:, None], pixels, np.nan)


def predict_key_points(
    local_map: LocalMap, cam_from_world: Rigid3, camera: Camera
) -> Float32[np.ndarray, "n 5"]:
    """Predict the pixel, size and orientation (cosine, sine) of each map point, NaN if out of view.

    The surface is assumed to face the node's camera. `max_scale` and `max_turn` allow for its
    slant.
    """
    points_cam, pixels = _project_points(local_map.points_world, cam_from_world, camera)
    rotation = np.ascontiguousarray(cam_from_world.rotation)
    return predict_from_pixels(
        points_cam, pixels, local_map.sizes, local_map.directions, rotation, float(camera.fx)
    )


def count_consistent_displacements(
    features: Features,
    matches: Matches,
    predicted: Float32[np.ndarray, "n 5"],
    camera: Camera,
    within_px: float,
) -> int:
    """Count the matches with consistent displacements from their predictions.

    The count is the largest number of matches within `within_px` of the displacement of one match.
    `within_px` refers to an image whose longer side is 640 pixels, and scales with the image size.
    """
    shifts = features.points_img[matches.query_idx] - predicted[matches.train_idx, :2]
    return int(largest_shift_agreement(shifts, np.float32(within_px * camera.radius_scale)))


# Numba kernels


@kernel(error_model="numpy", fastmath={"reassoc", "contract"})
def _order_by_cell(key_points, radius, num_columns, num_rows):
    """Return the rows of key points by cell of a grid, and the first position of each cell."""
    cells = np.empty(len(key_points), np.int64)
    starts = np.zeros(num_columns * num_rows + 1, np.int64)
    for k in range(len(key_points)):
        column = min(max(int(key_points[k, 0] / radius), 0), num_columns - 1)
        row = min(max(int(key_points[k, 1] / radius), 0), num_rows - 1)
        cells[k] = row * num_columns + column
        starts[cells[k] + 1] += 1
    starts = np.cumsum(starts)
    order, free = np.empty(len(key_points), np.int64), starts.copy()
    for k in range(len(key_points)):  # keeps the order within a cell
        order[free[cells[k]]] = k
        free[cells[k]] += 1
    return order, starts


@kernel(error_model="numpy", fastmath={"reassoc", "contract"})
def match_projections(
    predicted,
    map_descriptors,
    key_points,
    descriptors,
    width,
    height,
    radius,
    max_scale,
    min_cosine,
    min_similarity,
    min_margin,
):
    """Find the most similar key point within `radius` pixels of each predicted map point.

    Rows of `predicted` and `key_points` are (x, y, size, cosine and sine of the angle), float32. A
    prediction is NaN if the point is out of view. A key point is rejected if its size differs by
    more than the factor `max_scale`, or the cosine of the angle difference is below `min_cosine`.

    Return the row of the key point for each map point (-1 for none) and the similarity (scalar
    product). The best key point must exceed the others within the radius by `min_margin`. Others
    within two pixels (L1) of it are exempt, because they are one blob at two scales.
    """
    num_columns, num_rows = int(width / radius) + 1, int(height / radius) + 1
    order, starts = _order_by_cell(key_points, radius, num_columns, num_rows)
    # by cell, so that the key points of neighbouring cells are read one after the other
    sorted_points = np.empty((5, len(key_points)), np.float32)
    for position in range(len(order)):
        for part in range(5):
            sorted_points[part, position] = key_points[order[position], part]
    xs, ys, sizes, cosines, sines = sorted_points
    near = np.empty(len(key_points), np.int64)
    found = np.full(len(predicted), -1, np.int32)
    similarities = np.zeros(len(predicted), np.float32)
    for n in range(len(predicted)):
        x, y = predicted[n, 0], predicted[n, 1]
        if not (x > -radius and y > -radius and x < width + radius and y < height + radius):
            continue
        column, row = int(np.floor(x / radius)), int(np.floor(y / radius))
        size, cosine, sine, count = predicted[n, 2], predicted[n, 3], predicted[n, 4], 0
        first_column, last_column = max(column - 1, 0), min(column + 2, num_columns)
        for r in range(max(row - 1, 0), min(row + 2, num_rows)):
            first, last = r * num_columns + first_column, r * num_columns + last_column
            for position in range(starts[first], starts[max(last, first)]):
                dx, dy = xs[position] - x, ys[position] - y
                # without branches, most of which no processor could foresee
                near[count] = position
                count += int(
                    (dx * dx + dy * dy <= radius * radius)
                    & (not cosines[position] * cosine + sines[position] * sine < min_cosine)
                )
        best, second, best_k = np.float32(-2), np.float32(-2), -1
        for position in near[:count]:
            scale = sizes[position] / size
            if scale > max_scale or scale * max_scale < 1:
                continue
            k, product = order[position], np.float32(0)
            for d in range(descriptors.shape[1]):
                product += descriptors[k, d] * map_descriptors[n, d]
            if product <= second:
                continue
            is_apart = best_k < 0 or (
                abs(key_points[k, 0] - key_points[best_k, 0])
                + abs(key_points[k, 1] - key_points[best_k, 1])
                > 2
            )
            if product > best:
                if is_apart:
                    second = best
                best, best_k = product, k
            elif is_apart:
                second = product
        if best_k >= 0 and best >= min_similarity and best - second >= min_margin:
            found[n], similarities[n] = best_k, best
    return found, similarities


@kernel()
def largest_shift_agreement(shifts, within):
    """Return the largest number of rows of `shifts` (n, 2) that lie within this distance of one."""
    most = 0
    for i in range(len(shifts)):
        count = 0
        for j in range(len(shifts)):
            dx, dy = shifts[i, 0] - shifts[j, 0], shifts[i, 1] - shifts[j, 1]
            count += int(dx * dx + dy * dy < within * within)
        most = max(most, count)
    return most


@kernel(error_model="numpy")
def project_undistorted(points_world, rotation, translation, focal, centre, width, height):
    """Project points into a camera without distortion.

    Return the points in the camera frame (n, 3), metres, and their pixels (n, 2), NaN if out of
    view.
    """
    points_cam, pixels = np.empty((len(points_world), 3)), np.empty((len(points_world), 2))
    for n in range(len(points_world)):
        p = points_world[n]
        for i in range(3):
            points_cam[n, i] = (
                rotation[i, 0] * p[0]
                + rotation[i, 1] * p[1]
                + rotation[i, 2] * p[2]
                + translation[i]
            )
        x, y, z = points_cam[n, 0], points_cam[n, 1], points_cam[n, 2]
        u, v = x / z * focal[0] + centre[0], y / z * focal[1] + centre[1]
        is_in_view = z > 1e-9 and u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5
        pixels[n, 0], pixels[n, 1] = (u, v) if is_in_view else (np.nan, np.nan)
    return points_cam, pixels


@kernel(error_model="numpy")
def predict_from_pixels(points_cam, pixels, sizes, directions, rotation, focal):
    """Predict rows (x, y, size, cosine and sine of the angle), float32, for points at known pixels.

    Rows with NaN pixels are NaN. `sizes` (metres) and `directions` (unit vectors, world) describe
    the patch of each descriptor. `focal` is in pixels.
    """
    predicted = np.full((len(pixels), 5), np.nan, np.float32)
    for n in range(len(pixels)):
        if not np.isfinite(pixels[n, 0]):
            continue
        x, y, z, d = points_cam[n, 0], points_cam[n, 1], points_cam[n, 2], directions[n]
        along = rotation[2, 0] * d[0] + rotation[2, 1] * d[1] + rotation[2, 2] * d[2]
        right = (
            rotation[0, 0] * d[0] + rotation[0, 1] * d[1] + rotation[0, 2] * d[2] - x / z * along
        )
        down = rotation[1, 0] * d[0] + rotation[1, 1] * d[1] + rotation[1, 2] * d[2] - y / z * along
        length = max(np.sqrt(right * right + down * down), 1e-9)
        predicted[n, 0], predicted[n, 1], predicted[n, 2] = (
            pixels[n, 0],
            pixels[n, 1],
            sizes[n] * focal / z,
        )
        predicted[n, 3], predicted[n, 4] = right / length, down / length
    return predicted
