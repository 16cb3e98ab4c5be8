"""Localize recordings in a map or an atlas, here or in pieces on a cluster, with equal results.

A piece opens map and recording by their paths on its machine and checks that they are those of the
command. It returns its answers without images.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

from topoloc import (
    Atlas,
    AtlasConfig,
    EvaluatedQuery,
    Image,
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
from topoloc.apps.cli.output import UsageError, open_recording, print_warning
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.remote import Progress
from topoloc.apps.cluster.tasks import JobProgress, OnJobState, run_on_ray
from topoloc.apps.core_names import find_available_types
from topoloc.apps.formats.rig import is_rig, open_instants

MAX_IMAGES = 50
"""Images of a piece. It takes about a second to open map and recording, much less than these."""


@dataclass(frozen=True)
class QueryRecording:
    """A recording and the options of `topoloc evaluate` that read it. `is_out_of_map` is True if it
    shows another place. `label` names it in the results. `map_from_truth` is as in
    `localize_queries`."""

    path: str
    format: str | None = None
    camera: str | None = None
    topics: str | None = None
    poses: str | None = None
    is_out_of_map: bool = False
    map_from_truth: Rigid3 | None = None
    label: str = ""

    @property
    def stage(self) -> str:
        """Return the name for the progress bar."""
        return f"{self.label} (out of map)" if self.is_out_of_map else self.label

    def open(self) -> StereoSequence:
        """Open the recording. Notes about it go to standard error. Raises the errors of
        `open_sequence`; UsageError: the pose convention is unknown."""
        reading = PoseConventions.parse(self.poses)
        how = self.format, self.camera, self.topics
        if self.format == "equirectangular" or (self.format in (None, "rig") and is_rig(self.path)):
            if self.camera or self.topics:
                raise UsageError("the calibrations of rigs are in rig.json: no --camera, --topics")
            panoramas = self.format if self.format == "equirectangular" else None
            sequence = open_instants(self.path, panoramas)
        else:
            sequence = open_recording(self.path, *how, whole_only=True)
        return sequence if self.is_out_of_map else with_pose_conventions(sequence, reading)

    def frames(self, sequence: StereoSequence) -> list[int]:
        """Return the frames to localize. Raises TrajectoryError: no frame has a true pose."""
        is_all = self.is_out_of_map
        return list(range(len(sequence))) if is_all else find_frames_with_truth(sequence)

    def answers(
        self,
        sequence: StereoSequence,
        localizer: Localizer,
        tile_id: str,
        progress: Progress,
        frames: Sequence[int] | None = None,
    ) -> list[EvaluatedQuery]:
        """Localize these frames of the opened recording, or all. See `localize_queries` and
        `localize_out_of_map`."""
        if self.is_out_of_map:
            return localize_out_of_map(localizer, sequence, progress, self.label, frames)
        truth = self.map_from_truth
        return localize_queries(localizer, sequence, truth, progress, self.label, frames, tile_id)


@dataclass(frozen=True, eq=False)
class RemoteMap:
    """A map or an atlas and how it is searched, for another process.

    It is pickled as its path or address. A map that was replaced since is refused. `kinds` are
    the feature types that the command can use. The truth is in the world of the tile `tile_id`.
    """

    source: TopoMetricMap | Atlas
    tile_id: str
    kinds: frozenset[str]
    config: LocalizerConfig
    tiles: AtlasConfig
    features: str | None

    @staticmethod
    def from_localizer(localizer: Localizer, tile_id: str, features: str | None) -> RemoteMap:
        """Return the description of this localizer for another process."""
        source, how = localizer.source, (localizer.config, localizer.tile_config, features)
        return RemoteMap(source, tile_id, frozenset(find_available_types(source.kinds)), *how)

    def open(self, notes: list[str]) -> Localizer:
        """Open the same map or atlas here. `notes` receives the problems of its tiles. Raises
        MapError: there is no such map, or another one; MissingExtraError: another set of feature
        types can be used here, so results would differ."""
        self._check_same_features(self.source.kinds)
        return Localizer(
            self.source, self.config, features=self.features, tiles=self.tiles, warn=notes.append
        )

    def _check_same_features(self, kinds: Iterable[str]) -> None:
        other = sorted(self.kinds.symmetric_difference(find_available_types(kinds)))
        if other:
            lacks = "lacks" if other[0] in self.kinds else "has"
            raise MissingExtraError(
                f"{platform.node()} {lacks} what features {other[0]} need, unlike the machine that"
                " asks it"
            )


@dataclass(frozen=True, eq=False)
class PieceAnswers:
    """The results of a piece without images, the problems of tiles, and the reason of a failure."""

    answers: list[EvaluatedQuery]
    notes: list[str]
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class Piece:
    """A `Job` of some frames of a recording. `image_names` are their names."""

    queried_map: RemoteMap
    recording: QueryRecording
    frames: list[int]
    image_names: list[str]

    @property
    def name(self) -> str:
        return f"evaluate {self.recording.label} {self.frames[0]}-{self.frames[-1]}"

    def run(self, progress: Progress) -> PieceAnswers:
        """Localize the frames. Raises the errors of `QueryRecording.answers`; RecordingError: the
        recording differs from the one that the command opened."""
        notes, sequence = list[str](), self.recording.open()
        names = sequence.names
        if self.image_names != [names[frame] for frame in self.frames if frame < len(names)]:
            raise RecordingError(
                f"{self.recording.path} is another recording on {platform.node()} than where the"
                " command was called"
            )
        where = self.queried_map.open(notes), self.queried_map.tile_id
        answers = self.recording.answers(sequence, *where, progress, self.frames)
        return PieceAnswers([replace(answer, read_image=None) for answer in answers], notes)

    def failure_outcome(self, reason: str) -> PieceAnswers:
        return PieceAnswers([], [], reason)


def localize_on_ray(
    queried_map: RemoteMap,
    recordings: Sequence[tuple[QueryRecording, StereoSequence]],
    address: str,
    config: ClusterConfig,
    progress: Progress,
) -> list[EvaluatedQuery]:
    """Localize opened recordings on a cluster. The results are in the order of recordings and
    frames. Raises MissingExtraError, ClusterError: as of `connect_to_cluster`; TrajectoryError: a
    recording has no truth; TopolocError: a piece failed. The text is its reason."""
    split = [(sequence, _split(queried_map, one, sequence)) for one, sequence in recordings]
    pieces = [(sequence, piece) for sequence, some in split for piece in some]
    jobs = [piece for _, piece in pieces]
    show = _create_progress_callback(jobs, progress)
    outcomes = run_on_ray(jobs, address, config, show, is_live=sys.stderr.isatty())
    for note in dict.fromkeys(note for outcome in outcomes for note in outcome.notes):
        print_warning(note)
    answers = list[EvaluatedQuery]()
    for (sequence, piece), outcome in zip(pieces, outcomes, strict=True):
        if outcome.reason is not None:
            raise TopolocError(outcome.reason)
        for frame, answer in zip(piece.frames, outcome.answers, strict=True):
            answers.append(replace(answer, read_image=partial(_read_image, sequence, frame)))
    return answers


def _read_image(sequence: StereoSequence, index: int) -> Image:
    return sequence[index].image


def _split(
    queried_map: RemoteMap, recording: QueryRecording, sequence: StereoSequence
) -> list[Piece]:
    """Split one recording into pieces of about the same number of images."""
    frames, names = recording.frames(sequence), sequence.names
    count = -(-len(frames) // MAX_IMAGES)
    ends = [number * len(frames) // count for number in range(count + 1)] if count else []
    parts = [frames[start:end] for start, end in pairwise(ends)]
    return [Piece(queried_map, recording, some, [names[k] for k in some]) for some in parts]


def _create_progress_callback(
    pieces: Sequence[Piece], progress: Progress
) -> OnJobState[PieceAnswers]:
    """Return a callback that reports the localized images of each recording."""
    done = [0] * len(pieces)

    def show(number: int, state: PieceAnswers | JobProgress) -> None:
        stage, counts = pieces[number].recording.stage, [len(piece.frames) for piece in pieces]
        done[number] = state.done if isinstance(state, JobProgress) else counts[number]
        same = [k for k, other in enumerate(pieces) if other.recording.stage == stage]
        progress(stage, sum(done[k] for k in same), sum(counts[k] for k in same))

    return show
