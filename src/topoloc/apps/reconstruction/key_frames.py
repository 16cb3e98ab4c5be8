"""Select the key frames of a video: sharp ones, a part of the image apart."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import cv2
import numpy as np

from topoloc import StereoSequence
from topoloc.apps.core_names import SequenceView, read_left_frame, to_grey

_WIDTH = 320  # of the reduced images, pixels
_MIN_SHIFT, _MAX_SHIFT = 0.06, 0.10  # of the width, between key frames: the sharpest one of these
_MIN_TRACKED = 0.5  # of the corners of the last key frame


def select_key_frames(
    sequence: StereoSequence,
    always: Collection[str],
    progress: Callable[[str, int, int], object],
) -> StereoSequence:
    """Return the first frame, and each time the image has shifted by 6 to 10 % of its width since
    the last one the sharpest frame; and those named `always`. Raises UnreadableImageError,
    RecordingError: a frame cannot be read."""
    chosen, best = list[int](), (-1.0, 0, np.zeros((0, 0), np.uint8))
    tracks = None
    for row in range(len(sequence)):
        grey = _reduce(to_grey(read_left_frame(sequence, row).image))
        if tracks is None:
            chosen, tracks = [row], _Tracks(grey)
        shift = tracks.follow(grey)
        if shift >= _MIN_SHIFT:
            sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
            best = max(best, (sharpness, row, grey), key=lambda one: one[0])
        if shift >= _MAX_SHIFT:
            chosen.append(best[1])
            tracks, best = _Tracks(best[2]), (-1.0, 0, grey)
            tracks.follow(grey)
        progress("key frames", row + 1, len(sequence))
    named = {row for row, name in enumerate(sequence.names) if name in always}
    chosen = sorted(named.union(chosen))
    return SequenceView(sequence, chosen, [sequence.poses[row] for row in chosen])


class _Tracks:
    """Follow the corners of a key frame from frame to frame."""

    def __init__(self, grey: np.ndarray) -> None:
        found = cv2.goodFeaturesToTrack(grey, 200, 0.01, 8)
        self._first = np.zeros((0, 1, 2), np.float32) if found is None else found
        self._last, self._grey, self._num = self._first, grey, len(self._first)

    def follow(self, grey: np.ndarray) -> float:
        """Return the median shift since the key frame as a share of the width; infinite if most
        corners are lost, 0 if there were none."""
        if self._num == 0:
            return float("inf") if cv2.goodFeaturesToTrack(grey, 200, 0.01, 8) is not None else 0.0
        if len(self._last):
            follow: Any = cv2.calcOpticalFlowPyrLK  # its stub lacks None
            last, status, _ = follow(self._grey, grey, self._last, None)
            is_found = status.ravel() > 0
            self._first, self._last, self._grey = self._first[is_found], last[is_found], grey
        if len(self._last) < _MIN_TRACKED * self._num:
            return float("inf")
        return float(np.median(np.linalg.norm(self._last - self._first, axis=2))) / grey.shape[1]


def _reduce(grey: np.ndarray) -> np.ndarray:
    factor = _WIDTH / grey.shape[1]
    return cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
