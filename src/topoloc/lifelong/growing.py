"""Build a map while its recording is still written: SLAM and node building by pieces.

Each piece shares its first frames with the last one. SLAM gives its motion, and the shared frames
give its place, also backwards to pieces that could not be placed at first. Where the map recognises
the piece's other frames, too, they hold it: this closes loops against the nodes that exist. Frames
that the map does not localize well become nodes, as in `update.py`, of one session. The map file is
whole after every piece.

Existing nodes do not move, so the drift of a long loop stays at the place where it closes
(`max_shift_m`); `build_map` of the whole recording spreads it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from topoloc.errors import EmptyMapError, MapError, RecordingError, TrajectoryError
from topoloc.geometry.alignment import compute_path_lengths
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.json_data import OneLine
from topoloc.lifelong.session_content import create_session_content, update_coarse_models
from topoloc.lifelong.session_poses import (
    SessionPoses,
    align_motion_to_map,
    number_poses,
    select_queried_frames,
)
from topoloc.lifelong.update import add_session
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import carry_over_error_shares, with_map_statistics
from topoloc.localization.result import Localization
from topoloc.mapping import build
from topoloc.mapping.mapping_frames import create_session, select_posed_frames
from topoloc.mapping.storage.map_writing import save_map
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import SequenceView, StereoSequence, sequence_subset
from topoloc.slam.slam import run_slam


@dataclass(frozen=True)
class _Piece:
    """Frames from `first` to `stop`. Those from `before` on are not in another piece before it."""

    first: int
    before: int
    stop: int


@dataclass(frozen=True, repr=False)
class Growth(OneLine):
    """What a piece brought: the frames given and those with a pose, the nodes of the map after it,
    metres mapped in all, and how far (metres) the map moved the piece from where motion alone saw
    it. `num_apart` counts the frames of the last pieces that could not be placed: they join with a
    later piece, once it is recognised."""

    num_frames: int
    num_posed: int
    num_nodes: int
    length_m: float
    shift_m: float
    seconds: float
    num_apart: int


class GrowingMap:
    """A map file that grows by successive frames of a stereo or RGB-D recording. `fault` is why the
    last piece that could not be placed was not.

    Args:
        path: the new map file.
        config: the settings of the map.

    Raises:
        MapError: the file exists.
    """

    def __init__(
        self,
        path: str | Path,
        config: build.BuildConfig | None = None,
        localizer_config: LocalizerConfig | None = None,
    ) -> None:
        self.path = Path(path)
        if self.path.exists():
            raise MapError(f"cannot write map {path}: it exists; `topoloc update` adds to it")
        self._config, self._localizer_config = config or build.BuildConfig(), localizer_config
        self._topomap: TopoMetricMap | None = None
        self._end = 0  # the first frame that was not given yet
        self._apart: list[_Piece] = []  # successive pieces that are not in the map
        self._world_from_cams: dict[int, Rigid3] = {}  # of the last piece, by frame
        self.max_shift_m = 0.0
        self.fault = "no frames"

    def add(self, sequence: StereoSequence, stop: int | None = None) -> Growth:
        """Add the frames of the recording up to `stop` that were not given yet, and write the map.
        The recording may be another object each time, with more frames.

        Raises:
            CalibrationError, UnreadableImageError: from reading the recording.
            MapError: the map cannot be written.
        """
        began, num_shared = time.monotonic(), 12  # frames that a piece shares with the one before
        stop = len(sequence) if stop is None else stop
        before, self._end = self._end, stop
        self._apart.append(_Piece(max(0, before - num_shared), before, stop))
        num_posed, shift, newest = 0, 0.0, self._world_from_cams
        while self._apart:  # the newest piece, then those before it, which share frames with it
            joined = self._join(sequence, self._apart[-1])
            if joined is None:
                break
            self._apart.pop()
            num_posed, shift = num_posed + joined[0], max(shift, joined[1])
            if num_posed == joined[0]:
                newest = self._world_from_cams
        if num_posed:
            self._world_from_cams = newest
            self._apart.clear()  # they share no frame with later pieces
        self.max_shift_m = max(self.max_shift_m, shift)
        num_apart = sum(one.stop - one.before for one in self._apart)
        seconds = time.monotonic() - began
        known = self._topomap
        size = (0, 0.0) if known is None else (len(known.summaries), known.length_m)
        return Growth(stop - before, num_posed, *size, shift, seconds, num_apart)

    def _join(self, sequence: StereoSequence, piece: _Piece) -> tuple[int, float] | None:
        """Add a piece to the map. Return how many of its new frames have a pose, and its shift.
        None if it cannot be placed."""
        frames = sequence_subset(sequence, range(piece.first, piece.stop))
        try:
            posed = run_slam(frames).apply([frames])[0]
            if self._topomap is None:
                built = build.build_node_map(posed, self._config, None, ["slam"])
                self._write(with_map_statistics(built))
                poses, shift = number_poses(posed.poses, piece.first), 0.0
            else:
                poses, shift = self._extend(self._topomap, posed, piece)
        except (RecordingError, TrajectoryError, EmptyMapError) as error:
            self.fault = str(error)  # too dark, or nothing that the map knows
            return None
        self._world_from_cams = poses
        return sum(index >= piece.before for index in poses), shift

    def finish(self) -> TopoMetricMap | None:
        """Measure the statistics of the whole map, write it a last time, and return it. None if no
        piece could be mapped."""
        if self._topomap is not None:
            self._write(with_map_statistics(self._topomap))
        return self._topomap

    def close(self) -> None:
        """Close the map file."""
        if self._topomap is not None:
            self._topomap.close()

    def _extend(
        self, topomap: TopoMetricMap, posed: StereoSequence, piece: _Piece
    ) -> tuple[dict[int, Rigid3], float]:
        """Add a piece. Return the poses of all its frames in the map, and the shift. Raises
        TrajectoryError."""
        session_poses, shift = self._place(topomap, posed, piece.first)
        poses = session_poses.world_from_cams
        new = range(piece.before - piece.first, len(posed))
        view = SequenceView(posed, [*new], [poses.get(index) for index in new])
        own = {k - new.start: one for k, one in session_poses.answers.items() if k in new}
        if any(view.poses):
            self._write(self._with_content(topomap, view, replace(session_poses, answers=own)))
        return {index + piece.first: pose for index, pose in poses.items()}, shift

    def _with_content(
        self, topomap: TopoMetricMap, view: StereoSequence, session_poses: SessionPoses
    ) -> TopoMetricMap:
        """Return the map with the content of these frames, in its one session."""
        *_, session = topomap.sessions
        posed = select_posed_frames(view, session.session_id)
        # The others show what these show, too. Describing an image takes as long as its odometry.
        frames = [one for one in posed if one.index in session_poses.answers or one.index % 3 == 0]
        content = create_session_content(topomap, frames, session_poses, lambda *_: None)
        piece = create_session(view, posed, "slam", session.camera, content.lights)
        changed = add_session(topomap, piece, posed, content)
        changed, _ = update_coarse_models(changed, content.views, content.images)
        changed = replace(changed, sessions=[replace(session, end_ns=piece.end_ns)])
        return carry_over_error_shares(changed, topomap)

    def _place(
        self, topomap: TopoMetricMap, posed: StereoSequence, first: int
    ) -> tuple[SessionPoses, float]:
        """Return the poses of a piece in the map, and how far (metres) the map moves its end from
        where motion alone sees it. Raises TrajectoryError: neither its first frames nor the map
        place it."""
        odom, config = number_poses(posed.poses), topomap.config
        by_motion = self._chain(odom, first)
        localizer = Localizer(topomap, self._localizer_config)
        answers = dict[int, Localization | None]()
        for index in select_queried_frames(odom, config):
            frame, prior = posed[index], None if by_motion is None else by_motion[index]
            result = localizer.localize(frame.image, frame.camera, prior)
            answers[index] = result if isinstance(result, Localization) else None
        if by_motion is not None:
            # Over the way up to its end motion may have drifted.
            lengths = compute_path_lengths(positions_of(by_motion.values()))
            # metres, at least a share of the way, and radians: other places look similar
            reach = max(0.3, 0.05 * (topomap.length_m + lengths[-1])), np.deg2rad(15.0)
            answers = {
                k: one if one and one.world_from_cam.is_same(by_motion[k], *reach) else None
                for k, one in answers.items()
            }
        try:
            aligned = align_motion_to_map(posed.name, odom, answers, config.d_thresh)
        except TrajectoryError:
            if by_motion is None:
                raise
            return SessionPoses(by_motion, answers, []), 0.0
        last = max(aligned.world_from_cams)
        if by_motion is None or last not in by_motion:
            return aligned, 0.0
        apart = aligned.world_from_cams[last].translation - by_motion[last].translation
        return aligned, float(np.linalg.norm(apart))

    def _chain(self, odom: Mapping[int, Rigid3], first: int) -> dict[int, Rigid3] | None:
        """Return the poses of a piece from the known poses of the frames that it shares with the
        last one. None if there are none."""
        shared = [index for index in odom if index + first in self._world_from_cams]
        if not shared:
            return None
        middle = shared[len(shared) // 2]
        world_from_odom = self._world_from_cams[middle + first] @ odom[middle].inverse()
        return {index: world_from_odom @ pose for index, pose in odom.items()}

    def _write(self, topomap: TopoMetricMap) -> None:
        """Write the map, and go on with the file, so that memory does not grow. Raises MapError."""
        save_map(topomap, self.path, is_old_kept=False)
        self.close()
        self._topomap = TopoMetricMap.load(self.path)
