"""What becomes of a recording as a session of a map: how its camera moved, how that is written, all
settings; and the map file, updated.

`topoloc update` does so with a map, with a tile of an atlas, or sends it to other machines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from topoloc import (
    LocalizerConfig,
    PoseConventions,
    SlamConfig,
    StereoSequence,
    TopoMetricMap,
    UpdateConfig,
    with_pose_conventions,
    with_trajectory,
)
from topoloc.apps.cli.output import UsageError, open_recording
from topoloc.apps.cli.wait_message import print_waiting
from topoloc.lifelong.update import MapUpdate, check_session_is_new, update_map
from topoloc.mapping.edit import edit_map
from topoloc.plugin import Progress
from topoloc.slam.pose_checks import check_poses
from topoloc.slam.slam import estimate_slam_poses


@dataclass(frozen=True)
class SessionUpdateOptions:
    """A recording that joins a map, by the options of `topoloc update`. Nothing in it is open: it
    may be sent to another machine."""

    recording: str
    update: UpdateConfig
    localize: LocalizerConfig
    slam: SlamConfig
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
        self._posed_sequence: tuple[StereoSequence, str] | None = None

    def join(self, path: Path, progress: Progress) -> MapUpdate:
        """The map file, replaced by one with this session in it; the changes tell its bytes before
        and after.

        Raises:
            UsageError: the options contradict each other, or the recording.
            SessionKnownError: it is in the map already.
            TopolocError: as of `update_map`, `edit_map` and `estimate_slam_poses`.
        """
        one = self.options
        with edit_map(path, print_waiting) as edit:
            check_session_is_new(edit.topomap, self.sequence)  # before its motion is found
            posed, poses_from = self._posed_sequence = self._posed_sequence or self._with_poses(
                progress
            )
            update = update_map(edit.topomap, posed, poses_from, one.update, one.localize, progress)
            changes = update.changes | {"bytes_before": edit.path.stat().st_size}
            edit.commit(self._name_light(update.topomap), f"update {self.sequence.name}", changes)
        return replace(update, changes=changes | {"bytes": path.stat().st_size})

    def _name_light(self, topomap: TopoMetricMap) -> TopoMetricMap:
        """The map with the name of its last session's light."""
        *others, last = topomap.sessions
        light = self.options.light
        return (
            topomap
            if light is None
            else replace(topomap, sessions=[*others, replace(last, light_name=light)])
        )

    def _with_poses(self, progress: Progress) -> tuple[StereoSequence, str]:
        """The recording with its own motion, and where that comes from."""
        one, sequence = self.options, self.sequence
        is_single = (first := sequence[0]).right is None and first.depth is None
        poses_from = one.trajectory or (
            "truth" if any(sequence.poses) else "map" if is_single else "slam"
        )
        if poses_from in ("slam", "map") and one.poses is not None:
            raise UsageError(
                "--poses says how given poses are written; those of SLAM and of the map are ours"
            )
        if poses_from == "map":
            return sequence, poses_from
        if poses_from == "slam":
            return estimate_slam_poses([sequence], one.slam, progress)[0], poses_from
        conventions = (one.poses or "").split(",")
        reading = PoseConventions.of(",".join(name for name in conventions if name != "unchecked"))
        posed = (
            with_pose_conventions(sequence, reading)
            if poses_from == "truth"
            else with_trajectory(sequence, Path(poses_from), reading)
        )
        if "unchecked" not in conventions:
            check_poses(posed)
        return posed, poses_from


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
