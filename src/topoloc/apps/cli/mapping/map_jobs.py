"""Build a map from recordings: the source of their poses, their conventions and all settings.

`topoloc build` builds one map here, or sends one `MapJob` for each recording to other machines.
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
from topoloc.apps.cluster.remote import Progress
from topoloc.apps.formats.metric_scale import estimate_metric_scale
from topoloc.plugin import has_scale, scale_poses, split_selection


@dataclass(frozen=True)
class PoseOptions:
    """Source and conventions of poses, as the options of `topoloc build`.

    `trajectory` has one entry for all recordings or one for each. If it is empty, the truth is used
    if all recordings have one, else SLAM.
    """

    trajectory: tuple[str, ...] = ()
    poses: str | None = None
    scale: tuple[str, ...] = ()
    allow_gaps: bool = False

    @property
    def conventions(self) -> list[str]:
        """The names in `poses`."""
        return (self.poses or "").split(",")


@dataclass(frozen=True)
class MapJob:
    """One map of one or several recordings. It can be pickled."""

    recordings: tuple[str, ...]
    pose_options: PoseOptions
    build: BuildConfig
    format: str | None = None
    camera: str | None = None
    images: str | None = None
    topics: str | None = None

    def make(self, progress: Progress) -> tuple[TopoMetricMap, list[str]]:
        """Return the map and the source of each recording's poses. Warnings go to standard error.

        Raises:
            UsageError: the options contradict each other or the recordings.
            TopolocError: see `open_sequence`, `run_slam` and `build_map`.
        """
        sequences, poses_from = self._open()
        is_slam = poses_from[0] == "slam"
        if is_slam:
            result = run_slam(sequences, progress)
            sequences = result.apply(sequences)
            if apart := result.num_submaps - result.num_joined:
                _warn(f"{apart} of {result.num_submaps} sub-maps share no view with the others")
        for sequence in sequences:
            if num_without := sum(pose is None for pose in sequence.poses):
                count = f"{num_without} of {len(sequence)}"
                _warn(f"{sequence.name}: {count} frames have no pose and are left out")
        skipped_checks = SkippedChecks(
            poses="unchecked" in self.pose_options.conventions,
            gaps=self.pose_options.allow_gaps or is_slam,
        )
        return build_map(sequences, self.build, progress, poses_from, skipped_checks), poses_from

    def split_by_recording(self) -> list[MapJob]:
        """Return one job for each recording. Raises UsageError if the number of trajectories is
        wrong."""
        given = self.pose_options.trajectory
        return [
            replace(
                self,
                recordings=(recording,),
                pose_options=replace(self.pose_options, trajectory=(name,) if given else ()),
            )
            for recording, name in zip(self.recordings, self._for_each(given), strict=True)
        ]

    def digest(self) -> str:
        """Return the digest of settings, versions, and names, sizes and times of all files, 64
        hexadecimal digits. Raises RecordingError if a recording is missing."""
        from topoloc import __version__

        files = [path for text in self.recordings for path in _list_files(split_selection(text)[0])]
        for text in (*self.pose_options.trajectory, self.camera, self.images):
            if text and os.path.exists(text):
                files += _list_files(Path(text))
        facts = {
            "settings": asdict(self),
            "versions": [__version__, TopoMetricMap.schema_version],
            "files": sorted(
                (os.path.abspath(path), path.stat().st_size, path.stat().st_mtime_ns)
                for path in files
            ),
        }
        text = json.dumps(facts, sort_keys=True)
        return sha256(text.encode("utf-8", "surrogateescape")).hexdigest()

    def _for_each(self, trajectories: tuple[str, ...]) -> tuple[str, ...]:
        """Return one trajectory for each recording. Raises UsageError."""
        if len(trajectories) < 2:
            return (trajectories or ("",)) * len(self.recordings)
        if len(trajectories) != len(self.recordings):
            raise UsageError(
                f"{len(self.recordings)} recordings but {len(trajectories)} trajectories"
            )
        return trajectories

    def _open(self) -> tuple[list[StereoSequence], list[str]]:
        """Return the recordings with their poses and the sources of these. With `slam` the poses
        are computed later."""
        sequences = [
            open_recording(path, self.format, self.camera, self.topics, self.images)
            for path in self.recordings
        ]
        has_truth = all(any(sequence.poses) for sequence in sequences)
        default = ("truth" if has_truth else "slam",)
        trajectories = self._for_each(self.pose_options.trajectory or default)
        if "slam" in trajectories:
            if self.pose_options.poses is not None:
                raise UsageError("--poses needs given poses; slam computes its own")
            if set(trajectories) != {"slam"}:
                raise UsageError("--trajectory slam applies to all recordings or to none")
            if self.pose_options.scale:
                raise UsageError("--scale needs the recordings' own poses; slam computes its own")
            return sequences, list(trajectories)
        pairs = zip(sequences, trajectories, strict=True)
        return [self._with_poses(sequence, name) for sequence, name in pairs], list(trajectories)

    def _with_poses(self, sequence: StereoSequence, trajectory: str) -> StereoSequence:
        names = [name for name in self.pose_options.conventions if name != "unchecked"]
        conventions, scale = PoseConventions.of(",".join(names)), self.pose_options.scale
        if trajectory == "truth":
            if scale:
                sequence = scale_poses(sequence, estimate_metric_scale(scale, sequence))
            return with_pose_conventions(sequence, conventions)
        if scale:
            raise UsageError(
                "--scale needs the recordings' own poses, but --trajectory gives others"
            )
        if has_scale(sequence):
            return with_trajectory(sequence, Path(trajectory), conventions)
        return align_to_trajectory(sequence, Path(trajectory))


def _warn(text: str) -> None:
    print(text, file=sys.stderr)


def _list_files(path: Path) -> Iterator[Path]:
    """Yield the file, or all files below the folder. Raises RecordingError."""
    if not os.path.exists(path):  # no error for a name that is too long
        raise RecordingError(f"{path}: no such file or folder")
    if path.is_file():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder) / name for name in names if (Path(folder) / name).is_file())
