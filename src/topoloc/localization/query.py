"""Prepare a query image: reduce it to the map's resolution and extract its features lazily.

Key points have sizes in pixels. If an image has far more pixels per radian than the map's images,
most of its key points are smaller than any in the map. They displace the key points that would
match. A long focal length and a high pixel count have the same effect. Such an image is reduced to
the map's pixels per radian. A coarser image keeps its size.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.errors import QueryError
from topoloc.features.extraction import (
    FeatureConfig,
    drop_masked,
    extract_from_normalized,
    normalize_image,
)
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera, UncalibratedCamera, nominal_camera
from topoloc.recordings.frame import find_image_problem, to_grey
from topoloc.recordings.image_mask import fill_masked
from topoloc.retrieval.coarse import Image


class StageClock:
    """Accumulate the time spent in named stages. `total` is the time since construction."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._times_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the duration of the context to a named stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._times_ms[name] = (
                self._times_ms.get(name, 0.0) + (time.perf_counter() - start) * 1e3
            )

    def times_ms(self) -> dict[str, float]:
        """Return the milliseconds of each stage, and `total`."""
        return self._times_ms | {"total": (time.perf_counter() - self._start) * 1e3}


@dataclass(frozen=True, eq=False)
class Deadline:
    """The time (`time.perf_counter`, seconds) after which no further hypothesis is tested. Another
    thread may set `stop` before."""

    at: float = float("inf")
    stop: threading.Event = field(default_factory=threading.Event)

    @staticmethod
    def from_limit(limit: float | Deadline | None) -> Deadline:
        """Return the deadline in so many milliseconds, or the given one."""
        if isinstance(limit, Deadline):
            return limit
        return Deadline() if limit is None else Deadline(time.perf_counter() + limit / 1e3)

    @property
    def is_past(self) -> bool:
        """Return whether the time is over or another thread has ended it."""
        return self.stop.is_set() or time.perf_counter() > self.at


class SharedFeatures:
    """Cache the features of one image by image size and settings.

    Several maps share the cache, so each set of features is extracted once.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[int, int, FeatureConfig, Hashable], Features] = {}

    def features_of(self, query: Query) -> Features:
        """Return the features of the image as reduced for this query."""
        return self.get_or_extract(query, None, query.extract_features)

    def get_or_extract(
        self, query: Query, view: Hashable, extract: Callable[[], Features]
    ) -> Features:
        """Return the cached features of a view of the image, or extract them.

        A view is, for example, one that was rotated to the side.
        """
        key = (query.image.shape[1], query.image.shape[0], query.feature_config, view)
        if key not in self._kept:
            self._kept[key] = extract()
        return self._kept[key]


class StoredFeatures(SharedFeatures):
    """Hold features of an image whose pixels are not available, such as a node of another map.

    `known` holds them by feature type. Their pixel coordinates belong to an image of `width`
    columns.
    """

    def __init__(self, known: Mapping[str, Features], width: int) -> None:
        super().__init__()
        self._known, self._width = known, width

    def features_of(self, query: Query) -> Features:
        """Return the features, scaled to the image as reduced for this query.

        Raises:
            KeyError: there are no features of the query's type.
        """
        known = self._known[query.feature_config.kind]
        scale = np.float32(query.image.shape[1] / self._width)
        return replace(
            known,
            points_img=(known.points_img + np.float32(0.5)) * scale - np.float32(0.5),
            sizes_px=known.sizes_px * scale,
        )


@dataclass(frozen=True, eq=False)
class QueryImage:
    """Hold an image and its camera model, to be localized in one map or several. What the camera's
    mask leaves out is filled.

    Raises:
        QueryError: see `check_image_size`.
    """

    image: Image
    camera: Camera | UncalibratedCamera
    features: SharedFeatures = field(default_factory=SharedFeatures)

    def __post_init__(self) -> None:
        check_image_size(self.image, self.camera)
        if self.camera.mask is not None:
            object.__setattr__(self, "image", fill_masked(self.image, self.camera.mask))

    @staticmethod
    def of_features(known: Mapping[str, Features], camera: Camera) -> QueryImage:
        """Return a query image made of local features only, by feature type.

        Its pixels are zero. Steps that read pixels find nothing in it: other scales and rotations,
        virtual views, and dense or global descriptors of a network.
        """
        return QueryImage(
            np.zeros((camera.height, camera.width), np.uint8),
            camera,
            StoredFeatures(known, camera.width),
        )


@dataclass(frozen=True, eq=False)
class Query:
    """Hold a reduced image and its camera model (`input_camera`).

    The original image is `scale` times as wide. No further hypothesis is tested after the
    `deadline`. There is none by default.
    """

    image: Image
    input_camera: Camera | UncalibratedCamera
    scale: float
    feature_config: FeatureConfig
    clock: StageClock = field(default_factory=StageClock)
    deadline: Deadline = field(default_factory=Deadline)
    shared: SharedFeatures = field(default_factory=SharedFeatures)

    @cached_property
    def camera(self) -> Camera:
        """Return the calibrated camera, or the nominal one if the camera is only approximate."""
        return nominal_camera(self.input_camera)

    @cached_property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        """Return the reduced image in grey."""
        return to_grey(self.image)

    @cached_property
    def features(self) -> Features:
        """Return the local features."""
        return self.shared.features_of(self)

    def extract_features(self) -> Features:
        """Normalise patches, then extract the local features."""
        with self.clock.stage("patch_normalization"):
            normalized = normalize_image(self.grey, self.feature_config)
        with self.clock.stage("features"):
            features = extract_from_normalized(normalized, self.feature_config)
            return drop_masked(features, self.input_camera)


def check_image_size(image: Image, camera: Camera | UncalibratedCamera) -> None:
    """Check that the image is an 8-bit image of the camera's size.

    Raises:
        QueryError: it is not.
    """
    if problem := find_image_problem(image):
        raise QueryError(problem)
    height, width = image.shape[:2]
    if (camera.width, camera.height) != (width, height):
        raise QueryError(
            f"the image is {width}x{height}, its camera {camera.width}x{camera.height}"
        )


CameraLike = Camera | UncalibratedCamera | str | Path | Sequence[float] | np.ndarray
"""A camera, K, (fx, fy, cx, cy) in pixels, or the path of a calibration."""


def unknown_camera(image: Image) -> UncalibratedCamera:
    """Return the approximate camera for an image without any calibration. Raises QueryError: the
    image is not an 8-bit image."""
    if problem := find_image_problem(image):
        raise QueryError(problem)
    return UncalibratedCamera.unknown(image.shape[1], image.shape[0])


def camera_of(image: Image, camera: CameraLike | None) -> Camera | UncalibratedCamera:
    """Return the camera of an image. None: unknown.

    Raises:
        QueryError: the image is not an 8-bit image, or the camera is none of `CameraLike`.
        CalibrationError: the calibration cannot be read, or is of another image size.
    """
    if isinstance(camera, Camera | UncalibratedCamera):
        return camera
    unknown = unknown_camera(image)
    if camera is None:
        return unknown
    # these modules read many formats
    from topoloc.recordings.calibration import camera_from_intrinsics, parse_calibration

    if isinstance(camera, str | Path):
        return parse_calibration(camera)(unknown.width, unknown.height).camera
    values = np.asarray(camera, dtype=np.float64)
    if values.shape == (3, 3):
        values = values[[0, 1, 0, 1], [0, 1, 2, 2]]
    if values.shape != (4,):
        raise QueryError(
            "a camera is a topoloc.Camera, a 3x3 matrix K, (fx, fy, cx, cy) in pixels, or the path"
            f" of a calibration, not {type(camera).__name__} of shape {values.shape}"
        )
    fx, fy, cx, cy = values.tolist()
    return camera_from_intrinsics(fx, fy, cx, cy, unknown.width, unknown.height)


def reduce_image(
    image: Image,
    camera: Camera | UncalibratedCamera,
    map_focal_length: float,
    max_finer: float,
    max_side_px: int,
) -> tuple[np.ndarray, Camera | UncalibratedCamera]:
    """Return the image and its camera, reduced if the image is too fine or too large.

    Args:
        map_focal_length: focal length (pixels) of the map's finest camera, which equals its pixels
            per radian.
        max_finer: the image is reduced to `map_focal_length` if its own focal length exceeds
            `max_finer` times this. For an approximate camera the smallest possible focal length
            counts.
        max_side_px: largest width or height of the returned image.
    """
    height, width = image.shape[:2]
    focal = camera.min_focal if isinstance(camera, UncalibratedCamera) else camera.fx
    scale = max_side_px / max(width, height)
    if focal > max_finer * map_focal_length:
        scale = min(scale, map_focal_length / focal)
    if scale >= 1.0:
        return image, camera
    width, height = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), camera.rescaled(
        width, height
    )
