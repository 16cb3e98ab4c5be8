"""topoloc build SEQ [SEQ ...] MAP."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from topoloc.cli.info import describe_map
from topoloc.cli.output import progress_bar, write_json
from topoloc.errors import TopolocError
from topoloc.mapping.build import BuildConfig, build_map


@dataclass(frozen=True)
class Command:
    """What `topoloc build` takes."""

    paths: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="SEQ [SEQ ...] MAP")]
    """One or several recordings whose poses share one world, then the map file to write. PATH@0::2 takes every second frame of PATH."""
    trajectory: tuple[str, ...] = ("truth",)
    """Where poses come from, one for all recordings or one each: `truth` (what the recording holds) or a TUM or KITTI trajectory file."""
    format: str | None = None
    """The recordings' format, where it is not recognised by itself."""
    d_thresh: float | None = None
    """D_thresh of Eq. 1, metres between nodes (default: 15 % of the scene's median depth)."""
    lambda_rot: Annotated[float | None, tyro.conf.arg(name="lambda")] = None
    """lambda of Eq. 1, metres a radian (default: so much that a turn of 3 degrees makes a node)."""
    coarse: Literal["surf-vlad"] = "surf-vlad"
    """The coarse localizer that the map gets."""
    features: Literal["surf", "sift"] = "surf"
    """Local features of the map, and of every query to it."""
    json: str | None = None
    """Write what `topoloc info` says of the new map to this file (- for standard output)."""
    config: BuildConfig = field(default_factory=BuildConfig)

    def run(self) -> int:
        if len(self.paths) < 2:
            raise TopolocError("build takes at least one recording and, last, the map file to write")
        *recordings, map_path = self.paths
        target = Path(map_path)
        if not target.parent.is_dir():
            raise TopolocError(f"cannot write map {target}: folder {target.parent} does not exist")
        if target.is_dir():
            raise TopolocError(f"cannot write map {target}: it is a folder")
        sequences = self._open(recordings)
        nodes = replace(
            self.config.nodes,
            d_thresh=self.config.nodes.d_thresh if self.d_thresh is None else self.d_thresh,
            lambda_rot=self.config.nodes.lambda_rot if self.lambda_rot is None else self.lambda_rot,
        )
        config = replace(self.config, nodes=nodes, features=replace(self.config.features, kind=self.features))
        with progress_bar() as progress:
            topomap = build_map(sequences, config, progress)
        topomap.save(target)
        info = describe_map(topomap, target)
        if self.json != "-":
            print(
                f"{target}: {info['num_nodes']} nodes, {info['num_points']} points, {info['bytes'] / 1e6:.2f} MB, {info['length_m']:.1f} m mapped"
            )
        write_json(self.json, info)
        return 0

    def _open(self, recordings: list[str]) -> list:
        from topoloc.sequences.open import open_sequence
        from topoloc.sequences.trajectory import with_trajectory

        trajectories = self.trajectory * len(recordings) if len(self.trajectory) == 1 else self.trajectory
        if len(trajectories) != len(recordings):
            raise TopolocError(f"{len(recordings)} recordings but {len(trajectories)} trajectories")
        sequences = []
        for path, trajectory in zip(recordings, trajectories, strict=True):
            sequence = open_sequence(path, self.format)
            sequences.append(sequence if trajectory == "truth" else with_trajectory(sequence, Path(trajectory)))
        return sequences
