"""topoloc build SEQ [SEQ ...] MAP; with --ray, SEQ [SEQ ...] ATLAS."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from topoloc import BuildConfig
from topoloc.apps.cli.features_option import BUILD_FEATURES, select_build_features
from topoloc.apps.cli.mapping.map_jobs import MapJob, PoseOptions
from topoloc.apps.cli.mapping.recording_pieces import Pieces, SplitOptions, split_recording
from topoloc.apps.cli.maps.tile_joining import JoinedTiles, join_overlapping_tiles
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Flag,
    Format,
    RayOption,
    Topics,
    UsageError,
    check_outputs,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.settings_file import Settings, read_settings, with_option

if TYPE_CHECKING:
    from topoloc.apps.cluster.tiles import Outcome, TileJob


@dataclass(frozen=True)
class Command:
    """What `topoloc build` takes."""

    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="SEQ [SEQ ...] MAP|ATLAS", help_behavior_hint="(required)"),
    ] = ()
    """One or several recordings of one place, then the map file to write. PATH@0::2 takes every
    second frame of PATH. With --ray each recording becomes a map of its own, a tile of the atlas
    that is named last."""
    trajectory: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(
            metavar="truth|slam|FILE",
            help_behavior_hint="(default: truth where there is one, else slam)",
        ),
    ] = ()
    """Where poses come from: `truth` (the recording's own), `slam`, or a TUM or KITTI file; given
    once for all, or once for each."""
    poses: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="CONVENTION[,CONVENTION]",
            help_behavior_hint="(default: world_from_cam, metres)",
        ),
    ] = None
    """How the poses of truth or FILE are written, where they are not world_from_cam in metres of
    axes right, down, forward: inverse, opengl, flu, frd, unity, unreal, wxyz, transposed, mm, cm,
    feet, scale=FACTOR, body=X,Y,Z,QX,QY,QZ,QW (body_from_cam), shift=SECONDS, clock=FACTOR.
    `unchecked`: they are not held against the pictures."""
    allow_gaps: Flag = False
    """Map a recording of whose frames fewer than half have a pose."""
    format: Format = None
    """The recordings' format: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap,
    rosbag, mcap, zed, video or folder."""
    camera: CameraOption = None
    """Calibration of the recordings instead of their own: camera.json, OpenCV's or Kalibr's YAML,
    SN*.conf, or `fx,fy,cx,cy`."""
    images: Annotated[
        str | None,
        tyro.conf.arg(metavar="FOLDER", help_behavior_hint="(default: images/ beside the model)"),
    ] = None
    """Pictures of a COLMAP model, where SEQ is one."""
    scale: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(
            metavar="METRES|IMAGE_A,IMAGE_B=METRES",
            help_behavior_hint="(distances: may be given several times)",
        ),
    ] = ()
    """A unit of the recordings' own poses, in metres, of models made of pictures alone, which know
    no metre; or a measured distance between the cameras of two pictures."""
    topics: Topics = None
    """Of a bag, which topic is what: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    d_thresh: Annotated[
        float | None,
        tyro.conf.arg(metavar="METRES", help_behavior_hint="(default: by what is seen)"),
    ] = None
    """Metres between nodes (D_thresh of the paper's Eq. 1)."""
    lambda_rot: Annotated[
        float | None,
        tyro.conf.arg(
            name="lambda", metavar="M/RAD", help_behavior_hint="(default: 2 degrees make a node)"
        ),
    ] = None
    """How much turning counts beside metres (lambda of Eq. 1)."""
    features: BUILD_FEATURES = None
    """Local features of the map, and of every query to it. `learned`: of the first network that
    `topoloc weights list` finds; `both`: of SURF, too."""
    ray: RayOption = None
    """A Ray cluster on which each recording is mapped, each by itself: `auto` is the one that runs
    on this machine, `local` one of this machine's processors alone. Called again after it was
    interrupted, it goes on where it was."""
    world: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: each its own)")
    ] = None
    """With --ray, the world that the poses of all recordings are in."""
    replace: Flag = False
    """With --ray, replace a tile of the same id that was made of something else."""
    split: Annotated[
        str | None,
        tyro.conf.arg(metavar="FRAMES[,SHARED]", help_behavior_hint="(default: each whole)"),
    ] = None
    """With --ray, longer recordings are mapped in pieces of so many frames, of one world, that
    share SHARED frames (a tenth)."""
    join: Flag = False
    """With --ray, tiles that overlap are joined, as by `topoloc atlas join`."""
    json: File = None
    """Write the facts of the new map, or of each recording, as JSON (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config build` prints it."""

    def run(self) -> int:
        if self.ray is None and (
            self.world is not None or self.replace or self.join or self.split is not None
        ):
            raise UsageError("--world, --replace, --join and --split belong to --ray")
        split = SplitOptions.of(self.split)
        recordings, target = self._split_paths()
        read = [
            path for path in (*self.trajectory, self.config) if path not in ("truth", "slam", None)
        ]
        check_outputs([str(target) if self.ray is None else None, self.json], inputs=read)
        if any("=" not in text and not _is_positive(text) for text in self.scale):
            raise UsageError(
                "--scale must be a positive number, or IMAGE_A,IMAGE_B=3.2m, not"
                f" {self.scale[0][:80]}"
            )
        settings = read_settings(self.config)
        map_job = self._map_job(recordings, settings)
        return (
            self._make_map(map_job, Path(target))
            if self.ray is None
            else self._make_tiles(map_job, target, settings, split)
        )

    def _map_job(self, recordings: list[str], settings: Settings) -> MapJob:
        config = with_option(
            settings.of(BuildConfig), "nodes.d_thresh", self.d_thresh, "--d-thresh"
        )
        config = with_option(config, "nodes.lambda_rot", self.lambda_rot, "--lambda")
        return MapJob(
            tuple(recordings),
            PoseOptions(self.trajectory, self.poses, self.scale, self.allow_gaps),
            select_build_features(config, self.features),
            self.format,
            self.camera,
            self.images,
            self.topics,
        )

    def _make_map(self, map_job: MapJob, target: Path) -> int:
        with progress_bar() as progress:
            topomap, poses_from = map_job.make(progress)
        topomap.save(target)
        info = topomap.describe(target)
        if self.json != "-":
            size = (
                f"{info['num_nodes']} nodes, {info['num_points']} points,"
                f" {info['bytes'] / 1e6:.2f} MB"
            )
            print(
                f"{target}: {size}, {info['length_m']:.1f} m mapped, poses from"
                f" {' and '.join(sorted(set(poses_from)))}"
            )
        write_json(self.json, info)
        return 0

    def _make_tiles(
        self, map_job: MapJob, atlas: str, settings: Settings, split: SplitOptions | None
    ) -> int:
        """Each recording a tile, on the cluster; status 1 where one could not be mapped."""
        from topoloc.apps.cli.mapping.recordings_table import print_notes, recordings_table
        from topoloc.apps.cluster.atlas_building import AtlasBuild, build_on_ray
        from topoloc.apps.cluster.config import ClusterConfig
        from topoloc.apps.cluster.connection import connect_to_cluster

        assert self.ray is not None
        rows = self._jobs(map_job, split)
        jobs = [job for row in rows for job in row]
        with connect_to_cluster(self.ray):
            with recordings_table([job.recording for job in jobs]) as (show, is_live):
                build = AtlasBuild(jobs, atlas, self.replace, settings.of(ClusterConfig))
                outcomes = build_on_ray(build, self.ray, show, is_live)
            print_notes(outcomes, is_live)
            counts = {
                state: sum(outcome.state == state for outcome in outcomes)
                for state in ("built", "there", "failed")
            }
            if self.json != "-":
                print(
                    f"{atlas}: {counts['built']} recordings mapped, {counts['there']} there"
                    f" already, {counts['failed']} failed"
                )
            joined = self._join_tiles(rows, outcomes, atlas, settings)
        facts = {
            "atlas": atlas,
            **counts,
            "recordings": [outcome.to_json() for outcome in outcomes],
        }
        write_json(self.json, facts | ({} if joined is None else {"tried": joined.rows}))
        not_compared = [] if joined is None else joined.not_compared
        for problem in not_compared:
            print(f"error: {problem}", file=sys.stderr)
        return 1 if counts["failed"] or not_compared else 0

    def _jobs(self, map_job: MapJob, split: SplitOptions | None) -> list[list[TileJob]]:
        """What is to be made of each recording."""
        from topoloc.apps.cluster.tiles import TileJob, derive_tile_ids

        wholes = zip(derive_tile_ids(map_job.recordings), map_job.split_by_recording(), strict=True)
        pieces = [
            Pieces([one]) if split is None else split_recording(one, name, split)
            for name, one in wholes
        ]
        ids = iter(
            derive_tile_ids([piece.recordings[0] for one in pieces for piece in one.piece_jobs])
        )
        return [
            [
                TileJob(
                    piece.recordings[0], name := next(ids), self.world or one.world or name, piece
                )
                for piece in one.piece_jobs
            ]
            for one in pieces
        ]

    def _join_tiles(
        self, rows: list[list[TileJob]], outcomes: list[Outcome], atlas: str, settings: Settings
    ) -> JoinedTiles | None:
        """Pieces of one recording joined with the next one, where it is no matter of course; with
        --join all tiles."""
        there = {
            outcome.recording: outcome.tile_id for outcome in outcomes if outcome.state != "failed"
        }
        pairs = [
            (a, b)
            for row in rows
            for a, b in pairwise(row)
            if a.world != b.world and {a.recording, b.recording} <= there.keys()
        ]
        if not there or not (self.join or pairs):
            return None
        named = None if self.join else [(there[a.recording], there[b.recording]) for a, b in pairs]
        return join_overlapping_tiles(
            atlas, list(there.values()), settings, self.json != "-", named, self.ray
        )

    def _split_paths(self) -> tuple[list[str], str]:
        """The recordings, and the map file or atlas to write: never a recording or a file that is
        none, as where it was forgotten."""
        if len(self.paths) < 2:
            what = "the map file" if self.ray is None else "the atlas"
            raise UsageError(f"build takes at least one recording and, last, {what} to write")
        *recordings, last = self.paths
        if self.ray is not None:
            _check_atlas(last)
            return recordings, last
        target = Path(last)
        if target.is_dir() or (
            not target.exists() and Path(last.rpartition("@")[0] or last).exists()
        ):
            raise UsageError(
                f"the last argument is the map file to write, but {last} is a recording or folder;"
                " was MAP forgotten?"
            )
        if target.is_file() and _read_header(target) not in (b"", b"SQLite"):
            raise UsageError(
                f"the last argument is the map file to write, but {last} is a file of another kind;"
                " was MAP forgotten?"
            )
        return recordings, last


def _check_atlas(last: str) -> None:
    """Hold that an atlas lies there, or may. Raises UsageError."""
    from topoloc import is_atlas

    is_other = (
        os.path.isfile(last)
        or (os.path.isdir(last) and any(os.scandir(last)))
        or ("@" in last and not os.path.exists(last))
    )
    if is_other and not is_atlas(last):
        raise UsageError(
            f"the last argument is the atlas to write, but {last} is none; was ATLAS forgotten?"
        )


def _is_positive(text: str) -> bool:
    try:
        return 0.0 < float(text) < float("inf")
    except ValueError:
        return False


def _read_header(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(6)
