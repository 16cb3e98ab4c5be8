"""Track points from image to image: corners on a grid, pyramidal Lucas-Kanade, then alignment with
the key frame.

Bouguet's *Pyramidal implementation of the Lucas Kanade feature tracker*, 2000, as in OpenCV, finds
a point after one step of motion. Alignment with the patch of the last key frame removes the drift
of many such steps. It also checks that the point is still the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from topoloc.compiled import parallel_for_rows
from topoloc.points.point_tracking_kernels import refine_tracks, select_cell_corners


def track_points(
    previous: UInt8[np.ndarray, "h w"],
    current: UInt8[np.ndarray, "h w"],
    points_img: Float32[np.ndarray, "n 2"],
    guesses_img: Float32[np.ndarray, "n 2"],
) -> tuple[Float32[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Return the positions of the previous image's points in the current one, searched from
    `guesses_img`, and which points were found."""
    window_px = 15  # side of the window of optical flow (Lucas and Kanade)
    levels = 3  # number of pyramid levels above the full image for optical flow
    if len(points_img) == 0:
        return guesses_img.copy(), np.zeros(0, np.bool_)
    window = (window_px, window_px)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03)
    flow: Any = cv2.calcOpticalFlowPyrLK  # the stubs require the outputs
    found, status, _ = flow(
        previous, current, points_img[:, None], guesses_img[:, None].copy(),
        winSize=window, maxLevel=levels, criteria=criteria, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    found = np.ascontiguousarray(found[:, 0], np.float32)
    return found, (status[:, 0] > 0) & np.isfinite(found).all(axis=1)


def follow_points(
    previous: UInt8[np.ndarray, "h w"],
    current: UInt8[np.ndarray, "h w"],
    points_img: Float32[np.ndarray, "n 2"],
    shifts_px: Float[np.ndarray, "n 2"],
    reference: Float32[np.ndarray, "h w"],
    points_ref: Float32[np.ndarray, "n 2"],
    depths: tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]],
    *,
    patch_half_px: int = 5,
    max_shift_px: float = 2.5,
) -> tuple[Int[np.ndarray, " m"], AlignedPoints]:
    """Track points from the previous image to the current one, and align them with the reference.

    Args:
        shifts_px: the expected motion of the points in the image, NaN if unknown.
        depths: the depths of the points in the reference and in the current image, whose ratio is
            the scale of a patch.
        patch_half_px, max_shift_px: as of `align_with_reference`.

    Returns:
        The rows of the points that match the reference, and these points.
    """
    limit = np.array(current.shape[::-1]) / 2.0
    moved = np.clip(np.nan_to_num(shifts_px), -limit, limit)
    found, is_found = track_points(
        previous, current, points_img, (points_img + moved).astype(np.float32)
    )
    rows = np.flatnonzero(is_found)
    scales = np.clip(depths[0] / np.maximum(depths[1], 1e-3), 0.5, 2.0).astype(np.float32)
    limits = {"patch_half_px": patch_half_px, "max_shift_px": max_shift_px}
    aligned = align_with_reference(
        reference, current.astype(np.float32), points_ref[rows], found[rows], scales[rows], **limits
    )
    kept = aligned.is_matched
    return rows[kept], AlignedPoints(*(column[kept] for column in vars(aligned).values()))


@dataclass(frozen=True, eq=False)
class AlignedPoints:
    """Hold aligned points, whether each one matches the reference, and the standard deviation
    (pixels) of its position from the patch residuals."""

    points_img: Float32[np.ndarray, "n 2"]
    is_matched: Bool[np.ndarray, " n"]
    sigmas_px: Float32[np.ndarray, " n"]


def align_with_reference(
    reference: Float32[np.ndarray, "h w"],
    image: Float32[np.ndarray, "h w"],
    points_ref: Float32[np.ndarray, "n 2"],
    points_img: Float32[np.ndarray, "n 2"],
    scales: Float32[np.ndarray, " n"],
    *,
    patch_half_px: int = 5,
    max_shift_px: float = 2.5,
) -> AlignedPoints:
    """Return the points of `image` moved to the best match with `points_ref` of the reference. The
    reference patches are enlarged by `scales`.

    Args:
        patch_half_px: half side of the compared patches.
        max_shift_px: a point that moves farther than this does not match.
    """
    min_correlation = 0.7  # minimum normalised correlation of the two patches
    refined = np.empty_like(points_img)
    scores, sigmas = np.empty((2, len(points_img)), np.float32)

    def run(first: int, last: int) -> None:
        refine_tracks(
            reference, image, points_ref, points_img, scales, patch_half_px, 8, max_shift_px, first, last,  # noqa: E501
            refined, scores, sigmas,
        )  # fmt: skip

    parallel_for_rows(run, len(points_img))
    return AlignedPoints(refined, scores >= min_correlation, sigmas)


def find_corners(
    grey: UInt8[np.ndarray, "h w"],
    existing_img: Float[np.ndarray, "n 2"] | Float32[np.ndarray, "n 2"],
    *,
    num_corners: int = 450,
    patch_half_px: int = 5,
) -> Float32[np.ndarray, "m 2"]:
    """Return the strongest corner (Shi and Tomasi, 1994) of each grid cell without an existing
    point, row by row.

    Args:
        num_corners: number of grid cells.
        patch_half_px: that of `align_with_reference`. Corners closer to the border are left out.
    """
    # Minimum corner strength (smaller eigenvalue), as a fraction of the strongest in the image, and
    # absolute: weaker corners are noise.
    min_quality, min_eigenvalue = 0.002, 2e-4
    height, width = grey.shape
    side = max(8, round(np.sqrt(height * width / num_corners)))
    rows, columns = height // side, width // side
    strength = cv2.cornerMinEigenVal(grey, 3)
    threshold = max(min_quality * float(strength.max()), min_eigenvalue)
    top, left = (height - rows * side) // 2, (width - columns * side) // 2
    cell_of = np.floor((existing_img - [left, top]) / side).astype(np.int64)
    inside = ((cell_of >= 0) & (cell_of < [columns, rows])).all(axis=1)
    is_free = np.ones((rows, columns), np.bool_)
    is_free[cell_of[inside, 1], cell_of[inside, 0]] = False
    corners = np.empty((rows * columns, 2), np.float32)
    given = side, top, left, patch_half_px + 3, np.float32(threshold), corners
    return corners[: select_cell_corners(strength, is_free, *given)]
