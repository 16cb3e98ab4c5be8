"""Track a stream through the tiles of an atlas.

`TileTracker.process` is the entry point. The atlas is queried until it finds the tile of an image.
The stream is then tracked in that tile's map, as in any map (`tracker.py`). If it finds no pose for
a while, the atlas is queried again, because the camera may have moved to another tile.
"""

from __future__ import annotations

from dataclasses import replace

from topoloc.atlas.atlas_localizer import AtlasLocalizer
from topoloc.atlas.map_cache import CachedMap
from topoloc.errors import QueryError
from topoloc.geometry.camera import Camera
from topoloc.localization.query import check_image_size
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame_checks import find_time_problem
from topoloc.retrieval.coarse import Image
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker, TrackerConfig

_QUERY_INTERVAL_NS = 1_000_000_000
"""Time without a pose after which the atlas is queried again, nanoseconds. A failed query takes as
long as a dozen tracked images or more."""
_LOCALIZED_STATES = ("localized", "tracked")


class TileTracker:
    """Hold the state of one stream. Each result holds its tile, in whose world the pose is.

    Args:
        localizer: the atlas. The tracked tile stays open until `close`.
    """

    def __init__(self, localizer: AtlasLocalizer, config: TrackerConfig | None = None) -> None:
        self.localizer, self.config = localizer, config or TrackerConfig()
        self._tile: tuple[str, CachedMap, Tracker] | None = None
        self._t_ns: int | None = None
        self._last_query_ns = self._last_localized_ns = -_QUERY_INTERVAL_NS

    def process(self, image: Image, camera: Camera, t_ns: int) -> StreamedPose:
        """Localize the next image of the stream.

        Args:
            t_ns: capture time, nanoseconds, not before the preceding image.

        Raises:
            QueryError: see `Tracker.process`.
            AtlasError: no tile can be read.
            ObjectStoreError: the object store does not respond.
        """
        check_image_size(image, camera)
        self._check_time(t_ns)
        answer = (
            None
            if self._tile is None
            else self._add_tile(self._tile[2].process(image, camera, t_ns))
        )
        if answer is not None and answer.state in _LOCALIZED_STATES:
            self._last_localized_ns = t_ns
            return answer
        if (
            t_ns - max(self._last_localized_ns, self._last_query_ns) < _QUERY_INTERVAL_NS
            and answer is not None
        ):
            return answer
        self._last_query_ns = t_ns
        result = self.localizer.localize(image, camera, t_ns=t_ns)
        if not isinstance(result, Localization):
            return answer or StreamedPose(
                t_ns, "ambiguous" if result.reason == "ambiguous" else "lost", result
            )
        assert result.provenance.tile is not None, "an atlas names the tile of its answer"
        return self._start_tile(result.provenance.tile, image, camera, t_ns)

    def process_missing(self, t_ns: int, result: NotLocalized) -> StreamedPose:
        """Return the result for an image that could not be read.

        Raises:
            QueryError: see `Tracker.process_missing`.
        """
        self._check_time(t_ns)
        if self._tile is None:
            return StreamedPose(t_ns, "lost", self.localizer.with_provenance(result, t_ns))
        return self._add_tile(self._tile[2].process_missing(t_ns, result))

    def close(self) -> None:
        """Stop the stream and release the tracked tile."""
        if self._tile is not None:
            self.localizer.release_map(self._tile[1])
        self._tile = None

    def _check_time(self, t_ns: int) -> None:
        if problem := find_time_problem(t_ns):
            raise QueryError(problem)
        if self._t_ns is not None and t_ns < self._t_ns:
            raise QueryError(
                f"the clock of the stream goes backwards: {t_ns / 1e9:.6f} s comes after"
                f" {self._t_ns / 1e9:.6f} s"
            )
        self._t_ns = t_ns

    def _start_tile(self, tile_id: str, image: Image, camera: Camera, t_ns: int) -> StreamedPose:
        """Restart the stream in this tile."""
        self.close()
        opened = self.localizer.acquire_map(tile_id)
        self._tile = tile_id, opened, Tracker(opened.localizer, self.config)
        answer = self._add_tile(self._tile[2].process(image, camera, t_ns))
        self._last_localized_ns = t_ns
        return answer

    def _add_tile(self, answer: StreamedPose) -> StreamedPose:
        assert self._tile is not None
        return replace(answer, result=self.localizer.named(answer.result, self._tile[0]))
