"""topoloc build SEQ [SEQ ...] MAP; with --ray, SEQ [SEQ ...] ATLAS."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from topoloc import BuildConfig, TopoMetricMap, check_map
from topoloc.apps.cli.features_option import BUILD_FEATURES, select_build_features
from topoloc.apps.cli.mapping.map_jobs import (
    MapJob,
    MapPieces,
    PoseOptions,
    SplitOptions,
    split_recording,
)
from topoloc.apps.cli.maps.atlas import JoinedTiles, join_overlapping_tiles
from topoloc.apps.cli.maps.info import format_mapped
from topoloc.apps.cli.maps.level import find_and_move
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Flag,
    Format,
    MaskOption,
    PosesOption,
    RayOption,
    Topics,
    UsageError,
    check_outputs,
    option,
    print_line,
    print_waiting,
    print_warning,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.settings_file import Settings, read_settings, with_option

if TYPE_CHECKING:
    from topoloc.apps.cluster.tiles import Outcome, TileJob

_SOURCES = ("truth", "slam", "photos")  # of poses, beside files


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc build`."""

    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="SEQ [SEQ ...] MAP|ATLAS", help_behavior_hint="(required)"),
    ] = ()
    """Recordings of one place, then the map file to write. PATH@0::2 selects every second frame of
    PATH. With --ray each recording becomes a tile of the atlas that is named last."""
    trajectory: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        option("truth|slam|photos|FILE", "what there is"),
    ] = ()
    """Source of the poses: `truth` (their own), `slam`, a TUM or KITTI file, or `photos` (single
    images in any order). Once for all recordings, or for each."""
    poses: PosesOption = None
    """Conventions of the poses of truth or FILE, if they are not world_from_cam in metres with axes
    right, down, forward: inverse, opengl, flu, frd, unity, unreal, wxyz, transposed, mm, cm, feet,
    scale=FACTOR, body=X,Y,Z,QX,QY,QZ,QW (body_from_cam), shift=SECONDS, clock=FACTOR. `unchecked`:
    do not compare them with the images."""
    allow_gaps: Flag = False
    """Map recordings with poses for under half of the frames."""
    format: Format = None
    camera: CameraOption = None
    mask: MaskOption = None
    images: Annotated[str | None, option("FOLDER", "images/ beside it")] = None
    """Images of a COLMAP model."""
    scale: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(
            metavar="METRES|IMAGE_A,IMAGE_B=METRES|none",
            help_behavior_hint="(repeatable)",
        ),
    ] = ()
    """Metres in a unit of the poses of models without a scale; or a measured distance between the
    cameras of two images. `none`: a map without scale (`topoloc scale`)."""
    tag: Annotated[float | None, option("METRES")] = None
    """Side of printed AprilTags or ArUco markers: the scale of photos."""
    topics: Topics = None
    d_thresh: Annotated[float | None, option("METRES", "from the visible depth")] = None
    """Metres between nodes (D_thresh of the paper's Eq. 1)."""
    lambda_rot: Annotated[
        float | None, option("M/RAD", "a node every 2 degrees", name="lambda")
    ] = None
    """Weight of rotation against translation (lambda of Eq. 1)."""
    look_alike_floors: Flag = False
    """Floors like this one are not mapped: poses need the same colours, those of a stream three
    places with them."""
    level: Flag = False
    """Turn z up and set the floor at z = 0, as `topoloc level`."""
    features: BUILD_FEATURES = None
    """Feature types of the map. `learned`: the first network of `topoloc weights list` that is
    installed. `both`: that and SURF."""
    ray: RayOption = None
    """Ray cluster that maps each recording separately: `auto` is the one on this machine, `local` a
    temporary one of this machine's processors. An interrupted run continues."""
    world: Annotated[str | None, option("NAME", "each its own")] = None
    """With --ray, the common world of all recordings' poses."""
    replace: Flag = False
    """With --ray, replace a tile of the same id."""
    split: Annotated[str | None, option("FRAMES[,SHARED]", "each whole")] = None
    """With --ray, split longer recordings into pieces of FRAMES frames in one world. Successive
    pieces share SHARED frames (default: a tenth)."""
    join: Flag = False
    """With --ray, join overlapping tiles, see `topoloc atlas join`."""
    json: File = None
    """Write the facts of the map or of the recordings as JSON (- for standard output)."""
    config: File = None
    """TOML file with all other settings, see `topoloc config build`."""

    def run(self) -> int:
        is_for_ray = self.world is not None or self.replace or self.join or self.split is not None
        if self.ray is None and is_for_ray:
            raise UsageError("--world, --replace, --join and --split need --ray")
        split = SplitOptions.parse(self.split)
        recordings, target = self._split_paths()
        read = [path for path in (*self.trajectory, self.config) if path not in _SOURCES]
        check_outputs([target if self.ray is None else None, self.json], [*recordings, *read])
        if self.tag is not None and not 0.0 < self.tag < 100.0:
            raise UsageError(f"--tag is the side of a tag in metres, such as 0.16, not {self.tag}")
        if "none" in self.scale and (self.tag, self.d_thresh, len(self.scale)) != (None, None, 1):
            raise UsageError("--scale none goes without --tag, --d-thresh and other --scale")
        if any("=" not in one and one != "none" and not _is_positive(one) for one in self.scale):
            raise UsageError(
                "--scale must be a positive number, or IMAGE_A,IMAGE_B=3.2m, not"
                f" {self.scale[0][:80]}"
            )
        if self.level and (self.ray is not None or "none" in self.scale):
            raise UsageError(
                "--level goes without --ray, as tiles of an atlas keep their worlds, and without"
                " --scale none, as it needs metres"
            )
        settings = read_settings(self.config)
        map_job = self._map_job(recordings, settings)
        if self.ray is not None:
            return self._make_tiles(self.ray, map_job, target, settings, split)
        return self._make_map(map_job, Path(target))

    def _map_job(self, recordings: list[str], settings: Settings) -> MapJob:
        config = settings.get(BuildConfig)
        config = with_option(config, "nodes.d_thresh", self.d_thresh, "--d-thresh")
        config = with_option(config, "nodes.lambda_rot", self.lambda_rot, "--lambda")
        if self.look_alike_floors:
            config = replace(config, look_alike_floors=True)
        return MapJob(
            tuple(recordings),
            PoseOptions(self.trajectory, self.poses, self.scale, self.allow_gaps, self.tag),
            select_build_features(config, self.features),
            self.format,
            self.camera,
            self.images,
            self.topics,
            self.mask,
        )

    def _make_map(self, map_job: MapJob, target: Path) -> int:
        with progress_bar() as progress:
            tell = None if self.json == "-" else print_line
            topomap, poses_from = map_job.make(progress, tell)
        is_replaced = target.is_file()
        topomap.save(target, print_waiting)
        if self.level:
            find_and_move(str(target))
            topomap = TopoMetricMap.load(target)
        if is_replaced:
            print_warning(f"{target} was there; `topoloc undo {target}` brings it back")
        info = topomap.describe(target)
        if info["num_nodes"] == 1:
            print_warning(f"{target}: one node, the camera moved less than --d-thresh")
        if faults := check_map(target):
            num = f"{len(faults)} of {info['num_nodes']} nodes contradict the rest"
            print_warning(
                f"{target}: {num} ({faults[0]}); check poses and calibration, topoloc info --check"
                " lists them"
            )
        if self.json != "-":
            size = f"{info['num_nodes']} nodes, {info['num_points']} points"
            source = " and ".join(sorted(set(poses_from)))
            print(
                f"{target}: {size}, {info['bytes'] / 1e6:.2f} MB, {format_mapped(info)} mapped,"
                f" poses from {source}"
            )
        write_json(self.json, info)
        return 0

    def _make_tiles(
        self, ray: str, map_job: MapJob, atlas: str, settings: Settings, split: SplitOptions | None
    ) -> int:
        """Build a tile from each recording on the cluster. Return 1 if one fails."""
        from topoloc.apps.cli.mapping.recordings_table import (
            print_notes,
            recordings_table,
            report_outcomes,
        )
        from topoloc.apps.cluster.config import ClusterConfig
        from topoloc.apps.cluster.connection import connect_to_cluster
        from topoloc.apps.cluster.tiles import build_on_ray

        rows = self._jobs(map_job, split)
        jobs = [job for row in rows for job in row]
        with connect_to_cluster(ray):
            with recordings_table([job.recording for job in jobs]) as (show, is_live):
                how = (self.replace, settings.get(ClusterConfig), show, is_live)
                outcomes = build_on_ray(jobs, atlas, ray, *how)
            print_notes(outcomes, is_live)
            facts = report_outcomes(atlas, outcomes, {"built": "mapped"}, self.json != "-")
            joined = self._join_tiles(rows, outcomes, atlas, settings)
        write_json(self.json, facts | ({"tried": joined.rows} if joined else {}))
        not_compared = joined.not_compared if joined else []
        for problem in not_compared:
            print_line(f"error: {problem}", sys.stderr)
        return 1 if facts["failed"] or not_compared else 0

    def _jobs(self, map_job: MapJob, split: SplitOptions | None) -> list[list[TileJob]]:
        """Return the jobs of each recording."""
        from topoloc.apps.cluster.tiles import TileJob, derive_tile_ids

        wholes = zip(derive_tile_ids(map_job.recordings), map_job.split_by_recording(), strict=True)
        pieces = [
            MapPieces([one]) if split is None else split_recording(one, name, split)
            for name, one in wholes
        ]
        names = [piece.recordings[0] for one in pieces for piece in one.piece_jobs]
        ids = iter(derive_tile_ids(names))

        def create_job(piece: MapJob, world: str | None) -> TileJob:
            tile_id = next(ids)
            return TileJob(piece.recordings[0], tile_id, self.world or world or tile_id, piece)

        return [[create_job(piece, one.world) for piece in one.piece_jobs] for one in pieces]

    def _join_tiles(
        self, rows: list[list[TileJob]], outcomes: list[Outcome], atlas: str, settings: Settings
    ) -> JoinedTiles | None:
        """Join successive pieces of a recording that have different worlds; with --join all
        tiles."""
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
        """Return the recordings and the output. Raises UsageError if the output is a recording or
        another file, for example because it was forgotten."""
        if len(self.paths) < 2:
            target = "map file" if self.ray is None else "atlas"
            raise UsageError(f"build takes at least one recording and, last, the {target} to write")
        *recordings, last = self.paths
        if self.ray is not None:
            _check_atlas(last)
            return recordings, last
        target, kind = Path(last), None
        whole = Path(last.rpartition("@")[0] or last)
        if target.is_dir() or (not target.exists() and whole.exists()):
            kind = "a recording or folder"
        elif target.is_file():
            with target.open("rb") as file:
                kind = None if file.read(6) in (b"", b"SQLite") else "a file of another kind"
        if kind is not None:
            raise UsageError(
                f"the last argument is the map file to write, but {last} is {kind}; was MAP"
                " forgotten?"
            )
        return recordings, last


def _check_atlas(last: str) -> None:
    """Raise UsageError if something else than an atlas exists at this path."""
    from topoloc import Atlas, AtlasError

    is_taken = "://" not in last and (
        os.path.isfile(last)
        or (os.path.isdir(last) and any(os.scandir(last)))
        or ("@" in last and not os.path.exists(last))
    )
    try:
        if is_taken:
            Atlas.open(last)
    except AtlasError as error:
        raise UsageError(
            f"the last argument is the atlas to write; was ATLAS forgotten? {error}"
        ) from None


def _is_positive(text: str) -> bool:
    try:
        return 0.0 < float(text) < float("inf")
    except ValueError:
        return False
