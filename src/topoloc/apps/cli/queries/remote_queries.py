"""Recordings as queries of a map or an atlas, asked here or, in pieces, on the machines of a
cluster: the answers are the same.

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
    EvaluatedTile,
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
from topoloc.apps.cli.features_option import create_localizer, find_available_types
from topoloc.apps.cli.map_or_atlas import atlas_localizer
from topoloc.apps.cli.output import open_recording
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.tasks import JobProgress, OnJobState, run_on_ray
from topoloc.plugin import Progress

MAX_IMAGES = 50
"""Of a piece: a second or so for map and recording to be opened is little beside them."""


@dataclass(frozen=True)
class QueryRecording:
    """A recording, and how it is read: as the options of `topoloc evaluate` say it;
    `is_out_of_map`: of another place than the map."""

    path: str
    format: str | None
    camera: str | None
    topics: str | None
    poses: str | None
    is_out_of_map: bool = False

    def open(self) -> StereoSequence:
        """What is to be known of it is said on standard error. Raises as `open_sequence`;
        UsageError of the poses."""
        reading = PoseConventions.of(self.poses)
        sequence = open_recording(self.path, self.format, self.camera, self.topics)
        return sequence if self.is_out_of_map else with_pose_conventions(sequence, reading)


@dataclass(frozen=True, eq=False)
class OpenQueries:
    """A recording that is open, by the name that its answers call it; `map_from_truth` as of
    `localize_queries`."""

    recording: QueryRecording
    sequence: StereoSequence
    label: str
    map_from_truth: Rigid3 | None

    @property
    def stage(self) -> str:
        """What progress calls it."""
        return f"{self.label} (elsewhere)" if self.recording.is_out_of_map else self.label

    @property
    def frames(self) -> list[int]:
        """Which of its frames are asked. Raises TrajectoryError where none has a pose to judge
        against."""
        return (
            list(range(len(self.sequence)))
            if self.recording.is_out_of_map
            else find_frames_with_truth(self.sequence)
        )

    def answers(
        self,
        queried_map: Localizer | EvaluatedTile,
        progress: Progress,
        frames: Sequence[int] | None = None,
    ) -> list[EvaluatedQuery]:
        """As of `localize_queries` and `localize_out_of_map`; of these frames, or of all."""
        if self.recording.is_out_of_map:
            return localize_out_of_map(queried_map, self.sequence, progress, self.label, frames)
        return localize_queries(
            queried_map, self.sequence, self.map_from_truth, progress, self.label, frames
        )


@dataclass(frozen=True)
class RemoteAtlas:
    """An atlas by the manifest that the command read, judged in the world of a tile."""

    where: str
    manifest: bytes
    tile_id: str
    settings: AtlasConfig


@dataclass(frozen=True, eq=False)
class RemoteMap:
    """What is asked, and how. A map is pickled as its path, and is refused where another one lies
    there by then; `kinds` are the features of map or tiles that can be had where the command
    runs."""

    source: TopoMetricMap | RemoteAtlas
    kinds: frozenset[str]
    config: LocalizerConfig
    features: str | None

    @staticmethod
    def of(
        queried_map: Localizer | EvaluatedTile, config: LocalizerConfig, features: str | None
    ) -> RemoteMap:
        """That which the command has opened."""
        if isinstance(queried_map, Localizer):
            return RemoteMap(
                queried_map.topomap,
                find_available_types(queried_map.topomap.kinds),
                config,
                features,
            )
        atlas, settings = queried_map.localizer.atlas, queried_map.localizer.config
        sent = RemoteAtlas(
            atlas.address,
            atlas.manifest.to_bytes(),
            queried_map.tile_id,
            settings,
        )
        return RemoteMap(sent, find_available_types(_feature_types_of(atlas)), config, features)

    def open_map(self, notes: list[str]) -> Localizer | EvaluatedTile:
        """The same here; what is wrong with tiles becomes known by `notes`, while they are asked.

        Raises:
            MapError: there is no such map, or another one.
            MissingExtraError: features can be had here and not there, or the other way round:
                answers would be others.
        """
        if isinstance(self.source, TopoMetricMap):
            self._check_same_features(self.source.kinds)
            return create_localizer(self.source, self.config, self.features)
        sent = self.source
        atlas = Atlas.from_manifest(sent.where, sent.manifest)
        self._check_same_features(_feature_types_of(atlas))
        return EvaluatedTile.of(
            atlas_localizer(atlas, self.config, self.features, sent.settings, notes.append),
            sent.tile_id,
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
    """The answers of a piece, without their pictures; what was wrong with tiles; why there are
    none, where it failed."""

    answers: list[EvaluatedQuery]
    notes: list[str]
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """Some frames of a recording, as a `Job`; `image_names` are their names."""

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
        """Raises RecordingError where the recording is not the one that the command opened, and as
        of `OpenQueries.answers`."""
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
        answers = queries.answers(self.queried_map.open_map(notes), progress, self.frames)
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
    """What these recordings are answered, in their order and that of their frames, by the tasks of
    a cluster.

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
    """Of one recording, of about the same number of pictures each."""
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
    """Tells how many pictures of each recording are answered; of each piece its recording's stage
    and its pictures are given."""
    done = [0] * len(pieces)

    def show(number: int, state: PieceAnswers | JobProgress) -> None:
        stage, count = pieces[number]
        done[number] = state.done if isinstance(state, JobProgress) else count
        same = [k for k, (other, _) in enumerate(pieces) if other == stage]
        progress(stage, sum(done[k] for k in same), sum(pieces[k][1] for k in same))

    return show


def _feature_types_of(atlas: Atlas) -> set[str]:
    return {kind for tile in atlas.manifest.tiles for kind in tile.kinds}
