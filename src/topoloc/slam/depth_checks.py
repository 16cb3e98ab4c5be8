"""Check that the depth images of a recording have the view of its images: jumps in depth lie where
brightness changes. Depth of another camera, or of another focal length, does not."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from topoloc.features.parallel import parallel_map
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame

_ZOOMS = np.array([0.84, 0.88, 0.92, 0.96, 1.0, 1.04, 1.08, 1.12, 1.16])
_MAX_SHIFT, _TOLERANCE = 12, 2  # share of the image's width, in 1 / 320
_WIDTH = 320  # pixels of the images that are compared


def find_depth_shift(sequence: StereoSequence, num_frames: int = 8) -> str | None:
    """Return a note if the depth fits the images of a recording clearly better after a shift or a
    zoom. Return None for other recordings and for images that do not decide.

    Raises:
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    # Score of the best zoom and shift, also relative to that of the depth as it is. Right depth has
    # up to 1.08, depth of a camera 5 cm beside 1.21 to 1.33. Unclear edges have scores below 0.45.
    min_frames, min_score, min_ratio = 3, 0.5, 1.15
    if sequence[0].depth is None or sequence[0].camera is None:
        return None
    rows = np.unique(np.linspace(0, len(sequence) - 1, num_frames).astype(int)).tolist()
    found = list(parallel_map(_correlate_edges, (sequence[row] for row in rows)))
    scores = [one for one in found if one is not None]
    if len(scores) < min_frames:
        return None
    score = np.mean(scores, axis=0)
    zoom, down, right = np.unravel_index(np.argmax(score), score.shape)
    middle, near = len(_ZOOMS) // 2, slice(_MAX_SHIFT - _TOLERANCE, _MAX_SHIFT + _TOLERANCE + 1)
    as_is = score[middle - 1 : middle + 2, near, near].max()
    if score.max() < max(min_score, min_ratio * as_is):
        return None
    pixels = sequence[0].image.shape[1] / _WIDTH * (np.array([right, down]) - _MAX_SHIFT)
    return (
        f"{sequence.name}: depth does not lie on the pictures: edges fit better with the depth"
        f" images enlarged {_ZOOMS[zoom]:g} times and moved by {pixels[0]:.0f}, {pixels[1]:.0f} px"
        " (right, down); register the depth to the colour camera"
    )


def _correlate_edges(frame: StereoFrame) -> Float[np.ndarray, "zooms s s"] | None:
    """Return the contrast at the near sides of jumps in depth, less the mean contrast of the image
    and relative to it, for each zoom and shift (down, right) of depth. None if there are few."""
    min_jump, min_pixels, border_px = 0.08, 200, 8
    view = prepare_frame(frame)
    if view.depth is None:
        return None
    grey = cv2.GaussianBlur(view.grey, (0, 0), 1.5)
    contrast = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    contrast = np.minimum(contrast, 4.0 * contrast.mean())
    is_near = np.zeros(view.depth.shape, bool)
    for axis, shift in ((0, 2), (0, -2), (1, 2), (1, -2)):
        is_near |= np.roll(view.depth, shift, axis) > (1.0 + min_jump) * view.depth
    inner = slice(border_px, -border_px)
    points = np.argwhere(is_near[inner, inner]) + border_px
    if len(points) < min_pixels:
        return None
    scale = _WIDTH / contrast.shape[1]
    height = max(1, round(scale * contrast.shape[0]))
    contrast = cv2.resize(contrast, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    mean, shape = float(contrast.mean()), (height + 2 * _MAX_SHIFT, _WIDTH + 2 * _MAX_SHIFT)
    spectrum = np.fft.rfft2(contrast - mean, shape)
    centre = np.array([view.camera.cy, view.camera.cx])
    scores = []
    for zoom in _ZOOMS:
        pixels = np.rint(scale * (zoom * (points - centre) + centre)).astype(int)
        pixels = pixels[((pixels >= 0) & (pixels < contrast.shape)).all(axis=1)]
        edges = np.zeros(contrast.shape)
        np.add.at(edges, tuple(pixels.T), 1.0 / max(len(pixels), 1))
        sums = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(edges, shape)), shape)
        size = 2 * _MAX_SHIFT + 1
        scores.append(np.roll(sums, (_MAX_SHIFT, _MAX_SHIFT), (0, 1))[:size, :size])
    return np.array(scores) / max(mean, 1e-9)
