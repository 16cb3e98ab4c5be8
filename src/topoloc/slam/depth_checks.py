"""Check that the depth images of a recording have the view of its images: jumps in depth lie where
brightness changes. Depth of another camera, focal length or moment does not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from topoloc.compiled import parallel_map
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import downscale_image, prepare_frame

_WIDTH, _MAX_SHIFT = 320, 12  # pixels: of the images that are compared
_ZOOMS = np.linspace(0.84, 1.16, 9)


def find_depth_shift(sequence: StereoSequence) -> str | None:
    """Return a note if the depth fits the images of a recording clearly better after a shift or a
    zoom. None for other recordings and for images that do not decide. Raises as the recording."""
    # Best score, also relative to that near the depth as it is: right depth has up to 1.08, depth
    # of a camera 5 cm beside 1.21 to 1.33. Unclear edges have scores below 0.45.
    num_frames, min_frames, min_score, min_ratio, near_px = 8, 3, 0.5, 1.15, 2
    if sequence[0].depth is None or sequence[0].camera is None:
        return None
    rows = np.unique(np.linspace(0, len(sequence) - 1, num_frames).astype(int)).tolist()
    found = parallel_map(_correlate_edges, (sequence[row] for row in rows))
    scores = [one for one in found if one is not None]
    if len(scores) < min_frames:
        return None
    score, middle = np.mean(scores, axis=0), len(_ZOOMS) // 2
    near = slice(_MAX_SHIFT - near_px, _MAX_SHIFT + near_px + 1)
    as_is = score[middle - 1 : middle + 2, near, near].max()
    if score.max() < max(min_score, min_ratio * as_is):
        return None
    zoom, down, right = np.unravel_index(np.argmax(score), score.shape)
    x, y = sequence[0].image.shape[1] / _WIDTH * (np.array([right, down]) - _MAX_SHIFT)
    return (
        f"{sequence.name}: depth does not lie on the images, so poses are less exact: edges fit"
        f" better with depth scaled by {_ZOOMS[zoom]:.2f} and moved by {x:.0f}, {y:.0f} px of the"
        " image (right, down); record depth that is registered to the colour camera"
    )


def find_late_depth(sequence: StereoSequence) -> str | None:
    """Return a note if depth fits the image before, or after, clearly better than its own. None for
    other recordings and for images that do not decide. Raises as the recording."""
    # right depth: another image is better in 0 to 50 % of the frames, and never on average; depth
    # that is a frame late: in all, twice as good
    num_frames, min_frames, min_score, min_ratio, min_share = 12, 5, 0.5, 1.15, 0.8
    if len(sequence) < min_frames or sequence[0].depth is None or sequence[0].camera is None:
        return None
    rows = np.unique(np.linspace(1, len(sequence) - 2, num_frames).astype(int)).tolist()
    scores = list(parallel_map(lambda row: _score_neighbours(sequence, row), rows))
    known = np.array([one for one in scores if one is not None])
    if len(known) < min_frames:
        return None
    before, own, after = known.mean(axis=0)
    best = 0 if before > after else 2
    share = np.mean(known[:, best] > known[:, 1])
    if max(before, after) < max(min_score, min_ratio * own) or share < min_share:
        return None
    words = ("before", "late", "after") if best == 0 else ("after", "early", "before")
    return (
        f"{sequence.name}: depth is a frame {words[1]}: it fits the picture {words[0]} its own, so"
        f" points are less exact; give each picture the depth image {words[2]} its own"
    )


def _score_neighbours(sequence: StereoSequence, row: int) -> tuple[float, float, float] | None:
    """Return how well the depth of a frame fits the images before it, of it, and after it."""
    frame, scores, near = sequence[row], list[float](), slice(_MAX_SHIFT - 2, _MAX_SHIFT + 3)
    for other in (row - 1, row, row + 1):
        found = _correlate_edges(replace(frame, image=sequence[other].image), np.ones(1))
        if found is None:
            return None
        scores.append(float(found[0, near, near].max()))
    return scores[0], scores[1], scores[2]


def _correlate_edges(
    frame: StereoFrame, zooms: Float[np.ndarray, " zooms"] = _ZOOMS
) -> Float[np.ndarray, "zooms s s"] | None:
    """Return the contrast at the near sides of jumps in depth, less the mean contrast of the image
    and relative to it, for each zoom and shift (down, right) of depth. None if there are few."""
    min_jump, min_pixels, border_px = 0.08, 200, 8
    view, size = prepare_frame(frame), 2 * _MAX_SHIFT + 1
    if (depth := view.depth) is None:
        return None
    grey, camera = downscale_image(view.grey, view.camera, max(depth.shape))
    grey = cv2.GaussianBlur(grey, (0, 0), 1.5)
    contrast = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    contrast = np.minimum(contrast, 4.0 * contrast.mean())
    farther = [np.roll(depth, shift, axis) for axis in (0, 1) for shift in (-2, 2)]
    is_near = np.max(np.nan_to_num(farther), axis=0) > (1.0 + min_jump) * depth
    points = np.argwhere(is_near[border_px:-border_px, border_px:-border_px]) + border_px
    if len(points) < min_pixels:
        return None
    scale = _WIDTH / contrast.shape[1]
    height, centre = max(1, round(scale * contrast.shape[0])), [camera.cy, camera.cx]
    contrast = cv2.resize(contrast, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    mean, shape = float(contrast.mean()), (height + 2 * _MAX_SHIFT, _WIDTH + 2 * _MAX_SHIFT)
    spectrum, scores = np.fft.rfft2(contrast - mean, shape), []
    for zoom in zooms:
        pixels = np.rint(scale * (zoom * (points - centre) + centre)).astype(int)
        pixels = pixels[((pixels >= 0) & (pixels < contrast.shape)).all(axis=1)]
        edges = np.zeros(contrast.shape)
        np.add.at(edges, tuple(pixels.T), 1.0 / max(len(pixels), 1))
        sums = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(edges, shape)), shape)
        scores.append(np.roll(sums, (_MAX_SHIFT, _MAX_SHIFT), (0, 1))[:size, :size])
    return np.array(scores) / max(mean, 1e-9)
