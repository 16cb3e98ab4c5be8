"""Match images of one place whose poses are not known: the view graph of structure from motion.

Each image is compared with those that retrieval ranks first and with the next ones of its
recording. The matches of a pair must agree on one epipolar geometry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float32

from topoloc.compiled import parallel_map
from topoloc.features.extraction import drop_masked, extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import match_features
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.recordings.frame import StereoFrame, StereoSequence, to_grey
from topoloc.recordings.recording import read_left_frame
from topoloc.retrieval.coarse import VladConfig
from topoloc.retrieval.vlad import learn_words_from_parts, vlad
from topoloc.slam.image_tracks import ImagePair

_MAX_SIDE = 1600  # pixels: larger images are reduced before features are extracted
_NUM_SIMILAR, _NUM_NEXT = 20, 3  # images that each is compared with
_MIN_INLIERS, _MAX_EPIPOLAR_ERROR_PX = 15, 2.0


@dataclass(frozen=True, eq=False)
class ViewGraph:
    """Hold the cameras and key points of images (pixels), and the pairs that see the same place:
    rows of images, and of their key points. Images of several recordings follow each other."""

    cameras: list[Camera | UncalibratedCamera]
    points_img: list[Float32[np.ndarray, "n 2"]]
    pairs: list[ImagePair]


def match_views(
    sequences: Sequence[StereoSequence], progress: Callable[[str, int, int], object]
) -> ViewGraph:
    """Match all images of recordings. Right and depth images are not read. Raises RecordingError,
    CalibrationError, UnreadableImageError: a frame cannot be read."""
    frames = (read_left_frame(one, row) for one in sequences for row in range(len(one)))
    total, features = sum(map(len, sequences)), list[Features]()
    cameras = list[Camera | UncalibratedCamera]()
    for camera, one in parallel_map(_extract, frames):
        cameras.append(camera)
        features.append(one)
        progress("features", len(features), total)
    tried = _select_pairs(features, [len(one) for one in sequences])
    pairs = list[ImagePair]()
    found = parallel_map(lambda pair: _match(features, *pair), tried)
    for done, one in enumerate(found, start=1):
        pairs += [one] if len(one.features) >= _MIN_INLIERS else []
        progress("pairs", done, len(tried))
    return ViewGraph(cameras, [one.points_img for one in features], pairs)


def _extract(frame: StereoFrame) -> tuple[Camera | UncalibratedCamera, Features]:
    grey = to_grey(frame.image)
    size = grey.shape[1], grey.shape[0]
    camera = frame.camera or UncalibratedCamera.from_focal_guess(*size, frame.exif_focal_px)
    factor = min(1.0, _MAX_SIDE / max(grey.shape))
    if factor < 1.0:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    found = extract_features(grey, FeatureConfig(), num_threads=1)
    whole = replace(found, points_img=(found.points_img + 0.5) / np.float32(factor) - 0.5)
    return camera, drop_masked(whole, camera)


def _select_pairs(features: Sequence[Features], lengths: Sequence[int]) -> list[tuple[int, int]]:
    if not any(map(len, features)):
        return []
    words = learn_words_from_parts(
        [len(one) for one in features], lambda k: features[k].descriptors, VladConfig()
    )
    vectors = np.stack([vlad(one.descriptors, words) for one in features])
    similarities = vectors @ vectors.T
    np.fill_diagonal(similarities, -np.inf)
    similar = np.argsort(-similarities, axis=1, kind="stable")[:, :_NUM_SIMILAR]
    pairs = {(min(k, j), max(k, j)) for k, row in enumerate(similar.tolist()) for j in row}
    starts = np.cumsum([0, *lengths])
    for start, stop in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        pairs |= {
            (k, j) for k in range(start, stop) for j in range(k + 1, min(k + 1 + _NUM_NEXT, stop))
        }
    return sorted(pair for pair in pairs if pair[0] != pair[1])


def _match(features: Sequence[Features], first: int, second: int) -> ImagePair:
    """Return the matches of a pair that agree on one epipolar geometry."""
    a, b = features[first], features[second]
    found = match_features(a.descriptors, b.descriptors, MatchingConfig(), num_threads=1)
    rows = np.column_stack([found.query_idx, found.train_idx]).astype(np.int64)
    if len(rows) < _MIN_INLIERS:
        return ImagePair(first, second, rows[:0])
    usac = cv2.UsacParams()
    usac.threshold, usac.confidence, usac.maxIterations = _MAX_EPIPOLAR_ERROR_PX, 0.999, 2000
    usac.loMethod, usac.loIterations = cv2.LOCAL_OPTIM_INNER_LO, 5
    points = [one.points_img[of].astype(np.float64) for one, of in zip((a, b), rows.T, strict=True)]
    try:
        _, inliers = cv2.findFundamentalMat(points[0], points[1], usac)
    except cv2.error:  # thrown for some degenerate samples
        inliers = None
    is_inlier = np.zeros(len(rows), bool) if inliers is None else inliers.ravel() > 0
    return ImagePair(first, second, rows[is_inlier])
