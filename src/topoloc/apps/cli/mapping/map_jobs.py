"""What becomes of recordings as a map: where their poses come from, how these are written, all
settings; and that map, made.

`topoloc build` makes one of its own recordings, or sends one for each to other machines.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path

from topoloc import (
    BuildConfig,
    PoseConventions,
    RecordingError,
    SkippedChecks,
    StereoSequence,
    TopoMetricMap,
    align_to_trajectory,
    build_map,
    run_slam,
    with_pose_conventions,
    with_trajectory,
)
from topoloc.apps.cli.output import UsageError, open_recording
from topoloc.apps.formats.metric_scale import estimate_metric_scale
from topoloc.plugin import Progress, has_scale, scale_poses, split_selection


@dataclass(frozen=True)
class PoseOptions:
    """Where the poses of recordings come from, one name or one each (none: truth, where all have
    one, else slam), and how they are written: as the options of `topoloc build` say it."""

    trajectory: tuple[str, ...] = ()
    poses: str | None = None
    scale: tuple[str, ...] = ()
    allow_gaps: bool = False

    @property
    def conventions(self) -> list[str]:
        return (self.poses or "").split(",")


@dataclass(frozen=True)
class MapJob:
    """One map of one or several recordings. Nothing in it is open: it may be sent to another
    machine."""

    recordings: tuple[str, ...]
    asked: PoseOptions
    build: BuildConfig
    format: str | None = None
    camera: str | None = None
    images: str | None = None
    topics: str | None = None

    def make(self, progress: Progress) -> tuple[TopoMetricMap, list[str]]:
        """The map, and where the poses of each recording came from; what is to be known of the
        recordings is said on standard error.

        Raises:
            UsageError: the options contradict each other, or the recordings.
            TopolocError: as of `open_sequence`, `run_slam` and `build_map`.
        """
        sequences, poses_from = self._open()
        if poses_from[0] == "slam":
            result = run_slam(sequences, progress)
            sequences = result.apply(sequences)
            apart = result.num_submaps - result.num_joined
            if apart:
                print(
                    f"{apart} of {result.num_submaps} sub-maps see nothing in common with the"
                    " others",
                    file=sys.stderr,
                )
        _report_gaps(sequences)
        skipped_checks = SkippedChecks(
            poses="unchecked" in self.asked.conventions,
            gaps=self.asked.allow_gaps or poses_from[0] == "slam",
        )
        return build_map(sequences, self.build, progress, poses_from, skipped_checks), poses_from

    def split_by_recording(self) -> list[MapJob]:
        """For each recording the map of that one alone. Raises UsageError where there are neither
        one nor as many trajectories."""
        given = self.asked.trajectory
        if len(given) not in (0, 1, len(self.recordings)):
            raise UsageError(f"{len(self.recordings)} recordings but {len(given)} trajectories")
        each = [given] * len(self.recordings) if len(given) < 2 else [(one,) for one in given]
        return [
            replace(self, recordings=(recording,), asked=replace(self.asked, trajectory=trajectory))
            for recording, trajectory in zip(self.recordings, each, strict=True)
        ]

    def digest(self) -> str:
        """Of all that decides what the map looks like, 64 hexadecimal digits: settings, versions,
        and the recordings' files by their names, sizes and times. Raises RecordingError where there
        is no such recording."""
        from topoloc import __version__

        files = [path for text in self.recordings for path in _list_files(split_selection(text)[0])]
        named = (*self.asked.trajectory, self.camera or "", self.images or "")
        files += [
            path
            for text in named
            if text and os.path.exists(text)
            for path in _list_files(Path(text))
        ]
        facts = {
            "settings": asdict(self),
            "versions": [__version__, TopoMetricMap.schema_version],
            "files": sorted(
                (os.path.abspath(path), path.stat().st_size, path.stat().st_mtime_ns)
                for path in files
            ),
        }
        return sha256(
            json.dumps(facts, sort_keys=True).encode("utf-8", "surrogateescape")
        ).hexdigest()

    def _open(self) -> tuple[list[StereoSequence], list[str]]:
        """The recordings with their poses, and where those of each come from; with `slam` they are
        still to be found."""
        sequences = [
            open_recording(path, self.format, self.camera, self.topics, self.images)
            for path in self.recordings
        ]
        trajectories = self.asked.trajectory or (
            "truth" if all(any(sequence.poses) for sequence in sequences) else "slam",
        )
        if len(trajectories) == 1:
            trajectories *= len(self.recordings)
        if len(trajectories) != len(self.recordings):
            raise UsageError(
                f"{len(self.recordings)} recordings but {len(trajectories)} trajectories"
            )
        if "slam" in trajectories:
            if self.asked.poses is not None:
                raise UsageError("--poses says how given poses are written; those of SLAM are ours")
            if set(trajectories) != {"slam"}:
                raise UsageError(
                    "--trajectory slam goes for all recordings or for none: its world is no other's"
                )
            if self.asked.scale:
                raise UsageError(
                    "--scale is that of the recordings' own poses, and slam finds others"
                )
            return sequences, list(trajectories)
        pairs = zip(sequences, trajectories, strict=True)
        return [self._with_poses(sequence, trajectory) for sequence, trajectory in pairs], list(
            trajectories
        )

    def _with_poses(self, sequence: StereoSequence, trajectory: str) -> StereoSequence:
        reading = PoseConventions.of(
            ",".join(name for name in self.asked.conventions if name != "unchecked")
        )
        scale = self.asked.scale
        if trajectory != "truth" and scale:
            raise UsageError(
                "--scale is that of the recordings' own poses, and --trajectory takes others"
            )
        if trajectory != "truth":
            has_metres = has_scale(sequence)
            return (
                with_trajectory(sequence, Path(trajectory), reading)
                if has_metres
                else align_to_trajectory(sequence, Path(trajectory))
            )
        return with_pose_conventions(
            scale_poses(sequence, estimate_metric_scale(scale, sequence)) if scale else sequence,
            reading,
        )


def _report_gaps(sequences: list[StereoSequence]) -> None:
    for sequence in sequences:
        num_without = sum(pose is None for pose in sequence.poses)
        if num_without:
            print(
                f"{sequence.name}: {num_without} of {len(sequence)} frames have no pose and are"
                " left out",
                file=sys.stderr,
            )


def _list_files(path: Path) -> Iterator[Path]:
    """The file, or all files below the folder. Raises RecordingError."""
    if not os.path.exists(path):  # no error of a name that is too long
        raise RecordingError(f"{path}: no such file or folder")
    if path.is_file():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder) / name for name in names if (Path(folder) / name).is_file())
