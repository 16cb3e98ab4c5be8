"""Align matches by correlation with the images of the nodes.

The image of a node around a point is warped as a plane that faces the node, and moved over the
query image. This is adaptive least-squares correlation (Gruen, 1985) with a shift only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from msgspec import Struct

from topoloc.compiled import kernel, parallel_for_rows
from topoloc.errors import FeatureTypeError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import Finite, decode_json
from topoloc.localization.exact.templates import PointTemplates
from topoloc.localization.pose_fit import PointObservations


class LastStepWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the numbers of the last step (`last_step.py`).

    - `num_nodes`: nodes nearest to the pose whose points are used. Key points are matched within
      `radius_px` and are inliers within `max_error_px`, in pixels of an image whose longer side is
      640. Their error is `key_point_sigma_px`. Fewer than `min_matches` inliers correct nothing.
    - `max_aligned`: points that are aligned at most, in rounds that search up to `reaches_px`, by
      patches of `patch_px` squared pixels whose grey levels vary by `min_patch_sigma`. At least
      `min_aligned` must agree within `max_aligned_error_px`.
    - Patches that correlate by less than `min_correlation` are dropped. The variance of an aligned
      pixel is `variance` times (1 - correlation) over the second derivative of the correlation,
      plus `least_sigma_px` squared. It differs by direction: an edge fixes the pixel across, but
      not along it. Its root is at most `max_sigma_px` across, and `max_edge_sigma_px` along.
    - Variances grow with the square of the node's distance, over that of the nearest node, as
      poses of nodes are less exact the farther they are apart. They do so in full in maps whose
      rho is `full_growth_share`, and in proportion below.
    - `max_correlated_error_share`: rho of a map above which the step is left out.
    - `shared_error_slope`: times rho, it is the share of the verdict's correlated covariance that
      remains. `overlap_noise`: patches that overlap have the same errors, so n patches, of which m
      lie side by side, have this times n / m of the variance that independent ones have.
    """

    corpus: str
    date: str
    command: str
    num_nodes: int
    radius_px: Finite
    max_error_px: Finite
    key_point_sigma_px: Finite
    min_matches: int
    min_aligned: int
    max_aligned: tuple[int, ...]
    reaches_px: tuple[int, ...]
    max_aligned_error_px: Finite
    patch_px: int
    min_patch_sigma: Finite
    min_correlation: Finite
    variance: Finite
    least_sigma_px: Finite
    max_sigma_px: Finite
    max_edge_sigma_px: Finite
    full_growth_share: Finite
    max_correlated_error_share: Finite
    shared_error_slope: Finite
    overlap_noise: Finite


@cache
def load_last_step_weights() -> LastStepWeights:
    """Return the shipped numbers of the last step.

    Raises:
        FeatureTypeError: the file is damaged.
    """
    path = Path(__file__).parent / "weights.json"
    return decode_json(path.read_bytes(), LastStepWeights, FeatureTypeError, str(path))


@dataclass(frozen=True, eq=False)
class PreciseMatches(PointObservations):
    """Hold points of all feature types at pixels of the query, with the standard deviation of each
    pixel."""

    node_ids: Int[np.ndarray, " n"]
    sigmas_px: Float[np.ndarray, " n"]

    @staticmethod
    def concatenate(parts: Sequence[PreciseMatches]) -> PreciseMatches:
        """Return all matches."""
        columns = ([getattr(part, one.name) for part in parts] for one in fields(PreciseMatches))
        return PreciseMatches(*(np.concatenate(column) for column in columns))

    def select(self, rows: np.ndarray) -> PreciseMatches:
        """Return the given rows."""
        return PreciseMatches(*(getattr(self, field.name)[rows] for field in fields(self)))


def align(
    image: UInt8[np.ndarray, "h w"],
    camera: Camera,
    points: PreciseMatches,
    templates: PointTemplates,
    cam_from_world: Rigid3,
    reach_px: int,
    growth: float,
    weights: LastStepWeights,
) -> PreciseMatches:
    """Align points by correlation with the nodes' images. Those that do not correlate are dropped.

    Of the error of a point, that along the ray of its node remains: its pixel in the node's image
    is where the patch was taken. The error of the pixel along an edge is added to it. `growth` is
    that of variances with the square of the node's distance.
    """
    view = predict_patches(points.points_world, templates, cam_from_world, camera)
    pixels, correlations, bends = correlate(image, view, reach_px, weights)
    bend, along_edge = _bends_along_edges(bends)
    noise = weights.variance * (1.02 - correlations[:, None])  # of the query, even if alike
    variances = noise / np.maximum(bend, 1e-5) + weights.least_sigma_px**2
    away = np.linalg.norm(templates.origins - cam_from_world.inverse().translation, axis=1)
    ratios = away / max(away.min(initial=np.inf), 1e-3)
    variances *= 1.0 + growth * (ratios[:, None] ** 2 - 1.0)
    is_kept = (correlations > weights.min_correlation) & (bend[:, 0] > 0.0)
    rows = np.flatnonzero(is_kept & (variances[:, 1] < weights.max_sigma_px**2))
    found, rays = points.select(rows), (points.points_world - templates.origins)[rows]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    along = ((found.covariances @ rays[:, :, None])[:, :, 0] * rays).sum(axis=1)
    covariances = along[:, None, None] * rays[:, :, None] * rays[:, None, :]
    wide, narrow = variances[rows].T
    depths = cam_from_world.apply(found.points_world)[:, 2]
    edge_px = np.sqrt(np.minimum(wide - narrow, weights.max_edge_sigma_px**2))
    edges = along_edge[rows] @ cam_from_world.rotation[:2]
    edges *= (edge_px * depths / camera.fx)[:, None]
    covariances += edges[:, :, None] * edges[:, None, :]
    return replace(
        found,
        points_img=pixels[rows].astype(np.float32),
        sigmas_px=np.sqrt(narrow),
        covariances=covariances,
    )


def _bends_along_edges(
    bends: Float[np.ndarray, "n 2 2"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Return the second derivatives along and across the edge in each patch, and the unit vector
    along it: the eigenvalues, ascending, and the first eigenvector."""
    a, b, d = bends[:, 0, 0], bends[:, 0, 1], bends[:, 1, 1]
    middle, radius = (a + d) / 2.0, np.hypot((a - d) / 2.0, b)
    angle = np.arctan2(2.0 * b, a - d) / 2.0  # of the direction across the edge
    directions = np.column_stack([-np.sin(angle), np.cos(angle)])
    return np.column_stack([middle - radius, middle + radius]), directions


@dataclass(frozen=True, eq=False)
class PredictedPatches:
    """Hold the patches around points, as the nodes' images predict them.

    `predicted` are pixels of the query, `centres` those of the nodes' images. `warps` is the
    derivative of the second by the first on a plane that faces the node.
    """

    templates: PointTemplates
    predicted: Float[np.ndarray, "n 2"]
    centres: Float[np.ndarray, "n 2"]
    warps: Float[np.ndarray, "n 2 2"]


def predict_patches(
    points_world: Float[np.ndarray, "n 3"],
    templates: PointTemplates,
    cam_from_world: Rigid3,
    camera: Camera,
) -> PredictedPatches:
    """Return the patches of points."""
    in_query, in_node = cam_from_world.apply(points_world), templates.in_nodes(points_world)
    # short enough for the derivative of any lens
    lengths = 0.01 * in_node[:, 2:]
    turned = templates.turned_by(cam_from_world.rotation)
    queried = np.stack([in_query, *(in_query + lengths * turned[:, :, i] for i in range(2))])
    steps = np.stack([in_node, *(in_node + lengths * axis for axis in np.eye(3)[:2])])
    predicted, *by_query = camera.img_from_cam(queried.reshape(-1, 3)).reshape(3, -1, 2)
    centres, *by_node = templates.project(steps)
    (a, c), (b, d) = ((moved - predicted).T for moved in by_query)
    (e, g), (f, h) = ((moved - centres).T for moved in by_node)
    with np.errstate(divide="ignore", invalid="ignore"):  # a plane seen from its edge
        products = np.stack([e * d - f * c, f * a - e * b, g * d - h * c, h * a - g * b])
        warps = (products / (a * d - b * c)).T.reshape(-1, 2, 2)
    return PredictedPatches(templates, predicted, centres, warps)


def correlate(
    image: UInt8[np.ndarray, "h w"],
    patches: PredictedPatches,
    reach_px: int,
    weights: LastStepWeights,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"], Float[np.ndarray, "n 2 2"]]:
    """Return the pixels where patches correlate best with an image, the correlations and bends as
    `align_patches` does."""
    templates, count = patches.templates, len(patches.predicted)
    images, sizes = templates.templates.images
    pixels, correlations, bends = np.empty((count, 2)), np.empty(count), np.empty((count, 2, 2))

    def align_band(first: int, last: int) -> None:
        band = slice(first, last)
        of_point, predicted = templates.of_point[band], patches.predicted[band]
        projected = of_point, predicted, patches.centres[band], patches.warps[band]
        numbers = weights.patch_px, reach_px, weights.min_patch_sigma
        found = align_patches(image, images, sizes, *projected, *numbers)
        pixels[band], correlations[band], bends[band] = found

    parallel_for_rows(align_band, count)
    return pixels, correlations, bends


# Numba kernels


@kernel(error_model="numpy", fastmath={"reassoc", "contract"})
def _sample_patch(template, size, x, y, warp, patch, side):
    """Write the template around (x, y), warped to the query, into the first `side` rows and columns
    of `patch`, with zero mean. Return the sum of its squares, 0 if it leaves the template."""
    half, mean, squares, one = side // 2, np.float32(0.0), np.float32(0.0), np.float32(1.0)
    reach_x = half * (abs(warp[0, 0]) + abs(warp[0, 1]))
    reach_y = half * (abs(warp[1, 0]) + abs(warp[1, 1]))
    height, width = size[0] - 1.001, size[1] - 1.001  # what rounding adds stays inside
    if not (reach_x <= x <= width - reach_x and reach_y <= y <= height - reach_y):
        return squares
    for j in range(side):
        for i in range(side):
            px = x + warp[0, 0] * (i - half) + warp[0, 1] * (j - half)
            py = y + warp[1, 0] * (i - half) + warp[1, 1] * (j - half)
            x0, y0 = np.uint32(px), np.uint32(py)  # Numba looks for negative indices else
            x1, y1 = x0 + np.uint32(1), y0 + np.uint32(1)
            fx, fy = np.float32(px - x0), np.float32(py - y0)
            upper = (one - fx) * template[y0, x0] + fx * template[y0, x1]
            lower = (one - fx) * template[y1, x0] + fx * template[y1, x1]
            patch[j, i] = (one - fy) * upper + fy * lower
            mean += patch[j, i]
    mean /= np.float32(side * side)
    for j in range(side):
        for i in range(side):
            patch[j, i] -= mean
            squares += patch[j, i] * patch[j, i]
    return squares


@kernel(error_model="numpy", fastmath={"reassoc", "contract"})
def _correlate(patch, side, patch_squares, window, min_squares, scratch, scores):
    """Write the correlation of the patch with the window at each shift into `scores`, -1 without
    texture. The patch has the window's width and is padded by zeros, so that its pixels are as far
    apart as the window's. `scratch` holds two arrays of the window's shape."""
    width, shifts, length = window.shape[1], len(scores), patch.size
    sums, squares = scratch[0], scratch[1]
    of_patch, of_window = patch.reshape(-1), window.reshape(-1)
    for j in range(shifts):
        for i in range(shifts):
            moved, total = of_window[j * width + i :][:length], np.float32(0.0)
            for k in range(length):
                total += of_patch[k] * moved[k]
            scores[j, i] = total
    sums[0] = 0.0
    squares[0] = 0.0
    for j in range(side + shifts - 1):
        if j >= side:
            sums[j - side + 1] = sums[j - side] - window[j - side]
            squares[j - side + 1] = squares[j - side] - window[j - side] * window[j - side]
        row = max(j - side + 1, 0)
        for i in range(width):
            sums[row, i] += window[j, i]
            squares[row, i] += window[j, i] * window[j, i]
    for j in range(shifts):
        level, square = np.sum(sums[j, :side]), np.sum(squares[j, :side])
        for i in range(shifts):
            spread = square - level * level / np.float32(side * side)
            is_textured = spread > min_squares
            scores[j, i] = scores[j, i] / np.sqrt(patch_squares * spread) if is_textured else -1.0
            if i + 1 < shifts:
                level += sums[j, i + side] - sums[j, i]
                square += squares[j, i + side] - squares[j, i]


@kernel()
def _find_peak(scores, i, j, bend):
    """Return the offset (x, y) of the peak of the quadratic through the 3 x 3 scores around (i, j),
    at most a pixel. Write its negative second derivatives into `bend` (2, 2)."""
    best = scores[j, i]
    slope_x, slope_y = (
        0.5 * (scores[j, i + 1] - scores[j, i - 1]),
        0.5 * (scores[j + 1, i] - scores[j - 1, i]),
    )
    bend[0, 0] = 2.0 * best - scores[j, i + 1] - scores[j, i - 1]
    bend[1, 1] = 2.0 * best - scores[j + 1, i] - scores[j - 1, i]
    bend[0, 1] = bend[1, 0] = 0.25 * (
        scores[j + 1, i - 1] + scores[j - 1, i + 1] - scores[j + 1, i + 1] - scores[j - 1, i - 1]
    )
    determinant = bend[0, 0] * bend[1, 1] - bend[0, 1] * bend[0, 1]
    if not (bend[0, 0] > 0.0 and determinant > 0.0):
        return 0.0, 0.0
    x = (bend[1, 1] * slope_x - bend[0, 1] * slope_y) / determinant
    y = (bend[0, 0] * slope_y - bend[0, 1] * slope_x) / determinant
    return min(max(x, -1.0), 1.0), min(max(y, -1.0), 1.0)


@kernel()
def align_patches(
    image,
    templates,
    sizes,
    template_of_match,
    predicted,
    centres,
    warps,
    patch_px,
    reach_px,
    min_sigma,
):
    """Return the pixel of each match in `image` at which the patch around `centres` in its template
    correlates best, at most `reach_px` from `predicted`, the correlation, and its negative second
    derivatives (2, 2). The correlation is -1 if it is best at the border of the search, NaN if a
    patch is outside or has no texture.

    `sizes` are the heights and widths of `templates`, `warps` the derivatives of a template's
    pixel by the image's. The patch has an odd side, and grey levels that vary by `min_sigma`.
    """
    pixels, correlations = np.full((len(predicted), 2), np.nan), np.full(len(predicted), np.nan)
    bends = np.zeros((len(predicted), 2, 2))
    scores = np.zeros((2 * reach_px + 1, 2 * reach_px + 1), np.float32)
    margin, last = patch_px // 2 + reach_px, 2 * reach_px
    width = -(-(2 * margin + 1) // 8) * 8  # rows of whole vectors
    patch = np.zeros((-(-patch_px // 4) * 4, width), np.float32)
    window = np.zeros((len(patch) + last + 1, width), np.float32)
    scratch = np.zeros((2, *window.shape), np.float32)
    min_squares = np.float32(min_sigma**2 * patch_px**2)
    for k in range(len(predicted)):
        if not (np.isfinite(predicted[k, 0]) and np.isfinite(warps[k, 0, 0])):
            continue
        x, y = int(np.round(predicted[k, 0])), int(np.round(predicted[k, 1]))
        if not (margin <= x < image.shape[1] - margin and margin <= y < image.shape[0] - margin):
            continue
        row = template_of_match[k]
        contrast = _sample_patch(
            templates[row], sizes[row], centres[k, 0], centres[k, 1], warps[k], patch, patch_px
        )
        if contrast < min_squares:
            continue
        level = np.float32(image[y, x])  # of small numbers float32 keeps more digits
        for j in range(2 * margin + 1):
            pixels_of_row = image[y - margin + j, x - margin : x + margin + 1]
            for i in range(2 * margin + 1):
                window[j, i] = np.float32(pixels_of_row[i]) - level
        _correlate(patch, patch_px, contrast, window, min_squares, scratch, scores)
        best = np.argmax(scores)
        j, i = best // (last + 1), best % (last + 1)
        correlations[k] = -1.0
        if 0 < i < last and 0 < j < last:
            dx, dy = _find_peak(scores, i, j, bends[k])
            pixels[k, 0], pixels[k, 1] = x + i - reach_px + dx, y + j - reach_px + dy
            correlations[k] = scores[j, i]
    return pixels, correlations, bends
