"""Localize a stream of images in a map or an atlas. `Tracker.process` is the entry point.

The stream is tracked in one tile (`map_stream.py`); a map is one tile. An atlas is searched until
it names the tile of an image. If the tile gives no pose for a while, the atlas is searched again,
because the camera may have moved to another tile.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.bounds import check_bounds
from topoloc.errors import QueryError
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.localization.localizer import Localizer
from topoloc.localization.query import CameraLike, Deadline, camera_of, check_image_size
from topoloc.localization.result import Localization, NotLocalized, with_time
from topoloc.recordings.frame import find_time_problem
from topoloc.retrieval.coarse import Image
from topoloc.tracking.config import TrackerConfig
from topoloc.tracking.gyroscope import Gyroscope
from topoloc.tracking.map_stream import MapStream
from topoloc.tracking.motion import MotionHypothesis, is_same_place, start_motion
from topoloc.tracking.repeated_images import Repeat, RepeatedImages
from topoloc.tracking.shared_cameras import SharedCameras
from topoloc.tracking.stream_result import StreamedPose

_SEARCH_INTERVAL_NS = 1_000_000_000
"""Time without a pose after which the other tiles are searched, nanoseconds. A failed search takes
as long as a dozen tracked images or more."""
_LOCALIZED_STATES = ("localized", "tracked")


class Tracker:
    """Hold the state of one stream. `reset` starts another one, `close` ends it.

    Args:
        localizer: the map or the atlas. The tracked tile stays open until `close`.
        cameras: estimates the camera of images without calibration. Others may share it.
        gyroscope: predicts rotations between images. It is used once the images confirm it.

    Raises:
        ConfigError: a value of `config` is out of bounds.
    """

    def __init__(
        self,
        localizer: Localizer,
        config: TrackerConfig | None = None,
        cameras: SharedCameras | None = None,
        gyroscope: Gyroscope | None = None,
    ) -> None:
        self.localizer, self.config = localizer, config or TrackerConfig()
        self.gyroscope = gyroscope
        self.cameras = cameras or SharedCameras(localizer)
        check_bounds(self.config)
        self._tile = ExitStack()
        self.reset()

    def reset(self) -> None:
        """Discard the stream."""
        self.close()
        self._t_ns: int | None = None
        self._repeats = RepeatedImages(self.config.simulated)
        self._answer: StreamedPose | None = None
        self._last_search_ns = self._last_localized_ns = -_SEARCH_INTERVAL_NS
        if len(self.localizer.tile_ids) == 1:
            self._enter_tile(None)

    def close(self) -> None:
        """Release the tracked tile."""
        self._tile.close()
        self._stream: MapStream | None = None

    def process(
        self,
        image: Image,
        camera: CameraLike | None,
        t_ns: int,
        odom_from_cam: Rigid3 | None = None,
        max_ms: float | Deadline | None = None,
    ) -> StreamedPose:
        """Localize the next image of the stream. In an atlas each result names its tile, in whose
        world the pose is.

        Args:
            camera: camera model, exact or approximate. None: unknown. An approximate one is
                estimated from the first images of several places, which are localized alone.
            t_ns: capture time, nanoseconds, after the preceding image. It may be equal only for the
                same image.
            odom_from_cam: pose from external odometry, in any fixed frame. Only its change from
                image to image is used. An image that equals the one before confirms its place if
                the odometry stands, too.
            max_ms: limit of all searches for this image, see `Localizer.localize`.

        Raises:
            QueryError: the clock goes backwards, stands still or is not in integer nanoseconds. Or
                the image is not an 8-bit image, or its size differs from the camera's.
            AtlasError: no tile can be read.
            ObjectStoreError: the object store does not respond.
        """
        camera = camera_of(image, camera)
        check_image_size(image, camera)
        is_same = self._repeats.is_same(image)
        self._check_time(t_ns, is_repeat_allowed=is_same)
        limit = Deadline.from_limit(self.localizer.config.max_ms if max_ms is None else max_ms)
        if is_same and self._answer is not None:
            repeat = self._repeats.repeat(t_ns, odom_from_cam)
            if repeat.fault:
                return self._refuse_repeat(repeat, self._answer, t_ns, odom_from_cam)
            # a second look at the same pixels may say more than the stream did, a third may not
            if repeat.number == 2 and self._answer.state != "localized":
                self._answer = self._look_again(self._answer, image, camera, t_ns, limit)
            return self._confirm_repeat(self._answer, t_ns)
        self._repeats.start(image, t_ns, odom_from_cam)
        self._answer = self._process_in_tile(image, camera, t_ns, odom_from_cam, limit)
        if self.gyroscope is not None:
            self.gyroscope.observe(self._answer)
        is_found = self._answer.state in _LOCALIZED_STATES
        self._repeats.learn_noise(t_ns, odom_from_cam, self._answer.smoothed if is_found else None)
        return self._answer

    def expect(
        self,
        world_from_cam: Rigid3,
        covariance: Float[np.ndarray, "6 6"],
        t_ns: int,
        odom_from_cam: Rigid3 | None = None,
    ) -> None:
        """Take a prior: a pose at a time, that of the next image or earlier. It replaces the
        stream so far. The next images are searched for around it first, and it is no result itself.

        Args:
            covariance: that of the left perturbation of `world_from_cam`.
            odom_from_cam: pose from external odometry at this time.
        """
        probability = 0.5  # of a given pose
        if self._stream is None:
            return
        local = inverse_covariance(world_from_cam, covariance)
        state = start_motion(t_ns, world_from_cam, local)
        node_id = self._stream.localizer.topomap.summaries[0].node_id  # means nothing
        pose = Rigid3.identity()
        prior = MotionHypothesis(state, odom_from_cam, state, probability, node_id, pose, None)
        self._stream = MapStream(self._stream.localizer, self.config, prior, self.gyroscope)

    def process_missing(
        self, t_ns: int, result: NotLocalized, odom_from_cam: Rigid3 | None = None
    ) -> StreamedPose:
        """Return the result for an image that could not be read: predicted, if the motion is known.

        Raises:
            QueryError: the clock goes backwards or stands still.
        """
        self._check_time(t_ns)
        self._repeats.forget_image()
        if self._stream is None:
            return StreamedPose(t_ns, "lost", self.localizer.with_provenance(result, None, t_ns))
        return self._stream.process_missing(t_ns, result, odom_from_cam)

    def _refuse_repeat(
        self, repeat: Repeat, answer: StreamedPose, t_ns: int, odom_from_cam: Rigid3 | None
    ) -> StreamedPose:
        """Return the result for an image that equals the one before, and is no evidence."""
        patience = 1.0  # seconds; drivers send single images twice
        refusal = NotLocalized("unreadable", detail=repeat.fault)
        refusal = self.localizer.with_provenance(refusal, None, t_ns)
        if repeat.seconds >= patience:
            return StreamedPose(t_ns, "lost", refusal, is_repeated=True)
        if odom_from_cam is None or self._stream is None:
            return _repeated(answer, t_ns)
        moved = self._stream.process_missing(t_ns, refusal, odom_from_cam)
        return replace(moved, is_repeated=True)

    def _confirm_repeat(self, answer: StreamedPose, t_ns: int) -> StreamedPose:
        """Return the result for an image that shows that the camera stands since the one before."""
        if self._stream is not None:
            self._stream.hold(t_ns, self._repeats.odom_from_cam)
        if answer.state in _LOCALIZED_STATES:
            self._last_localized_ns = t_ns
        return replace(_repeated(answer, t_ns), is_confirmed=True)

    def _look_again(
        self,
        answer: StreamedPose,
        image: Image,
        camera: Camera | UncalibratedCamera,
        t_ns: int,
        limit: Deadline,
    ) -> StreamedPose:
        """Localize an image without the stream before it, because its repeats show that the camera
        stands there. If that is sure, it begins a new stream: the camera was carried."""
        least = 0.95  # probability
        if isinstance(camera, UncalibratedCamera):
            shared = self.cameras.known.get(camera)
            camera = camera if shared is None else shared.camera
        if isinstance(camera, UncalibratedCamera) or self.config.mode == "paper":
            return answer
        stream = None
        if self._stream is not None:
            stream = MapStream(self._stream.localizer, self.config, None, self.gyroscope)
        if stream is None or len(self.localizer.tile_ids) > 1:
            found = self.localizer.localize(image, camera, max_ms=limit, t_ns=t_ns)
            if not isinstance(found, Localization):
                return answer
            if stream is None or found.provenance.tile not in stream.localizer.tile_ids:
                stream = self._enter_tile(found.provenance.tile)
        again = stream.process(image, camera, t_ns, self._repeats.odom_from_cam, limit)
        result, before = again.result, answer.smoothed if answer.state == "tracked" else None
        if not isinstance(result, Localization) or result.probability < least:
            return answer
        if before is not None and not is_same_place(before, result.world_from_cam):
            return answer
        self._stream = stream
        return again

    def _process_in_tile(
        self,
        image: Image,
        camera: Camera | UncalibratedCamera,
        t_ns: int,
        odom_from_cam: Rigid3 | None,
        limit: Deadline,
    ) -> StreamedPose:
        """Process the image in the tracked tile. If it has given no pose for long, search the other
        tiles."""
        if isinstance(camera, UncalibratedCamera):
            if (shared := self.cameras.known.get(camera)) is None:
                return _without_stream(self.cameras.localize(image, camera, t_ns, limit), t_ns)
            camera = shared.camera
        answer = None
        if self._stream is not None:
            answer = self._stream.process(image, camera, t_ns, odom_from_cam, limit)
            if answer.state in _LOCALIZED_STATES:
                self._last_localized_ns = t_ns
            last = max(self._last_localized_ns, self._last_search_ns)
            if len(self.localizer.tile_ids) == 1 or t_ns - last < _SEARCH_INTERVAL_NS:
                return answer
        self._last_search_ns = t_ns
        result = self.localizer.localize(image, camera, max_ms=limit, t_ns=t_ns)
        if not isinstance(result, Localization):
            return answer or _without_stream(result, t_ns)
        self._last_localized_ns = t_ns
        stream = self._enter_tile(result.provenance.tile)
        return stream.process(image, camera, t_ns, odom_from_cam, limit)

    def _enter_tile(self, tile_id: str | None) -> MapStream:
        """Start the stream in this tile. Its map stays open."""
        self.close()
        in_tile = self._tile.enter_context(self.localizer.in_tile(tile_id))
        self._stream = MapStream(in_tile, self.config, None, self.gyroscope)
        return self._stream

    def _check_time(self, t_ns: int, is_repeat_allowed: bool = False) -> None:
        if problem := find_time_problem(t_ns):
            raise QueryError(problem)
        if self._t_ns is not None and (
            t_ns < self._t_ns or (t_ns == self._t_ns and not is_repeat_allowed)
        ):
            problem = "stands still" if t_ns == self._t_ns else "goes backwards"
            raise QueryError(
                f"the clock of the stream {problem}: {t_ns / 1e9:.6f} s comes after"
                f" {self._t_ns / 1e9:.6f} s"
            )
        self._t_ns = t_ns


def _repeated(answer: StreamedPose, t_ns: int) -> StreamedPose:
    """Return the result of an image for one that equals it."""
    return replace(answer, t_ns=t_ns, result=with_time(answer.result, t_ns), is_repeated=True)


def _without_stream(result: Localization | NotLocalized, t_ns: int) -> StreamedPose:
    """Return the result of an image that was localized alone."""
    if isinstance(result, Localization):
        return StreamedPose(t_ns, "localized", result, result.world_from_cam, result.covariance)
    return StreamedPose(t_ns, "ambiguous" if result.reason == "ambiguous" else "lost", result)
