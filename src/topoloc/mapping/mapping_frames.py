"""The frames that a map is made of: read, described, and their features given 3-D positions.

A stereo pair or a depth image locates its features itself. Those of a single picture are located by
the pictures around it, under the poses that all of them have.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, groupby
from typing import TypeVar

import cv2

from topoloc.errors import TrajectoryError
from topoloc.features.extraction import extract_features
from topoloc.features.features import Features
from topoloc.features.parallel import parallel_map
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.config import MapConfig
from topoloc.mapping.sessions import Illumination
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas, locate_points
from topoloc.points.motion_triangulation import (
    SourceImage,
    compute_median_step,
    select_source_images,
    triangulate_from_motion,
)
from topoloc.recordings.frame import Image, StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import PreparedFrame, prepare_frame
from topoloc.recordings.image_io import encode_jpeg
from topoloc.recordings.recording import has_scale, read_left_frame

R = TypeVar("R")

PLACE_JPEG_QUALITY = 60  # of the place images' JPEG
_MAX_CACHED_IMAGES = (
    48  # single pictures locate the points of several nodes; their features are found once
)


@dataclass(frozen=True, eq=False)
class MappingFrame:
    """A frame with a pose, not yet read."""

    sequence: StereoSequence
    session_id: int
    index: int
    name: str
    t_ns: int
    world_from_cam: Rigid3

    def read(self) -> StereoFrame:
        """Recordings are read by one thread, and videos best in their order."""
        return self.sequence[self.index]

    def read_left(self) -> StereoFrame:
        """As `read`, but for the right or depth picture: whoever only describes the frame needs
        none."""
        return read_left_frame(self.sequence, self.index)

    def view(self, with_depth: bool = True) -> PreparedFrame:
        return prepare_view(self.read(), with_depth)


@dataclass(frozen=True, eq=False)
class MappingImage:
    """What the map needs of a frame once its pixels are let go: its features, by their kinds. The
    pose is that of `camera`, which rectification may have turned."""

    camera: Camera
    world_from_cam: Rigid3
    features: dict[str, Features]
    place_jpeg: bytes
    light: Illumination


def prepare_view(frame: StereoFrame, with_depth: bool = True) -> PreparedFrame:
    """A frame that was read, made ready for measuring; a single picture has no depth in any
    case."""
    return prepare_frame(frame, with_depth and not _is_monocular(frame))


def _is_monocular(frame: StereoFrame) -> bool:
    return frame.right is None and frame.depth is None


def select_posed_frames(sequence: StereoSequence, session_id: int) -> list[MappingFrame]:
    """The frames of a recording that have a pose.

    Raises:
        TrajectoryError: none has one, or the poses are of a model without a scale.
    """
    if not has_scale(sequence):
        raise TrajectoryError(
            f"{sequence.name}: a model of pictures alone has no scale; give --scale METRES (a unit"
            " of the model in metres), or --trajectory FILE with metric poses"
        )
    described = enumerate(zip(sequence.names, sequence.t_ns, sequence.poses, strict=True))
    frames = [
        MappingFrame(sequence, session_id, i, name, t_ns, pose)
        for i, (name, t_ns, pose) in described
        if pose is not None
    ]
    if not frames:
        raise TrajectoryError(
            f"{sequence.name}: no frame has a pose; give a trajectory (TUM or KITTI rows) of this"
            " recording"
        )
    return frames


def extract_mapping_image(
    frame: MappingFrame, view: PreparedFrame, config: MapConfig
) -> MappingImage:
    """A frame that has been read, described by all kinds of features."""
    jpeg = encode_thumbnail(view.picture, config.place_side_px, PLACE_JPEG_QUALITY)
    world_from_view = frame.world_from_cam @ view.view_from_cam.inverse()
    features = {
        kind: extract_features(view.grey, config.feature_config_for(kind)) for kind in config.kinds
    }
    return MappingImage(
        view.camera, world_from_view, features, jpeg, Illumination.of_image(view.picture)
    )


def encode_thumbnail(picture: Image, side_px: int, quality: int) -> bytes:
    """The picture as JPEG, its shorter side at most `side_px`."""
    scale = side_px / min(picture.shape[:2])
    if scale < 1.0:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return encode_jpeg(picture, quality)


class PointLocator:
    """Gives the features of mapping frames their 3-D positions; keeps the last pictures that it
    looked at for others."""

    def __init__(self, frames: Sequence[MappingFrame], config: MapConfig) -> None:
        self._config = config
        self._sessions: dict[int, list[MappingFrame]] = {}
        for frame in frames:
            self._sessions.setdefault(frame.session_id, []).append(frame)
        self._steps = {
            number: compute_median_step([frame.world_from_cam for frame in of_it])
            for number, of_it in self._sessions.items()
        }
        self._image_cache: OrderedDict[int, MappingImage] = OrderedDict()

    def map_frames(
        self, work: Callable[[tuple[MappingFrame, StereoFrame]], R], frames: Sequence[MappingFrame]
    ) -> Iterator[R]:
        """What work(frame, as read) gives, in their order; several frames at a time, but for single
        pictures, for which others are read."""
        for _, of_session in groupby(frames, lambda frame: frame.session_id):
            read = ((frame, frame.read()) for frame in of_session)
            first = next(read)
            yield from (map if _is_monocular(first[1]) else parallel_map)(
                work, chain([first], read)
            )

    def image(self, frame: MappingFrame, view: PreparedFrame) -> MappingImage:
        """The frame described, from memory where that is possible."""
        if id(frame) not in self._image_cache:
            image = extract_mapping_image(frame, view, self._config)
            if view.right_grey is not None or view.depth is not None:
                return image
            self._image_cache[id(frame)] = image
            if len(self._image_cache) > _MAX_CACHED_IMAGES:
                self._image_cache.popitem(last=False)
        self._image_cache.move_to_end(id(frame))
        return self._image_cache[id(frame)]

    def locate(
        self, frame: MappingFrame, view: PreparedFrame, image: MappingImage
    ) -> tuple[dict[str, MetricPoints], list[MappingFrame]]:
        """The positions of a frame's features, by their kinds, and the other frames that these
        stand on."""
        if view.right_grey is not None or view.depth is not None:
            return {
                kind: locate_points(features, view, self._config.points)
                for kind, features in image.features.items()
            }, []
        frames = self._sessions[frame.session_id]
        poses = [other.world_from_cam for other in frames]
        chosen = select_source_images(
            poses, frames.index(frame), self._steps[frame.session_id], self._config.motion
        )
        others = [frames[k] for k in chosen]
        images = [self.image(other, other.view()) for other in others]
        points = {}
        for kind, features in image.features.items():
            sigmas = keypoint_sigmas(features, self._config.points)
            source_images = [self._make_source_image(of_other, kind, image) for of_other in images]
            relative = self._config.points.max_relative_sigma
            points[kind] = triangulate_from_motion(
                features, sigmas, image.camera, source_images, relative, self._config.motion
            )
        return points, others

    def _make_source_image(
        self, other: MappingImage, kind: str, image: MappingImage
    ) -> SourceImage:
        sigmas = keypoint_sigmas(other.features[kind], self._config.points)
        return SourceImage(
            other.features[kind],
            sigmas,
            other.camera,
            other.world_from_cam.inverse() @ image.world_from_cam,
        )
