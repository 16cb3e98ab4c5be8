"""Match the images of one camera that see the same place, and join the matches to tracks: the
features of several images that show one 3-D point.

A pair of images is matched if its poses let expect that both see the place. Right matches are near
the epipolar lines of the poses. Images that match none so are compared by their features alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from topoloc.compiled import parallel_map
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features, MatchingConfig
from topoloc.features.matching import match_features
from topoloc.geometry.camera import Camera
from topoloc.geometry.relative_pose import estimate_relative_pose
from topoloc.geometry.rigid import Rigid3, skew
from topoloc.points.metric_points import keypoint_sigmas
from topoloc.points.motion_triangulation import select_source_images
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import read_left_frame

_MIN_MATCHES = 25  # of a pair


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """Hold an image's features: pixels of a pinhole `camera`, without distortion, their standard
    deviations (pixels) and descriptors."""

    camera: Camera
    points_img: Float[np.ndarray, "n 2"]
    sigmas_px: Float[np.ndarray, " n"]
    features: Features

    @cached_property
    def rays(self) -> Float[np.ndarray, "n 3"]:
        """Return the features on the plane z = 1."""
        return np.insert(self.camera.normalized_from_img(self.points_img), 2, 1.0, axis=1)


@dataclass(frozen=True, eq=False)
class ImagePair:
    """Hold the matches of two images: rows of their features."""

    first: int
    second: int
    features: Int[np.ndarray, "n 2"]

    def errors_px(
        self, images: Sequence[TrackedImage], second_from_first: Rigid3, focal_factor: float = 1.0
    ) -> Float[np.ndarray, " n"]:
        """Return the distances of the matches (pixels) from the epipolar lines of a motion, with
        the focal lengths times a factor (Sampson's error)."""
        (a, x), (b, y) = (
            (one.camera, one.rays[rows] / [focal_factor, focal_factor, 1.0])
            for one, rows in zip(
                (images[self.first], images[self.second]), self.features.T, strict=True
            )
        )
        essential = skew(second_from_first.translation) @ second_from_first.rotation
        lines, back = x @ essential.T, y @ essential
        squares = np.square(np.column_stack([lines[:, :2], back[:, :2]])).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = np.abs(np.sum(y * lines, axis=1)) / np.sqrt(squares)
        return 0.5 * (a.fx + b.fx) * focal_factor * np.nan_to_num(errors)


def extract_images(sequence: StereoSequence, rows: Sequence[int]) -> list[TrackedImage]:
    """Extract the features of these frames. Raises RecordingError, CalibrationError,
    UnreadableImageError: a frame cannot be read."""

    def extract(frame: StereoFrame) -> TrackedImage:
        view = prepare_frame(frame, with_depth=False)
        features, c = extract_features(view.grey, FeatureConfig()), view.camera
        normalized = c.normalized_from_img(features.points_img.astype(np.float64))
        pinhole = Camera.pinhole(c.width, c.height, *c.intrinsics)
        points_img = normalized * [c.fx, c.fy] + [c.cx, c.cy]
        return TrackedImage(pinhole, points_img, keypoint_sigmas(features), features)

    return list(parallel_map(extract, (read_left_frame(sequence, row) for row in rows)))


def match_images(
    images: Sequence[TrackedImage],
    world_from_cams: Sequence[Rigid3],
    max_sources: int,
    max_error_px: float,
) -> tuple[list[ImagePair], Float[np.ndarray, " k"]]:
    """Return the pairs of each image and so many around it of which most matches are near the
    epipolar lines of the poses, and the share of such pairs of each image."""
    min_share = 0.5
    tried = sorted(
        {
            (min(k, other), max(k, other))
            for k in range(len(images))
            for other in select_source_images(world_from_cams, k)[:max_sources]
        }
    )

    def match(first: int, second: int) -> ImagePair | None:
        step = world_from_cams[second].inverse() @ world_from_cams[first]
        found = _match(images, first, second)
        near = found.errors_px(images, step) < max_error_px
        if len(near) == 0 or np.mean(near) < min_share:
            return None
        return replace(found, features=found.features[near])

    pairs = _run(match, tried)
    ends = [[k for one in pairs for k in (one.first, one.second)], np.ravel(tried)]
    found, all_of_it = (np.bincount(np.int64(of), minlength=len(images)) for of in ends)
    return pairs, found / np.maximum(all_of_it, 1)


def match_all(images: Sequence[TrackedImage], chosen: Sequence[int]) -> list[ImagePair]:
    """Return the pairs of the `chosen` images with any other (of many, an even sample) that agree
    on a motion, whatever the poses are."""
    max_others = 60

    def match(first: int, second: int) -> ImagePair | None:
        found, (a, b) = _match(images, first, second), (images[first], images[second])
        back = _match(images, second, first).features[:, ::-1]
        mutual = found.features[(found.features[:, None] == back).all(axis=2).any(axis=1)]
        if len(mutual) < _MIN_MATCHES:
            return None
        ends = a.points_img[mutual[:, 0]], a.camera, b.points_img[mutual[:, 1]], b.camera
        moved = estimate_relative_pose(*ends)
        return None if moved is None else replace(found, features=mutual[moved.inliers])

    others = range(0, len(images), -(-len(images) // max_others))
    pairs = {(min(k, j), max(k, j)) for k in chosen for j in others if j != k}
    return _run(match, sorted(pairs))


def _run(
    match: Callable[[int, int], ImagePair | None], pairs: Sequence[tuple[int, int]]
) -> list[ImagePair]:
    found = parallel_map(lambda pair: match(*pair), pairs)
    return [one for one in found if one is not None and len(one.features) >= _MIN_MATCHES]


def _match(images: Sequence[TrackedImage], first: int, second: int) -> ImagePair:
    a, b = (images[k].features.descriptors for k in (first, second))
    found = match_features(b, a, MatchingConfig())
    rows = np.column_stack([found.train_idx, found.query_idx]).astype(np.int64)
    return ImagePair(first, second, rows)


def join_tracks(
    images: Sequence[TrackedImage], pairs: Sequence[ImagePair]
) -> list[Int[np.ndarray, " n"]]:
    """Return, for each image, the track of each feature, or -1. Tracks are numbered from 0. One
    with two features of an image joins different points, and is dropped."""
    starts = np.cumsum([0, *(len(image.points_img) for image in images)])
    ends = [pair.features + starts[[pair.first, pair.second]] for pair in pairs]
    edges = np.concatenate([np.zeros((0, 2), np.int64), *ends])
    labels = np.arange(starts[-1])
    while True:  # the smallest feature of each track spreads along its matches
        least = labels[edges].min(axis=1)
        before = labels.copy()
        for column in (0, 1):
            np.minimum.at(labels, edges[:, column], least)
        labels = labels[labels]
        if np.array_equal(before, labels):
            break
    of_image = np.repeat(np.arange(len(images)), np.diff(starts))
    is_matched = np.zeros(len(labels), bool)
    is_matched[edges.ravel()] = True
    keys, counts = np.unique(labels * len(images) + of_image, return_counts=True)
    is_matched &= ~np.isin(labels, keys[counts > 1] // len(images))
    tracks = np.full(len(labels), -1)
    tracks[is_matched] = np.unique(labels[is_matched], return_inverse=True)[1]
    return np.split(tracks, starts[1:-1])
