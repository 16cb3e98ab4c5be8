"""A query image made ready: of the size at which the map can be asked, with its features when they
are first wanted.

Key points have sizes in pixels, and those of a picture with far more pixels a radian than the map's
pictures had are mostly smaller than any that the map holds: they crowd out the ones that it does. A
long lens and a picture of many megapixels are alike in that. Such a picture is reduced until its
pixels see as much as the map's did; a coarser one stays as it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.errors import QueryError
from topoloc.features.extraction import FeatureConfig, extract_from_normalized, normalize_image
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera, nominal_camera
from topoloc.recordings.frame_checks import find_image_problem
from topoloc.recordings.image_io import to_grey
from topoloc.retrieval.coarse import Image


class StageClock:
    """Adds up the time spent in named stages; `total` is the time since it was made."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._times_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self._times_ms[name] = (
                self._times_ms.get(name, 0.0) + (time.perf_counter() - start) * 1e3
            )

    def times_ms(self) -> dict[str, float]:
        return self._times_ms | {"total": (time.perf_counter() - self._start) * 1e3}


class SharedFeatures:
    """The features of one picture by its size and their settings, extracted once, whichever of
    several maps asks for them first."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, int, FeatureConfig, Hashable], Features] = {}

    def of(self, query: Query) -> Features:
        """Of the picture as it was reduced for a query."""
        return self.get_or_extract(query, None, query.extract_features)

    def get_or_extract(
        self, query: Query, view: Hashable, extract: Callable[[], Features]
    ) -> Features:
        """Those of a view of that picture, such as the one to its side."""
        key = (query.image.shape[1], query.image.shape[0], query.feature_config, view)
        if key not in self._kept:
            self._kept[key] = extract()
        return self._kept[key]


class StoredFeatures(SharedFeatures):
    """Those of a picture of which nothing else is left, by their kinds, such as a node of another
    map; pixels of `width` columns."""

    def __init__(self, known: Mapping[str, Features], width: int) -> None:
        super().__init__()
        self._known, self._width = known, width

    def of(self, query: Query) -> Features:
        """As they would be in the picture as it was reduced. Raises KeyError where they are of
        other kinds."""
        known, scale = (
            self._known[query.feature_config.kind],
            np.float32(query.image.shape[1] / self._width),
        )
        return replace(
            known,
            points_img=(known.points_img + np.float32(0.5)) * scale - np.float32(0.5),
            sizes_px=known.sizes_px * scale,
        )


@dataclass(frozen=True, eq=False)
class QueryImage:
    """A picture with what is known of its camera, to be asked of one map or of several. Raises as
    `check_image_size`."""

    image: Image
    camera: Camera | UncalibratedCamera
    features: SharedFeatures = field(default_factory=SharedFeatures)

    def __post_init__(self) -> None:
        check_image_size(self.image, self.camera)

    @staticmethod
    def of_features(known: Mapping[str, Features], camera: Camera) -> QueryImage:
        """One of which nothing but local features is left, by their kinds. What looks at the
        picture itself (other scales and turns of it, walls, what a network says beside its key
        points) finds nothing in it."""
        return QueryImage(
            np.zeros((camera.height, camera.width), np.uint8),
            camera,
            StoredFeatures(known, camera.width),
        )


@dataclass(frozen=True, eq=False)
class Query:
    """An image with what is known of its camera (`input_camera`), reduced; the image as it came is
    `scale` times as wide.

    `deadline` is the time (of `time.perf_counter`) after which no further hypothesis is sought;
    infinite where there is none.
    """

    image: Image
    input_camera: Camera | UncalibratedCamera
    scale: float
    feature_config: FeatureConfig
    clock: StageClock = field(default_factory=StageClock)
    deadline: float = float("inf")
    shared: SharedFeatures = field(default_factory=SharedFeatures)

    @property
    def camera(self) -> Camera:
        """The calibration; of a camera that is only roughly known, the likeliest."""
        return nominal_camera(self.input_camera)

    @cached_property
    def grey(self) -> UInt8[np.ndarray, "h w"]:
        return to_grey(self.image)

    @cached_property
    def features(self) -> Features:
        """The local features."""
        return self.shared.of(self)

    def extract_features(self) -> Features:
        """Patch normalisation, then the local features."""
        with self.clock.stage("patch_normalization"):
            normalized = normalize_image(self.grey, self.feature_config)
        with self.clock.stage("features"):
            return extract_from_normalized(normalized, self.feature_config)

    @property
    def is_past_deadline(self) -> bool:
        return time.perf_counter() > self.deadline


def check_image_size(image: Image, camera: Camera | UncalibratedCamera) -> None:
    """Raises QueryError where the image is no picture of 8 bits, or the camera is of another image
    size."""
    if problem := find_image_problem(image):
        raise QueryError(problem)
    height, width = image.shape[:2]
    if (camera.width, camera.height) != (width, height):
        raise QueryError(
            f"the image is {width}x{height}, its camera {camera.width}x{camera.height}"
        )


def unknown_camera(image: Image) -> UncalibratedCamera:
    """The camera of a picture of which nothing is known. Raises QueryError where the image is no
    picture of 8 bits."""
    if problem := find_image_problem(image):
        raise QueryError(problem)
    return UncalibratedCamera.unknown(image.shape[1], image.shape[0])


def reduce_image(
    image: Image,
    camera: Camera | UncalibratedCamera,
    map_focal_length: float,
    max_finer: float,
    max_side_px: int,
) -> tuple[np.ndarray, Camera | UncalibratedCamera]:
    """The image with its camera, smaller where it has over `max_finer` times the map's pixels a
    radian, or a longer side.

    Args:
        map_focal: focal length (pixels) of the map's finest camera: its pixels a radian. A rough
            camera counts as finer only as far as its whole range is.
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
