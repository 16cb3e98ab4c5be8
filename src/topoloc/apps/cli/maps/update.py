"""topoloc update MAP|ATLAS SEQ [SEQ ...]."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from topoloc import (
    Atlas,
    AtlasConfig,
    LocalizerConfig,
    SingleMap,
    Trajectory,
    open_place,
)
from topoloc.apps.cli.mapping.recordings_table import report_outcomes
from topoloc.apps.cli.maps.session_update import AtlasUpdate, SessionUpdateOptions, describe_update
from topoloc.apps.cli.output import (
    CameraOption,
    File,
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
    progress_bar,
    write_json,
)
from topoloc.apps.cli.settings_file import Settings, read_settings
from topoloc.apps.cli.tile_option import run_for_each_tile
from topoloc.apps.cluster.config import ClusterConfig


@dataclass(frozen=True)
class Command:
    """Options of `topoloc update`."""

    paths: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="MAP|ATLAS SEQ [SEQ ...]", help_behavior_hint="(required)"),
    ] = ()
    """The map file, which is replaced, and recordings of its place (stereo, RGB-D or a single
    camera), which join it one by one. PATH@0::2 takes every second frame of PATH. In an atlas each
    recording joins the tile that its images match."""
    trajectory: Annotated[
        str | None,
        option("truth|slam|map|FILE", "truth if there is one, slam for stereo or RGB-D, else map"),
    ] = None
    """Source of the poses: `truth` (the recording's own, in any metric world), `slam` (stereo or
    RGB-D), or a TUM or KITTI file. `map` localizes each image in the map, as in a stream, and
    bridges gaps by odometry."""
    poses: PosesOption = None
    """Convention of the poses of truth or FILE, as in `topoloc build`."""
    format: Format = None
    camera: CameraOption = None
    mask: MaskOption = None
    topics: Topics = None
    light: Annotated[str | None, option("NAME", "from the images")] = None
    """Name of the illumination, such as `evening`. Sessions of one name have one illumination."""
    look_alike_floors: Annotated[Literal["yes", "no"] | None, option("yes|no", "as it is")] = None
    """Without recordings: whether the building has floors like this one that are not mapped, as in
    `topoloc build`."""
    joined: Annotated[str | None, option("FILE.tum")] = None
    """Write the poses of the (one) recording in the map's world to this TUM file."""
    tile: Annotated[str | None, option("ID", "from the images")] = None
    """The tile of an atlas that all recordings join."""
    ray: RayOption = None
    """The Ray cluster that updates different tiles of an atlas in parallel, as in `topoloc
    build`."""
    json: File = None
    """Write the changes of each session to this file (- for standard output)."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config update`."""

    def run(self) -> int:
        if self.look_alike_floors is not None:
            if len(self.paths) != 1:
                raise UsageError("--look-alike-floors takes one map or atlas, without recordings")
            place, value = open_place(self.paths[0]), self.look_alike_floors == "yes"

            def change(path: Path) -> dict[str, Any]:
                SingleMap(str(path)).set_look_alike_floors(value, print_waiting)
                if self.json != "-":
                    print_line(f"{path.name}: floors {'' if value else 'do not '}look alike")
                return {"look_alike_floors": value}

            return run_for_each_tile(
                place, self.tile, lambda one: place.edit(one, change), self.json
            )
        if len(self.paths) < 2:
            raise UsageError("update takes a map or an atlas, and at least one recording")
        if self.joined and len(self.paths) > 2:
            raise UsageError("--joined takes the frames of one recording")
        if self.light is not None and not self.light.strip():
            raise UsageError("--light is a name, such as evening")
        place = open_place(self.paths[0])
        check_outputs([self.json, self.joined], [*self.paths, self.config, self.mask])
        settings = read_settings(self.config)
        return place.visit(
            lambda path: self._update_map(path, settings),
            lambda atlas: self._update_atlas(atlas, settings),
        )

    def _session_options(self, settings: Settings) -> list[SessionUpdateOptions]:
        read = (self.trajectory, self.poses, self.format, self.camera, self.topics, self.light)
        config, mask = settings.get(LocalizerConfig), self.mask
        return [SessionUpdateOptions(path, config, *read, mask) for path in self.paths[1:]]

    def _update_map(self, target: str, settings: Settings) -> int:
        if self.tile is not None or self.ray is not None:
            raise UsageError(f"--tile and --ray need an atlas, and {target} is a map file")
        done = []
        for options in self._session_options(settings):
            session = options.open_session()
            with progress_bar() as progress:
                sequence, changes = session.join(Path(target), progress)
            if self.joined:
                Trajectory.of_frames(sequence.poses, sequence.t_ns).write_tum(Path(self.joined))
            if self.json != "-":
                print_line(f"{target}: {describe_update(changes)}")
            done.append(changes)
        write_json(self.json, {"map": target, "updates": done})
        return 0

    def _update_atlas(self, atlas: Atlas, settings: Settings) -> int:
        """Add each recording to its tile. The exit status is 1 if one fails."""
        if self.joined:
            raise UsageError("--joined needs a map file, not an atlas")
        configs = settings.get(AtlasConfig), settings.get(ClusterConfig)
        options, where = self._session_options(settings), self.paths[0]
        outcomes = AtlasUpdate(options, atlas, self.tile, self.ray, *configs).outcomes()
        if self.json != "-":
            for outcome in outcomes:
                if outcome.changes is not None:
                    text = describe_update(outcome.changes)
                    print_line(f"{where}, tile {outcome.tile_id}: {text}")
        facts = report_outcomes(where, outcomes, {"updated": "joined"}, self.json != "-")
        write_json(self.json, facts)
        return 1 if facts["failed"] else 0
