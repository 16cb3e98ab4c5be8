"""topoloc update MAP SEQ [SEQ ...]."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc.cli.output import CameraOption, File, Format, Topics, UsageError, check_outputs, open_recording, progress_bar, write_json
from topoloc.cli.settings_file import Settings, read_settings
from topoloc.cli.waiting import say_waiting
from topoloc.geometry.pose_conventions import PoseReading
from topoloc.lifelong.update import UpdateConfig, update_map
from topoloc.localization.localizer import LocalizerConfig
from topoloc.map.edit import editing
from topoloc.map.topomap import TopoMetricMap
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.trajectory import Trajectory, as_read, with_trajectory, write_tum
from topoloc.slam.pose_checks import check_poses
from topoloc.slam.slam import SlamConfig, posed_by_slam


@dataclass(frozen=True)
class Command:
    """What `topoloc update` takes."""

    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="MAP SEQ [SEQ ...]", help_behavior_hint="(required)")
    ] = ()
    """The map file, which is replaced, and recordings of its place, of stereo, RGB-D or a single camera, which join it one after the other.
    PATH@0::2 takes every second frame of PATH."""
    trajectory: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="truth|slam|map|FILE", help_behavior_hint="(default: truth where there is one, slam of stereo or RGB-D, else map)"
        ),
    ] = None
    """How the camera moved: `truth` (the recording's own poses, in any metric world), `slam` (of stereo or RGB-D), or a TUM or KITTI file.
    With `map` the map is asked where each picture was taken, as in a stream, and odometry goes on where it does not know."""
    poses: Annotated[
        str | None, tyro.conf.arg(metavar="CONVENTION[,CONVENTION]", help_behavior_hint="(default: world_from_cam, metres)")
    ] = None
    """How the poses of truth or FILE are written, as in `topoloc build`."""
    format: Format = None
    """The recordings' format: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap, rosbag, mcap, zed, video or folder."""
    camera: CameraOption = None
    """Calibration of the recordings instead of their own: camera.json, OpenCV's or Kalibr's YAML, SN*.conf, or `fx,fy,cx,cy`."""
    topics: Topics = None
    """Of a bag, which topic is what: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    light: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: as its pictures show)")] = None
    """What the recordings' light is called, such as `evening`: sessions of one name count for one light, of two names for two."""
    joined: Annotated[str | None, tyro.conf.arg(metavar="FILE.tum", help_behavior_hint="")] = None
    """Write where the frames of the (one) recording were taken, in the map's world, to this TUM file."""
    json: File = None
    """Write what each session changed to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config update` prints it."""

    def run(self) -> int:
        if len(self.paths) < 2:
            raise UsageError("update takes a map and at least one recording")
        if self.joined and len(self.paths) > 2:
            raise UsageError("--joined takes the frames of one recording")
        if self.light is not None and not self.light.strip():
            raise UsageError("--light is a name, such as evening")
        target, *recordings = self.paths
        check_outputs([self.json, self.joined], inputs=[path for path in (target, self.config) if path])
        settings = read_settings(self.config)
        config = settings.of(UpdateConfig)
        done = []
        for path in recordings:
            sequence = open_recording(path, self.format, self.camera, self.topics)
            with progress_bar() as progress, editing(target, say_waiting) as edit:
                posed, poses_from = self._posed(sequence, settings, progress)
                update = update_map(edit.topomap, posed, poses_from, config, settings.of(LocalizerConfig), progress)
                changes = update.changes | {"bytes_before": edit.path.stat().st_size}
                edit.commit(self._named(update.topomap), f"update {sequence.name}", changes)
            changes["bytes"] = Path(target).stat().st_size
            if self.joined:
                known = [(t_ns, pose) for t_ns, pose in zip(update.sequence.t_ns, update.sequence.poses, strict=True) if pose is not None]
                write_tum(Path(self.joined), Trajectory([pose for _, pose in known], [t_ns for t_ns, _ in known]))
            if self.json != "-":
                print(f"{target}: {describe_update(changes)}")
            done.append(changes)
        write_json(self.json, {"map": target, "updates": done})
        return 0

    def _named(self, topomap: TopoMetricMap) -> TopoMetricMap:
        """The map with the name of its last session's light."""
        *others, last = topomap.sessions
        return topomap if self.light is None else replace(topomap, sessions=[*others, replace(last, light_name=self.light)])

    def _posed(self, sequence: StereoSequence, settings: Settings, progress: Any) -> tuple[StereoSequence, str]:
        """The recording with its own motion, and where that comes from."""
        is_single = (first := sequence[0]).right is None and first.depth is None
        poses_from = self.trajectory or ("truth" if any(sequence.poses) else "map" if is_single else "slam")
        if poses_from in ("slam", "map") and self.poses is not None:
            raise UsageError("--poses says how given poses are written; those of SLAM and of the map are ours")
        if poses_from == "map":
            return sequence, poses_from
        if poses_from == "slam":
            return posed_by_slam([sequence], settings.of(SlamConfig), progress)[0], poses_from
        reading = PoseReading.of(",".join(name for name in (self.poses or "").split(",") if name != "unchecked"))
        posed = as_read(sequence, reading) if poses_from == "truth" else with_trajectory(sequence, Path(poses_from), reading)
        if "unchecked" not in (self.poses or "").split(","):
            check_poses(posed)
        return posed, poses_from


def describe_update(changes: dict[str, Any]) -> str:
    """What a session changed, in one line."""
    c = changes
    seen = f"{c['recording']} joins as session {c['session']}: {c['frames_with_pose']} of {c['frames']} frames"
    if c["poses_from"] == "map":
        carried, without = c["frames_by_odometry"], c["frames"] - c["frames_with_pose"]
        seen = f"{seen} ({c['frames_with_pose'] - carried} by the map, {carried} by odometry, {without} without a pose)"
    asked = f"{c['localized']} of {c['asked']} pictures asked were recognised"
    added = f"{c['nodes_added']} nodes added"
    return f"{seen}, {asked}, {added}, {c['bytes_before'] / 1e6:.2f} to {c['bytes'] / 1e6:.2f} MB{describe_untaught(changes)}"


def describe_untaught(changes: dict[str, Any]) -> str:
    """Which coarse localizers know nothing of new nodes, and what to do about it."""
    if not changes["not_taught"] or not changes["nodes_added"]:
        return ""
    ways = {"cnn-fc": "`topoloc train --coarse cnn-fc --weights map` teaches it"}
    named = [f"{name} knows nothing of them: {ways.get(name, 'PyTorch is missing here')}" for name in changes["not_taught"]]
    return "".join(f"; {line}" for line in named)
