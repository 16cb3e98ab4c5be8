"""topoloc build SEQ [SEQ ...] MAP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.cli.features_option import BUILD_FEATURES, kinds_to_build
from topoloc.cli.info import describe_map
from topoloc.cli.output import Calibration, File, Format, Topics, UsageError, check_outputs, open_recording, progress_bar, write_json
from topoloc.cli.settings_file import read_settings, with_option
from topoloc.errors import RecordingError
from topoloc.localization.map_facts.building import build_map
from topoloc.map.build import BuildConfig, Progress
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.recording import SequenceView
from topoloc.sequences.trajectory import with_trajectory
from topoloc.slam.slam import SlamConfig, run_slam


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
    format: Format = None
    """The recordings' format: kitti, euroc, tum, seven_scenes, rosbag, mcap, zed or folder."""
    topics: Topics = None
    """Of a bag, which topic is what: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    calibration: Calibration = None
    """Of side-by-side video, Stereolabs' SN*.conf."""
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
        settings = read_settings(self.config)
        config = kinds_to_build(self._with_options(settings.of(BuildConfig)), self.features)
        sequences, poses_from = self._open(recordings)
        with progress_bar() as progress:
            if poses_from[0] == "slam":
                sequences = _with_slam(sequences, settings.of(SlamConfig), progress)
            topomap = build_map(sequences, config, progress, poses_from)
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
        sequences = [open_recording(path, self.format, self.topics, self.calibration) for path in recordings]
        trajectories = self.trajectory or ("truth" if all(any(sequence.poses) for sequence in sequences) else "slam",)
        if len(trajectories) == 1:
            trajectories *= len(recordings)
        if len(trajectories) != len(recordings):
            raise UsageError(f"{len(recordings)} recordings but {len(trajectories)} trajectories")
        if "slam" in trajectories:
            if set(trajectories) != {"slam"}:
                raise UsageError("--trajectory slam goes for all recordings or for none: its world is no other's")
            return sequences, list(trajectories)
        pairs = zip(sequences, trajectories, strict=True)
        posed = [sequence if trajectory == "truth" else with_trajectory(sequence, Path(trajectory)) for sequence, trajectory in pairs]
        return posed, list(trajectories)


def _with_slam(sequences: list[StereoSequence], config: SlamConfig, progress: Progress) -> list[StereoSequence]:
    """The recordings with the poses that SLAM finds. Raises RecordingError where one of them shares no place with the others."""
    result = run_slam(sequences, config, progress)
    for sequence, poses in zip(sequences, result.poses, strict=True):
        if not any(poses):
            raise RecordingError(f"{sequence.name}: no place of it was recognised in {sequences[0].name}; map it alone")
    return [SequenceView(sequence, list(range(len(sequence))), poses) for sequence, poses in zip(sequences, result.poses, strict=True)]


def _first_bytes(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(6)
