"""Localize recordings in a map or an atlas, here or in pieces on a cluster, with equal results.

A piece opens map and recording by their paths where it is asked, holds that they are those that the
command opened, and sends back its answers, without pictures.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from topoloc import (
    Atlas,
    AtlasConfig,
    EvaluatedQuery,
    Localizer,
    LocalizerConfig,
    MissingExtraError,
    PoseConventions,
    RecordingError,
    Rigid3,
    StereoSequence,
    TopolocError,
    TopoMetricMap,
    find_frames_with_truth,
    localize_out_of_map,
    localize_queries,
    with_pose_conventions,
)
from topoloc.apps.cli.features_option import find_available_types
from topoloc.apps.cli.output import open_recording
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.tasks import JobProgress, OnJobState, run_on_ray
from topoloc.plugin import Progress

MAX_IMAGES = 50
"""Images of a piece. To open map and recording takes about a second, much less than these."""


@dataclass(frozen=True)
class QueryRecording:
    """Hold a recording and the options of `topoloc evaluate` that read it. `is_out_of_map` is True
    if it shows another place."""

    path: str
    format: str | None
    camera: str | None
    topics: str | None
    poses: str | None
    is_out_of_map: bool = False

    def open(self) -> StereoSequence:
        """Open the recording. Notes about it go to standard error. Raises the errors of
        `open_sequence`; UsageError: the pose convention is unknown."""
        reading = PoseConventions.of(self.poses)
        sequence = open_recording(self.path, self.format, self.camera, self.topics)
        return sequence if self.is_out_of_map else with_pose_conventions(sequence, reading)


@dataclass(frozen=True, eq=False)
class OpenQueries:
    """Hold an open recording and its label in the results. `map_from_truth` is as in
    `localize_queries`."""

    recording: QueryRecording
    sequence: StereoSequence
    label: str
    map_from_truth: Rigid3 | None

    @property
    def stage(self) -> str:
        """Return the name for the progress bar."""
        return f"{self.label} (out of map)" if self.recording.is_out_of_map else self.label

    @property
    def frames(self) -> list[int]:
        """Return the frames to localize. Raises TrajectoryError: no frame has a true pose."""
        return (
            list(range(len(self.sequence)))
            if self.recording.is_out_of_map
            else find_frames_with_truth(self.sequence)
        )

    def answers(
        self,
        localizer: Localizer,
        tile_id: str,
        progress: Progress,
        frames: Sequence[int] | None = None,
    ) -> list[EvaluatedQuery]:
        """Localize these frames, or all. See `localize_queries` and `localize_out_of_map`."""
        if self.recording.is_out_of_map:
            return localize_out_of_map(localizer, self.sequence, progress, self.label, frames)
        return localize_queries(
            localizer, self.sequence, self.map_from_truth, progress, self.label, frames, tile_id
        )


@dataclass(frozen=True, eq=False)
class RemoteMap:
    """Hold a map or an atlas and how it is searched, for another process.

    It is pickled as its path or address, and refused if another one lies there by then. `kinds` are
    the feature types that the command can use. The truth is in the world of the tile `tile_id`.
    """

    source: TopoMetricMap | Atlas
    tile_id: str
    kinds: frozenset[str]
    config: LocalizerConfig
    tiles: AtlasConfig
    features: str | None

    @staticmethod
    def of(localizer: Localizer, tile_id: str, features: str | None) -> RemoteMap:
        """Return what another process needs to search as this localizer."""
        return RemoteMap(
            localizer.source,
            tile_id,
            find_available_types(localizer.source.kinds),
            localizer.config,
            localizer.tile_config,
            features,
        )

    def open(self, notes: list[str]) -> Localizer:
        """Open the same map or atlas here. `notes` receives the problems of its tiles.

        Raises:
            MapError: there is no such map, or another one.
            MissingExtraError: another set of feature types can be used here, so results would
                differ.
        """
        self._check_same_features(self.source.kinds)
        return Localizer(
            self.source, self.config, features=self.features, tiles=self.tiles, warn=notes.append
        )

    def _check_same_features(self, kinds: Iterable[str]) -> None:
        other = sorted(find_available_types(kinds) ^ self.kinds)
        if other:
            lacks = "lacks" if other[0] in self.kinds else "has"
            raise MissingExtraError(
                f"{platform.node()} {lacks} what features {other[0]} need, unlike the machine that"
                " asks it"
            )


@dataclass(frozen=True, eq=False)
class PieceAnswers:
    """Hold the results of a piece without images, the problems of tiles, and the reason if the
    piece failed."""

    answers: list[EvaluatedQuery]
    notes: list[str]
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """Hold some frames of a recording as a `Job`. `image_names` are their names."""

    queried_map: RemoteMap
    recording: QueryRecording
    label: str
    map_from_truth: Rigid3 | None
    frames: list[int]
    image_names: list[str]

    @property
    def name(self) -> str:
        return f"evaluate {self.label} {self.frames[0]}-{self.frames[-1]}"

    def run(self, progress: Progress) -> PieceAnswers:
        """Localize the frames. Raises the errors of `OpenQueries.answers`; RecordingError: the
        recording differs from the one that the command opened."""
        notes = list[str]()
        queries = OpenQueries(
            self.recording, self.recording.open(), self.label, self.map_from_truth
        )
        names = queries.sequence.names
        if self.image_names != [names[frame] for frame in self.frames if frame < len(names)]:
            raise RecordingError(
                f"{self.recording.path} is another recording on {platform.node()} than where the"
                " command was called"
            )
        localizer = self.queried_map.open(notes)
        answers = queries.answers(localizer, self.queried_map.tile_id, progress, self.frames)
        return PieceAnswers([replace(answer, read_image=None) for answer in answers], notes)

    def failure_outcome(self, reason: str) -> PieceAnswers:
        return PieceAnswers([], [], reason)


def localize_on_ray(
    queried_map: RemoteMap,
    recordings: Sequence[OpenQueries],
    address: str,
    config: ClusterConfig,
    progress: Progress,
) -> list[EvaluatedQuery]:
    """Localize recordings on a cluster. The results are in the order of recordings and frames.

    Raises:
        MissingExtraError, ClusterError: as of `connect_to_cluster`.
        TrajectoryError: a recording has no truth.
        TopolocError: a piece failed; its reason is told.
    """
    pieces = [
        (queries, piece) for queries in recordings for piece in _split_queries(queried_map, queries)
    ]
    show = _create_progress_callback(
        [(queries.stage, len(piece.frames)) for queries, piece in pieces], progress
    )
    outcomes = run_on_ray(
        [piece for _, piece in pieces], address, config, show, is_live=sys.stderr.isatty()
    )
    for note in dict.fromkeys(note for outcome in outcomes for note in outcome.notes):
        print(f"warning: {note}", file=sys.stderr)
    answers = list[EvaluatedQuery]()
    for (queries, piece), outcome in zip(pieces, outcomes, strict=True):
        if outcome.reason is not None:
            raise TopolocError(outcome.reason)
        for frame, answer in zip(piece.frames, outcome.answers, strict=True):
            answers.append(
                replace(answer, read_image=partial(_read_image, queries.sequence, frame))
            )
    return answers


def _read_image(sequence: StereoSequence, index: int) -> Any:
    return sequence[index].image


def _split_queries(queried_map: RemoteMap, queries: OpenQueries) -> Iterator[Piece]:
    """Split one recording into pieces of about the same number of images."""
    frames, names = queries.frames, queries.sequence.names
    count = -(-len(frames) // MAX_IMAGES)
    for number in range(count):
        some = frames[number * len(frames) // count : (number + 1) * len(frames) // count]
        yield Piece(
            queried_map,
            queries.recording,
            queries.label,
            queries.map_from_truth,
            some,
            [names[frame] for frame in some],
        )


def _create_progress_callback(
    pieces: Sequence[tuple[str, int]], progress: Progress
) -> OnJobState[PieceAnswers]:
    """Return a callback that reports the localized images of each recording. `pieces` holds the
    stage and the number of images of each piece."""
    done = [0] * len(pieces)

    def show(number: int, state: PieceAnswers | JobProgress) -> None:
        stage, count = pieces[number]
        done[number] = state.done if isinstance(state, JobProgress) else count
        same = [k for k, (other, _) in enumerate(pieces) if other == stage]
        progress(stage, sum(done[k] for k in same), sum(pieces[k][1] for k in same))

    return show
