"""topoloc build SEQ [SEQ ...] MAP."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.cli.features_option import BUILD_FEATURES, kinds_to_build
from topoloc.cli.output import (
    CameraOption,
    File,
    Flag,
    Format,
    Topics,
    UsageError,
    check_outputs,
    open_recording,
    progress_bar,
    write_json,
)
from topoloc.cli.settings_file import read_settings, with_option
from topoloc.geometry.pose_conventions import PoseReading
from topoloc.localization.map_facts.building import Trust, build_map
from topoloc.map.build import BuildConfig
from topoloc.map.description import describe_map
from topoloc.sequences.colmap import aligned
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.known_distances import scale_of
from topoloc.sequences.recording import has_scale, scaled
from topoloc.sequences.trajectory import as_read, with_trajectory
from topoloc.slam.slam import SlamConfig, run_slam, with_slam_poses


@dataclass(frozen=True)
class Command:
    """What `topoloc build` takes."""

    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="SEQ [SEQ ...] MAP", help_behavior_hint="(required)")
    ] = ()
    """One or several recordings of one place, then the map file to write. PATH@0::2 takes every second frame of PATH."""
    trajectory: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="truth|slam|FILE", help_behavior_hint="(default: truth where there is one, else slam)"),
    ] = ()
    """Where poses come from: `truth` (the recording's own), `slam`, or a TUM or KITTI file; given once for all, or once for each."""
    poses: Annotated[
        str | None, tyro.conf.arg(metavar="CONVENTION[,CONVENTION]", help_behavior_hint="(default: world_from_cam, metres)")
    ] = None
    """How the poses of truth or FILE are written, where they are not world_from_cam in metres of axes right, down, forward: inverse,
    opengl, flu, frd, unity, unreal, wxyz, transposed, mm, cm, feet, scale=FACTOR, body=X,Y,Z,QX,QY,QZ,QW (body_from_cam), shift=SECONDS,
    clock=FACTOR. `unchecked`: they are not held against the pictures."""
    allow_gaps: Flag = False
    """Map a recording of whose frames fewer than half have a pose."""
    format: Format = None
    """The recordings' format: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap, rosbag, mcap, zed, video or folder."""
    camera: CameraOption = None
    """Calibration of the recordings instead of their own: camera.json, OpenCV's or Kalibr's YAML, SN*.conf, or `fx,fy,cx,cy`."""
    images: Annotated[str | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="(default: images/ beside the model)")] = None
    """Pictures of a COLMAP model, where SEQ is one."""
    scale: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="METRES|IMAGE_A,IMAGE_B=METRES", help_behavior_hint="(distances: may be given several times)"),
    ] = ()
    """A unit of the recordings' own poses, in metres, of models made of pictures alone, which know no metre; or a measured distance between
    the cameras of two pictures."""
    topics: Topics = None
    """Of a bag, which topic is what: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    d_thresh: Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="(default: by what is seen)")] = None
    """Metres between nodes (D_thresh of the paper's Eq. 1)."""
    lambda_rot: Annotated[
        float | None, tyro.conf.arg(name="lambda", metavar="M/RAD", help_behavior_hint="(default: 2 degrees make a node)")
    ] = None
    """How much turning counts beside metres (lambda of Eq. 1)."""
    features: BUILD_FEATURES = None
    """Local features of the map, and of every query to it. `learned`: of the first network that `topoloc weights list` finds;
    `both`: of SURF, too."""
    json: File = None
    """Write what `topoloc info` says of the new map to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config build` prints it."""

    def run(self) -> int:
        recordings, target = self._split_paths()
        read = [path for path in (*self.trajectory, self.config) if path not in ("truth", "slam", None)]
        check_outputs([str(target), self.json], inputs=read)
        if any("=" not in text and not _is_positive(text) for text in self.scale):
            raise UsageError(f"--scale must be a positive number, or IMAGE_A,IMAGE_B=3.2m, not {self.scale[0][:80]}")
        settings = read_settings(self.config)
        config = kinds_to_build(self._with_options(settings.of(BuildConfig)), self.features)
        sequences, poses_from = self._open(recordings)
        with progress_bar() as progress:
            if poses_from[0] == "slam":
                result = run_slam(sequences, settings.of(SlamConfig), progress)
                sequences = with_slam_poses(sequences, result)
                apart = result.num_submaps - result.num_joined
                if apart:
                    print(f"{apart} of {result.num_submaps} sub-maps see nothing in common with the others", file=sys.stderr)
            _report_gaps(sequences)
            trust = Trust(poses="unchecked" in (self.poses or "").split(","), gaps=self.allow_gaps or poses_from[0] == "slam")
            topomap = build_map(sequences, config, progress, poses_from, trust)
        topomap.save(target)
        info = describe_map(topomap, target)
        if self.json != "-":
            size = f"{info['num_nodes']} nodes, {info['num_points']} points, {info['bytes'] / 1e6:.2f} MB"
            print(f"{target}: {size}, {info['length_m']:.1f} m mapped, poses from {' and '.join(sorted(set(poses_from)))}")
        write_json(self.json, info)
        return 0

    def _split_paths(self) -> tuple[list[str], Path]:
        """The recordings, and the map file to write: never a recording or a file that is no map, as where MAP was forgotten."""
        if len(self.paths) < 2:
            raise UsageError("build takes at least one recording and, last, the map file to write")
        *recordings, last = self.paths
        target = Path(last)
        if target.is_dir() or (not target.exists() and Path(last.rpartition("@")[0] or last).exists()):
            raise UsageError(f"the last argument is the map file to write, but {last} is a recording or folder; was MAP forgotten?")
        if target.is_file() and _first_bytes(target) not in (b"", b"SQLite"):
            raise UsageError(f"the last argument is the map file to write, but {last} is a file of another kind; was MAP forgotten?")
        return recordings, target

    def _with_options(self, config: BuildConfig) -> BuildConfig:
        config = with_option(config, "nodes.d_thresh", self.d_thresh, "--d-thresh")
        return with_option(config, "nodes.lambda_rot", self.lambda_rot, "--lambda")

    def _open(self, recordings: list[str]) -> tuple[list[StereoSequence], list[str]]:
        """The recordings with their poses, and where those of each come from; with `slam` they are still to be found."""
        sequences = [open_recording(path, self.format, self.camera, self.topics, self.images) for path in recordings]
        trajectories = self.trajectory or ("truth" if all(any(sequence.poses) for sequence in sequences) else "slam",)
        if len(trajectories) == 1:
            trajectories *= len(recordings)
        if len(trajectories) != len(recordings):
            raise UsageError(f"{len(recordings)} recordings but {len(trajectories)} trajectories")
        if "slam" in trajectories:
            if self.poses is not None:
                raise UsageError("--poses says how given poses are written; those of SLAM are ours")
            if set(trajectories) != {"slam"}:
                raise UsageError("--trajectory slam goes for all recordings or for none: its world is no other's")
            if self.scale:
                raise UsageError("--scale is that of the recordings' own poses, and slam finds others")
            return sequences, list(trajectories)
        pairs = zip(sequences, trajectories, strict=True)
        return [self._with_poses(sequence, trajectory) for sequence, trajectory in pairs], list(trajectories)

    def _with_poses(self, sequence: StereoSequence, trajectory: str) -> StereoSequence:
        reading = PoseReading.of(",".join(name for name in (self.poses or "").split(",") if name != "unchecked"))
        if trajectory != "truth" and self.scale:
            raise UsageError("--scale is that of the recordings' own poses, and --trajectory takes others")
        if trajectory != "truth":
            has_metres = has_scale(sequence)
            return with_trajectory(sequence, Path(trajectory), reading) if has_metres else aligned(sequence, Path(trajectory))
        return as_read(scaled(sequence, scale_of(self.scale, sequence)) if self.scale else sequence, reading)


def _report_gaps(sequences: list[StereoSequence]) -> None:
    for sequence in sequences:
        num_without = sum(pose is None for pose in sequence.poses)
        if num_without:
            print(f"{sequence.name}: {num_without} of {len(sequence)} frames have no pose and are left out", file=sys.stderr)


def _is_positive(text: str) -> bool:
    try:
        return 0.0 < float(text) < float("inf")
    except ValueError:
        return False


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(6)
