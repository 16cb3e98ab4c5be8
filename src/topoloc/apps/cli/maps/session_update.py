"""What becomes of a recording as a session of a map: how its camera moved, how that is written, all
settings; and the map file, updated.

`topoloc update` does so with a map, with a tile of an atlas, or sends it to other machines.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from topoloc import (
    LocalizerConfig,
    MapUpdate,
    PoseConventions,
    StereoSequence,
    run_slam,
    update,
    with_pose_conventions,
    with_trajectory,
)
from topoloc.apps.cli.output import UsageError, open_recording, print_waiting
from topoloc.plugin import Progress


@dataclass(frozen=True)
class SessionUpdateOptions:
    """A recording that joins a map, by the options of `topoloc update`. Nothing in it is open: it
    may be sent to another machine."""

    recording: str
    localize: LocalizerConfig
    trajectory: str | None = None
    poses: str | None = None
    format: str | None = None
    camera: str | None = None
    topics: str | None = None
    light: str | None = None

    def open_session(self) -> OpenSessionUpdate:
        """Raises RecordingError; what is to be known of the recording is said on standard error."""
        return OpenSessionUpdate(
            self, open_recording(self.recording, self.format, self.camera, self.topics)
        )


class OpenSessionUpdate:
    """A recording that is open, to join one map, or another one after that was replaced by somebody
    else."""

    def __init__(self, options: SessionUpdateOptions, sequence: StereoSequence) -> None:
        self.options, self.sequence = options, sequence
        self._posed_sequence: StereoSequence | None = None

    def join(self, path: Path, progress: Progress) -> MapUpdate:
        """The map file, replaced by one with this session in it; the changes tell its bytes before
        and after.

        Raises:
            UsageError: the options contradict each other.
            TopolocError: as of `update` and `run_slam`.
        """
        one = self.options

        def find_poses(poses_from: str) -> StereoSequence:
            if self._posed_sequence is None:
                self._posed_sequence = self._with_poses(poses_from, progress)
            return self._posed_sequence

        return update(
            path,
            self.sequence,
            one.trajectory,
            find_poses,
            one.localize,
            one.light,
            "unchecked" not in (one.poses or "").split(","),
            progress,
            print_waiting,
        )

    def _with_poses(self, poses_from: str, progress: Progress) -> StereoSequence:
        """The recording with its own motion."""
        if poses_from in ("slam", "map") and self.options.poses is not None:
            raise UsageError(
                "--poses says how given poses are written; those of SLAM and of the map are ours"
            )
        if poses_from == "map":
            return self.sequence
        if poses_from == "slam":
            return run_slam([self.sequence], progress).apply([self.sequence])[0]
        conventions = (self.options.poses or "").split(",")
        reading = PoseConventions.of(",".join(name for name in conventions if name != "unchecked"))
        if poses_from == "truth":
            return with_pose_conventions(self.sequence, reading)
        return with_trajectory(self.sequence, Path(poses_from), reading)


def describe_update(changes: dict[str, Any]) -> str:
    """What a session changed, in one line."""
    c = changes
    seen = (
        f"{c['recording']} joins as session {c['session']}: {c['frames_with_pose']} of"
        f" {c['frames']} frames"
    )
    if c["poses_from"] == "map":
        carried, without = c["frames_by_odometry"], c["frames"] - c["frames_with_pose"]
        seen = (
            f"{seen} ({c['frames_with_pose'] - carried} by the map, {carried} by odometry,"
            f" {without} without a pose)"
        )
    asked = f"{c['localized']} of {c['asked']} pictures asked were recognised"
    added = f"{c['nodes_added']} nodes added"
    return (
        f"{seen}, {asked}, {added}, {c['bytes_before'] / 1e6:.2f} to {c['bytes'] / 1e6:.2f}"
        f" MB{describe_outdated_models(changes)}"
    )


def describe_outdated_models(changes: dict[str, Any]) -> str:
    """Which coarse localizers know nothing of new nodes, and what to do about it."""
    if not changes["not_taught"] or not changes["nodes_added"]:
        return ""
    ways = {"cnn-fc": "`topoloc train --coarse cnn-fc --weights map` teaches it"}
    named = [
        f"{name} knows nothing of them: {ways.get(name, 'PyTorch is missing here')}"
        for name in changes["not_taught"]
    ]
    return "".join(f"; {line}" for line in named)
