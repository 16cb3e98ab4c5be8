"""topoloc update MAP|ATLAS SEQ [SEQ ...]."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import (
    AtlasConfig,
    LocalizerConfig,
    SlamConfig,
    TileSelectionConfig,
    Trajectory,
    UpdateConfig,
    is_atlas,
)
from topoloc.apps.cli.maps.session_update import SessionUpdateOptions, describe_update
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Format,
    RayOption,
    Topics,
    UsageError,
    check_outputs,
    progress_bar,
    write_json,
)
from topoloc.apps.cli.settings_file import Settings, read_settings
from topoloc.apps.cluster.config import ClusterConfig


@dataclass(frozen=True)
class Command:
    """What `topoloc update` takes."""

    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="MAP|ATLAS SEQ [SEQ ...]", help_behavior_hint="(required)"),
    ] = ()
    """The map file, which is replaced, and recordings of its place, of stereo, RGB-D or a single
    camera, which join it one after the other. PATH@0::2 takes every second frame of PATH. Of an
    atlas each joins the tile that its pictures are of."""
    trajectory: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="truth|slam|map|FILE",
            help_behavior_hint=(
                "(default: truth where there is one, slam of stereo or RGB-D, else map)"
            ),
        ),
    ] = None
    """How the camera moved: `truth` (the recording's own poses, in any metric world), `slam` (of
    stereo or RGB-D), or a TUM or KITTI file. With `map` the map is asked where each picture was
    taken, as in a stream, and odometry goes on where it does not know."""
    poses: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="CONVENTION[,CONVENTION]",
            help_behavior_hint="(default: world_from_cam, metres)",
        ),
    ] = None
    """How the poses of truth or FILE are written, as in `topoloc build`."""
    format: Format = None
    """The recordings' format: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap,
    rosbag, mcap, zed, video or folder."""
    camera: CameraOption = None
    """Calibration of the recordings instead of their own: camera.json, OpenCV's or Kalibr's YAML,
    SN*.conf, or `fx,fy,cx,cy`."""
    topics: Topics = None
    """Of a bag, which topic is what: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    light: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: as its pictures show)"),
    ] = None
    """What the recordings' light is called, such as `evening`: sessions of one name count for one
    light, of two names for two."""
    joined: Annotated[str | None, tyro.conf.arg(metavar="FILE.tum", help_behavior_hint="")] = None
    """Write where the frames of the (one) recording were taken, in the map's world, to this TUM
    file."""
    tile: Annotated[
        str | None,
        tyro.conf.arg(metavar="ID", help_behavior_hint="(default: as its pictures show)"),
    ] = None
    """Of an atlas, the tile that all recordings join."""
    ray: RayOption = None
    """Of an atlas, a Ray cluster on which recordings of different tiles join them side by side, as
    in `topoloc build`."""
    json: File = None
    """Write what each session changed to this file (- for standard output)."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config update` prints it."""

    def run(self) -> int:
        self._check_usage()
        target, *recordings = self.paths
        check_outputs(
            [self.json, self.joined], inputs=[path for path in (target, self.config) if path]
        )
        settings = read_settings(self.config)
        update_options = [self._session_options(path, settings) for path in recordings]
        return (
            self._update_atlas(target, update_options, settings)
            if is_atlas(target)
            else self._update_map(target, update_options)
        )

    def _session_options(self, path: str, settings: Settings) -> SessionUpdateOptions:
        configs = settings.of(UpdateConfig), settings.of(LocalizerConfig), settings.of(SlamConfig)
        return SessionUpdateOptions(
            path,
            *configs,
            self.trajectory,
            self.poses,
            self.format,
            self.camera,
            self.topics,
            self.light,
        )

    def _update_map(self, target: str, update_options: list[SessionUpdateOptions]) -> int:
        done = []
        for joining in update_options:
            session = joining.open_session()
            with progress_bar() as progress:
                update = session.join(Path(target), progress)
            if self.joined:
                known = [
                    (t_ns, pose)
                    for t_ns, pose in zip(update.sequence.t_ns, update.sequence.poses, strict=True)
                    if pose is not None
                ]
                Trajectory([pose for _, pose in known], [t_ns for t_ns, _ in known]).write_tum(
                    Path(self.joined)
                )
            if self.json != "-":
                print(f"{target}: {describe_update(update.changes)}")
            done.append(update.changes)
        write_json(self.json, {"map": target, "updates": done})
        return 0

    def _update_atlas(
        self, target: str, update_options: list[SessionUpdateOptions], settings: Settings
    ) -> int:
        """Each recording joins the tile that it is of; status 1 where one could not."""
        from topoloc.apps.cli.maps.tile_sessions import AtlasUpdate

        configs = (
            settings.of(AtlasConfig),
            settings.of(TileSelectionConfig),
            settings.of(ClusterConfig),
        )
        outcomes = AtlasUpdate(update_options, target, self.tile, self.ray, *configs).outcomes()
        counts = {
            state: sum(outcome.state == state for outcome in outcomes)
            for state in ("updated", "there", "failed")
        }
        if self.json != "-":
            for outcome in outcomes:
                if outcome.changes is not None:
                    print(f"{target}, tile {outcome.tile_id}: {describe_update(outcome.changes)}")
            print(
                f"{target}: {counts['updated']} recordings joined, {counts['there']} there already,"
                f" {counts['failed']} failed"
            )
        write_json(
            self.json,
            {"atlas": target, **counts, "recordings": [outcome.to_json() for outcome in outcomes]},
        )
        return 1 if counts["failed"] else 0

    def _check_usage(self) -> None:
        if len(self.paths) < 2:
            raise UsageError("update takes a map or an atlas, and at least one recording")
        if self.joined and len(self.paths) > 2:
            raise UsageError("--joined takes the frames of one recording")
        if self.light is not None and not self.light.strip():
            raise UsageError("--light is a name, such as evening")
        if is_atlas(self.paths[0]) and self.joined:
            raise UsageError("--joined is of a map")
        if not is_atlas(self.paths[0]) and (self.tile is not None or self.ray is not None):
            raise UsageError(f"--tile and --ray are of an atlas, and {self.paths[0]} is none")
