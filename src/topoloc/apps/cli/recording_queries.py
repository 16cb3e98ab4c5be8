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

from topoloc.apps.cli.features_option import localizer_of
from topoloc.apps.cli.map_or_atlas import atlas_localizer
from topoloc.apps.cli.output import open_recording
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.tasks import Running, Show, run_on_ray
from topoloc.atlas.atlas import Atlas, store_at, whole_address
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.judged_tile import JudgedTile
from topoloc.atlas.manifest import Manifest
from topoloc.errors import MissingExtraError, RecordingError, TopolocError, WeightsError
from topoloc.evaluation.experiments import (
    Asked,
    answer_elsewhere,
    answer_queries,
    frames_with_truth,
    image_reader,
)
from topoloc.evaluation.metrics import Answer
from topoloc.features.kinds import check_available
from topoloc.geometry.pose_conventions import PoseReading
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.mapping.build import Progress
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.trajectory import as_read

MAX_PICTURES = 50
"""Of a piece: a second or so for map and recording to be opened is little beside them."""


@dataclass(frozen=True)
class QueryRecording:
    """A recording, and how it is read: as the options of `topoloc evaluate` say it; `is_elsewhere`:
    of another place than the map."""

    path: str
    format: str | None
    camera: str | None
    topics: str | None
    poses: str | None
    is_elsewhere: bool = False

    def open(self) -> StereoSequence:
        """What is to be known of it is said on standard error. Raises as `open_sequence`;
        UsageError of the poses."""
        reading = PoseReading.of(self.poses)
        sequence = open_recording(self.path, self.format, self.camera, self.topics)
        return sequence if self.is_elsewhere else as_read(sequence, reading)


@dataclass(frozen=True, eq=False)
class Queries:
    """A recording that is open, by the name that its answers call it; `map_from_truth` as of
    `answer_queries`."""

    recording: QueryRecording
    sequence: StereoSequence
    label: str
    map_from_truth: Rigid3 | None

    @property
    def stage(self) -> str:
        """What progress calls it."""
        return f"{self.label} (elsewhere)" if self.recording.is_elsewhere else self.label

    @property
    def frames(self) -> list[int]:
        """Which of its frames are asked. Raises TrajectoryError where none has a pose to judge
        against."""
        return (
            list(range(len(self.sequence)))
            if self.recording.is_elsewhere
            else frames_with_truth(self.sequence)
        )

    def answers(
        self, asked: Asked, progress: Progress, frames: Sequence[int] | None = None
    ) -> list[Answer]:
        """As of `answer_queries` and `answer_elsewhere`; of these frames, or of all."""
        if self.recording.is_elsewhere:
            return answer_elsewhere(asked, self.sequence, progress, self.label, frames)
        return answer_queries(
            asked, self.sequence, self.map_from_truth, progress, self.label, frames
        )


@dataclass(frozen=True)
class SentAtlas:
    """An atlas by the manifest that the command read, judged in the world of a tile."""

    where: str
    manifest: bytes
    tile_id: str
    settings: AtlasConfig


@dataclass(frozen=True, eq=False)
class SentMap:
    """What is asked, and how. A map is pickled as its path, and is refused where another one lies
    there by then; `kinds` are the features of map or tiles that can be had where the command
    runs."""

    source: TopoMetricMap | SentAtlas
    kinds: frozenset[str]
    config: LocalizerConfig
    features: str | None

    @staticmethod
    def of(asked: Asked, config: LocalizerConfig, features: str | None) -> SentMap:
        """That which the command has opened."""
        if isinstance(asked, Localizer):
            return SentMap(asked.topomap, _available(asked.topomap.kinds), config, features)
        atlas, settings = asked.localizer.atlas, asked.localizer.config
        sent = SentAtlas(
            whole_address(atlas.store.where), atlas.manifest.to_bytes(), asked.tile_id, settings
        )
        return SentMap(sent, _available(_kinds_of(atlas)), config, features)

    def opened(self, notes: list[str]) -> Asked:
        """The same here; what is wrong with tiles becomes known by `notes`, while they are asked.

        Raises:
            MapError: there is no such map, or another one.
            MissingExtraError: features can be had here and not there, or the other way round:
                answers would be others.
        """
        if isinstance(self.source, TopoMetricMap):
            self._check_same(self.source.kinds)
            return localizer_of(self.source, self.config, self.features)
        sent = self.source
        atlas = Atlas(store_at(sent.where), Manifest.from_bytes(sent.manifest, sent.where))
        self._check_same(_kinds_of(atlas))
        return JudgedTile.of(
            atlas_localizer(atlas, self.config, self.features, sent.settings, notes.append),
            sent.tile_id,
        )

    def _check_same(self, kinds: Iterable[str]) -> None:
        other = sorted(_available(kinds) ^ self.kinds)
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

    answers: list[Answer]
    notes: list[str]
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """Some frames of a recording, as a `Job`; `pictures` are their names."""

    asked: SentMap
    recording: QueryRecording
    label: str
    map_from_truth: Rigid3 | None
    frames: list[int]
    pictures: list[str]

    @property
    def name(self) -> str:
        return f"evaluate {self.label} {self.frames[0]}-{self.frames[-1]}"

    def run(self, progress: Progress) -> PieceAnswers:
        """Raises RecordingError where the recording is not the one that the command opened, and as
        of `Queries.answers`."""
        notes = list[str]()
        queries = Queries(self.recording, self.recording.open(), self.label, self.map_from_truth)
        names = queries.sequence.names
        if self.pictures != [names[frame] for frame in self.frames if frame < len(names)]:
            raise RecordingError(
                f"{self.recording.path} is another recording on {platform.node()} than where the"
                " command was called"
            )
        answers = queries.answers(self.asked.opened(notes), progress, self.frames)
        return PieceAnswers([replace(answer, read_image=None) for answer in answers], notes)

    def failed(self, reason: str) -> PieceAnswers:
        return PieceAnswers([], [], reason)


def answers_on_ray(
    asked: SentMap,
    recordings: Sequence[Queries],
    address: str,
    config: ClusterConfig,
    progress: Progress,
) -> list[Answer]:
    """What these recordings are answered, in their order and that of their frames, by the tasks of
    a cluster.

    Raises:
        MissingExtraError, ClusterError: as of `connected`.
        TrajectoryError: a recording has no truth.
        TopolocError: a piece failed; its reason is told.
    """
    pieces = [(queries, piece) for queries in recordings for piece in _pieces(asked, queries)]
    show = _shown([(queries.stage, len(piece.frames)) for queries, piece in pieces], progress)
    outcomes = run_on_ray(
        [piece for _, piece in pieces], address, config, show, is_live=sys.stderr.isatty()
    )
    for note in dict.fromkeys(note for outcome in outcomes for note in outcome.notes):
        print(f"warning: {note}", file=sys.stderr)
    answers = list[Answer]()
    for (queries, piece), outcome in zip(pieces, outcomes, strict=True):
        if outcome.reason is not None:
            raise TopolocError(outcome.reason)
        for frame, answer in zip(piece.frames, outcome.answers, strict=True):
            answers.append(replace(answer, read_image=image_reader(queries.sequence, frame)))
    return answers


def _pieces(asked: SentMap, queries: Queries) -> Iterator[Piece]:
    """Of one recording, of about the same number of pictures each."""
    frames, names = queries.frames, queries.sequence.names
    count = -(-len(frames) // MAX_PICTURES)
    for number in range(count):
        some = frames[number * len(frames) // count : (number + 1) * len(frames) // count]
        yield Piece(
            asked,
            queries.recording,
            queries.label,
            queries.map_from_truth,
            some,
            [names[frame] for frame in some],
        )


def _shown(pieces: Sequence[tuple[str, int]], progress: Progress) -> Show[PieceAnswers]:
    """Tells how many pictures of each recording are answered; of each piece its recording's stage
    and its pictures are given."""
    done = [0] * len(pieces)

    def show(number: int, state: PieceAnswers | Running) -> None:
        stage, count = pieces[number]
        done[number] = state.done if isinstance(state, Running) else count
        same = [k for k, (other, _) in enumerate(pieces) if other == stage]
        progress(stage, sum(done[k] for k in same), sum(pieces[k][1] for k in same))

    return show


def _kinds_of(atlas: Atlas) -> set[str]:
    return {kind for tile in atlas.manifest.tiles for kind in tile.kinds}


def _available(kinds: Iterable[str]) -> frozenset[str]:
    """Those that can be had on this machine."""

    def is_here(kind: str) -> bool:
        try:
            check_available(kind)
        except (MissingExtraError, WeightsError):
            return False
        return True

    return frozenset(kind for kind in kinds if is_here(kind))
