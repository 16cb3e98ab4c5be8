"""Recordings that join the tiles of an atlas which they are of: here, or on a cluster. `topoloc
update ATLAS SEQ [SEQ ...]`.

First the atlas, as it is, is asked which tile each one is of; then those of one tile join it one
after the other, others beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

from topoloc import (
    Atlas,
    AtlasConfig,
    DuplicateSessionError,
    Tile,
    edit_tile,
    find_tile_of_recording,
)
from topoloc.apps.cli.features_option import open_localizer
from topoloc.apps.cli.mapping.recordings_table import print_notes, recordings_table
from topoloc.apps.cli.maps.session_update import SessionUpdateOptions
from topoloc.apps.cli.output import interruptible
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.connection import connect_to_cluster
from topoloc.apps.cluster.tasks import Job, JobProgress, OnJobState, run_locally, run_on_ray
from topoloc.apps.cluster.tiles import Outcome, State, run_tile_work
from topoloc.plugin import Progress


@dataclass(frozen=True)
class TileSelectionJob:
    """Which tile of the atlas is the recording of? A job; its outcome names the tile."""

    options: SessionUpdateOptions
    atlas: str
    atlas_config: AtlasConfig

    @property
    def name(self) -> str:
        return f"which tile {self.options.recording}"

    def run(self, progress: Progress) -> Outcome:
        def find_tile() -> tuple[State, Tile]:
            with interruptible():
                sequence = self.options.open_session().sequence
                atlas = Atlas.open(self.atlas)
                localizer = open_localizer(atlas, self.options.localize, None, self.atlas_config)
                return "recognised", find_tile_of_recording(atlas, localizer, sequence, progress)

        return run_tile_work(self.options.recording, "", find_tile)

    def failure_outcome(self, reason: str) -> Outcome:
        return Outcome(self.options.recording, "", "failed", reason)


@dataclass(frozen=True)
class TileSessionJob:
    """The recording joins a tile of the atlas, unless it is in it. A job."""

    options: SessionUpdateOptions
    atlas: str
    tile_id: str

    @property
    def name(self) -> str:
        return f"update {self.tile_id} {self.options.recording}"

    def run(self, progress: Progress) -> Outcome:
        changes = dict[str, Any]()

        def update_tile() -> tuple[State, Tile]:
            session = self.options.open_session()
            try:
                with interruptible():
                    tile, update = edit_tile(
                        self.atlas, self.tile_id, lambda path: session.join(path, progress)
                    )
            except DuplicateSessionError:
                return "there", Atlas.open(self.atlas).tile(self.tile_id)
            changes.update(update.changes)
            return "updated", tile

        outcome = run_tile_work(self.options.recording, self.tile_id, update_tile)
        return replace(outcome, changes=changes or None)

    def failure_outcome(self, reason: str) -> Outcome:
        return Outcome(self.options.recording, self.tile_id, "failed", reason)


@dataclass(frozen=True)
class AtlasUpdate:
    """Recordings that join the atlas, each the tile that it is of, or all of them the tile
    `tile_id`; on the cluster `ray`, if that is given."""

    update_options: Sequence[SessionUpdateOptions]
    atlas: str
    tile_id: str | None = None
    ray: str | None = None
    atlas_config: AtlasConfig = field(default_factory=AtlasConfig)
    cluster: ClusterConfig = field(default_factory=ClusterConfig)

    def outcomes(self) -> list[Outcome]:
        """What became of each recording; told while it comes.

        Raises:
            AtlasError: no atlas is there, or it has no tile `tile_id`.
            MissingExtraError, ClusterError: as of `connect_to_cluster`.
        """
        atlas = Atlas.open(self.atlas)
        where = atlas.address
        tile = None if self.tile_id is None else atlas.tile(self.tile_id)
        names = [options.recording for options in self.update_options]
        with (
            nullcontext() if self.ray is None else connect_to_cluster(self.ray),
            recordings_table(names) as (show, is_live),
        ):
            chosen = (
                [Outcome(name, tile.tile_id, "recognised") for name in names]
                if tile
                else self._select_tiles(where, show, is_live)
            )
            known = [number for number, one in enumerate(chosen) if one.state == "recognised"]
            jobs = [
                TileSessionJob(self.update_options[number], where, chosen[number].tile_id)
                for number in known
            ]
            joined = self._run(
                jobs, lambda k, state: show(known[k], state), is_live, [job.tile_id for job in jobs]
            )
        for number, outcome in zip(known, joined, strict=True):
            chosen[number] = replace(
                outcome, notes=tuple(dict.fromkeys(chosen[number].notes + outcome.notes))
            )
        print_notes(chosen, is_live)
        return chosen

    def _select_tiles(self, where: str, show: OnJobState[Outcome], is_live: bool) -> list[Outcome]:
        """Which tile each recording is of, as the atlas is now; failed where it is of none."""

        def show_failures(number: int, state: Outcome | JobProgress) -> None:
            if is_live or (isinstance(state, Outcome) and state.reason is not None):
                show(number, state)

        return self._run(
            [TileSelectionJob(one, where, self.atlas_config) for one in self.update_options],
            show_failures,
            is_live,
        )

    def _run(
        self,
        jobs: Sequence[Job[Outcome]],
        show: OnJobState[Outcome],
        is_live: bool,
        lines: Sequence[str] | None = None,
    ) -> list[Outcome]:
        if self.ray is None or not jobs:
            return run_locally(jobs, show, is_live)
        return run_on_ray(jobs, self.ray, self.cluster, show, is_live, lines)
