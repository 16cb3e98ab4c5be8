"""Read the frames of a map, extract their features and locate these in 3-D.

A stereo pair or depth image locates its own features. Features of a monocular image are
triangulated with images around it, from their poses. These also observe the features of an image
whose depth is coarser.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, groupby, pairwise
from typing import TypeVar

import cv2

from topoloc.compiled import parallel_map
from topoloc.errors import TrajectoryError
from topoloc.features.extraction import drop_masked, extract_features
from topoloc.features.features import Features
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.config import MapConfig
from topoloc.mapping.storage.entries import (
    Edge,
    Illumination,
    PlaceImage,
    Session,
    average_illumination,
)
from topoloc.node_ids import NodeId
from topoloc.points.metric_points import MetricPoints, keypoint_sigmas, locate_points
from topoloc.points.motion_triangulation import (
    SourceImage,
    select_source_images,
    triangulate_from_motion,
)
from topoloc.recordings.frame import Image, StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import PreparedFrame, prepare_frame
from topoloc.recordings.recording import find_source_path, has_scale, read_left_frame
from topoloc.recordings.stored_images import encode_jpeg

R = TypeVar("R")

# Images locate the points of several nodes around them, so their features are cached.
_MAX_CACHED_IMAGES = 48


@dataclass(frozen=True, eq=False)
class MappingFrame:
    """Hold a frame with a pose that is not read yet."""

    sequence: StereoSequence
    session_id: int
    index: int
    name: str
    t_ns: int
    world_from_cam: Rigid3

    def read(self) -> StereoFrame:
        """Read the frame. Recordings are read by one thread, and videos are fastest in order."""
        return self.sequence[self.index]

    def view(self, with_depth: bool = True) -> PreparedFrame:
        """Read the frame and prepare it for measurements."""
        return prepare_view(self.read(), with_depth)


@dataclass(frozen=True, eq=False)
class MappingImage:
    """Hold the data of a frame without its pixels. Features are by feature type. The pose belongs
    to `camera`, which rectification may have rotated."""

    camera: Camera
    world_from_cam: Rigid3
    features: dict[str, Features]
    place_jpeg: bytes
    light: Illumination


def prepare_view(frame: StereoFrame, with_depth: bool = True) -> PreparedFrame:
    """Prepare a frame for measurements. Monocular images have no depth in any case."""
    is_monocular = frame.right is None and frame.depth is None
    return prepare_frame(frame, with_depth and not is_monocular)


def select_posed_frames(sequence: StereoSequence, session_id: int) -> list[MappingFrame]:
    """Return the frames of a recording that have a pose.

    Raises:
        TrajectoryError: no frame has a pose, or the poses have no metric scale.
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


def create_session(
    sequence: StereoSequence,
    frames: Sequence[MappingFrame],
    poses_from: str,
    camera: Camera | None,
    lights: Sequence[Illumination],
) -> Session:
    """Return the map's record of a recording with these mapping frames and illuminations."""
    t_ns = [frame.t_ns for frame in frames]
    return Session(
        frames[0].session_id,
        sequence.name,
        find_source_path(sequence),
        poses_from,
        min(t_ns),
        max(t_ns),
        camera,
        average_illumination(lights),
    )


def compute_trajectory_length(frames: Sequence[MappingFrame]) -> float:
    """Return the length in metres of the trajectories of all recordings together."""
    steps = ((a, b) for a, b in pairwise(frames) if a.sequence is b.sequence)
    return sum((translation_error(a.world_from_cam, b.world_from_cam) for a, b in steps), 0.0)


def connect_nodes(frames: Sequence[MappingFrame], node_ids: Sequence[NodeId]) -> set[Edge]:
    """Return an edge for each transition of a recording between two nodes."""
    return {
        Edge(source, target)
        for (a, source), (b, target) in pairwise(zip(frames, node_ids, strict=True))
        if a.sequence is b.sequence and source != target
    }


def extract_mapping_image(
    frame: MappingFrame, view: PreparedFrame, config: MapConfig
) -> MappingImage:
    """Extract the features of all types from a frame that has been read."""
    jpeg, light = encode_place_image(view.picture), Illumination.of_image(view.picture)
    features = {
        kind: drop_masked(extract_features(view.grey, config.feature_config_for(kind)), view.camera)
        for kind in config.kinds
    }
    world_from_view = frame.world_from_cam @ view.view_from_cam.inverse()
    return MappingImage(view.camera, world_from_view, features, jpeg, light)


def create_place_image(
    frame: MappingFrame, image: MappingImage, node_id: NodeId, image_id: int | None = None
) -> PlaceImage:
    """Return the map's entry of a mapping image, labelled with its node."""
    of_image = (node_id, image.world_from_cam, image.place_jpeg, frame.session_id, image_id)
    return PlaceImage(frame.sequence.name, frame.name, *of_image)


def encode_place_image(picture: Image, side_px: int = 160) -> bytes:
    """Encode a mapping image for the coarse localizers (section III-B) as JPEG, with its shorter
    side at most `side_px`."""
    return encode_small(picture, side_px, partial(encode_jpeg, quality=60))


def encode_small(picture: Image, side_px: int, encode: Callable[[Image], bytes]) -> bytes:
    """Encode an image with its shorter side at most `side_px`."""
    scale = side_px / min(picture.shape[:2])
    if scale < 1.0:
        # given factors, OpenCV rounds the size but not the factors, which shifts the right side
        size = [round(scale * side) for side in picture.shape[1::-1]]
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return encode(picture)


class PointLocator:
    """Locate the features of mapping frames in 3-D. The last images that may locate those of others
    are cached."""

    MIN_IMAGES = 1
    """Other images that must agree on a feature of a single camera."""

    def __init__(self, frames: Sequence[MappingFrame], config: MapConfig) -> None:
        self._config = config
        sessions = groupby(frames, lambda frame: frame.session_id)
        self._sessions = {number: list(of_it) for number, of_it in sessions}
        self._image_cache: OrderedDict[int, MappingImage] = OrderedDict()

    def map_frames(
        self, work: Callable[[tuple[MappingFrame, StereoFrame]], R], frames: Sequence[MappingFrame]
    ) -> Iterator[R]:
        """Yield the results of work(frame, frame as read) in order. Frames are processed in
        parallel, except those that read further frames."""
        for _, of_session in groupby(frames, lambda frame: frame.session_id):
            read = ((frame, frame.read()) for frame in of_session)
            first = next(read)
            run = parallel_map if prepare_view(first[1]).is_located else map
            yield from run(work, chain([first], read))

    def image(self, frame: MappingFrame, view: PreparedFrame) -> MappingImage:
        """Return the extracted mapping image of a frame, from the cache if possible."""
        if id(frame) not in self._image_cache:
            image = extract_mapping_image(frame, view, self._config)
            if view.is_located:
                return image
            self._image_cache[id(frame)] = image
            if len(self._image_cache) > _MAX_CACHED_IMAGES:
                self._image_cache.popitem(last=False)
        self._image_cache.move_to_end(id(frame))
        return self._image_cache[id(frame)]

    def locate(
        self, frame: MappingFrame, view: PreparedFrame, image: MappingImage
    ) -> tuple[dict[str, MetricPoints], list[MappingFrame]]:
        """Return the positions of a frame's features by type, and the other frames that are needed:
        those used to triangulate them, or, if they have coarse depth, those that are to observe
        them (`image_of`)."""
        others: list[MappingFrame] = []
        if not view.is_located:
            frames = self._sessions[frame.session_id]
            poses = [other.world_from_cam for other in frames]
            others = [frames[k] for k in select_source_images(poses, frames.index(frame))]
        if view.is_located or view.depth is not None:
            of_kind = image.features.items()
            return {kind: locate_points(features, view) for kind, features in of_kind}, others
        images, points = [self.image_of(other) for other in others], {}
        for kind, features in image.features.items():
            source_images = [
                SourceImage(
                    other.features[kind],
                    keypoint_sigmas(other.features[kind]),
                    other.camera,
                    other.world_from_cam.inverse() @ image.world_from_cam,
                )
                for other in images
            ]
            sigmas = keypoint_sigmas(features)
            points[kind] = triangulate_from_motion(
                features, sigmas, image.camera, source_images, min_images=self.MIN_IMAGES
            )
        return points, others

    def image_of(self, frame: MappingFrame) -> MappingImage:
        """Return the mapping image of a frame that locates the features of others, from the cache
        if possible."""
        if id(frame) not in self._image_cache:
            read = read_left_frame(frame.sequence, frame.index)
            return self.image(frame, prepare_view(read, with_depth=False))
        self._image_cache.move_to_end(id(frame))
        return self._image_cache[id(frame)]
