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

from topoloc.apps.cli.map_or_atlas import open_atlas
from topoloc.apps.cli.output import interruptible
from topoloc.apps.cli.recordings_table import recordings_table, tell_notes
from topoloc.apps.cli.session_joining import SessionJoining
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.connection import connected
from topoloc.apps.cluster.tasks import Job, Running, Show, run_here, run_on_ray
from topoloc.apps.cluster.tiles import Outcome, State, outcome_of
from topoloc.atlas.atlas import Atlas, whole_address
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.manifest import Tile
from topoloc.errors import SessionKnownError
from topoloc.lifelong.tile_choice import TileChoiceConfig, tile_of_recording
from topoloc.lifelong.tile_update import edited_tile
from topoloc.mapping.build import Progress


@dataclass(frozen=True)
class TileChoice:
    """Which tile of the atlas is the recording of? A job; its outcome names the tile."""

    joining: SessionJoining
    atlas: str
    asked: AtlasConfig
    config: TileChoiceConfig

    @property
    def name(self) -> str:
        return f"which tile {self.joining.recording}"

    def run(self, progress: Progress) -> Outcome:
        def recognised() -> tuple[State, Tile]:
            with interruptible():
                sequence = self.joining.opened().sequence
                localizer = open_atlas(self.atlas, self.joining.localize, None, self.asked)
                return "recognised", tile_of_recording(localizer, sequence, self.config, progress)

        return outcome_of(self.joining.recording, "", recognised)

    def failed(self, reason: str) -> Outcome:
        return Outcome(self.joining.recording, "", "failed", reason)


@dataclass(frozen=True)
class TileSession:
    """The recording joins a tile of the atlas, unless it is in it. A job."""

    joining: SessionJoining
    atlas: str
    tile_id: str

    @property
    def name(self) -> str:
        return f"update {self.tile_id} {self.joining.recording}"

    def run(self, progress: Progress) -> Outcome:
        changes = dict[str, Any]()

        def updated() -> tuple[State, Tile]:
            session = self.joining.opened()
            try:
                with interruptible():
                    tile, update = edited_tile(
                        self.atlas, self.tile_id, lambda path: session.join(path, progress)
                    )
            except SessionKnownError:
                return "there", Atlas.open(self.atlas).tile(self.tile_id)
            changes.update(update.changes)
            return "updated", tile

        outcome = outcome_of(self.joining.recording, self.tile_id, updated)
        return replace(outcome, changes=changes or None)

    def failed(self, reason: str) -> Outcome:
        return Outcome(self.joining.recording, self.tile_id, "failed", reason)


@dataclass(frozen=True)
class AtlasUpdate:
    """Recordings that join the atlas, each the tile that it is of, or all of them the tile
    `tile_id`; on the cluster `ray`, if that is given."""

    joinings: Sequence[SessionJoining]
    atlas: str
    tile_id: str | None = None
    ray: str | None = None
    asked: AtlasConfig = field(default_factory=AtlasConfig)
    choice: TileChoiceConfig = field(default_factory=TileChoiceConfig)
    cluster: ClusterConfig = field(default_factory=ClusterConfig)

    def outcomes(self) -> list[Outcome]:
        """What became of each recording; told while it comes.

        Raises:
            AtlasError: no atlas is there, or it has no tile `tile_id`.
            MissingExtraError, ClusterError: as of `connected`.
        """
        atlas, where = Atlas.open(self.atlas), whole_address(self.atlas)
        tile = None if self.tile_id is None else atlas.tile(self.tile_id)
        names = [joining.recording for joining in self.joinings]
        with (
            nullcontext() if self.ray is None else connected(self.ray),
            recordings_table(names) as (show, is_live),
        ):
            chosen = (
                [Outcome(name, tile.tile_id, "recognised") for name in names]
                if tile
                else self._chosen(where, show, is_live)
            )
            known = [number for number, one in enumerate(chosen) if one.state == "recognised"]
            jobs = [
                TileSession(self.joinings[number], where, chosen[number].tile_id)
                for number in known
            ]
            joined = self._run(
                jobs, lambda k, state: show(known[k], state), is_live, [job.tile_id for job in jobs]
            )
        for number, outcome in zip(known, joined, strict=True):
            chosen[number] = replace(
                outcome, notes=tuple(dict.fromkeys(chosen[number].notes + outcome.notes))
            )
        tell_notes(chosen, is_live)
        return chosen

    def _chosen(self, where: str, show: Show[Outcome], is_live: bool) -> list[Outcome]:
        """Which tile each recording is of, as the atlas is now; failed where it is of none."""

        def show_until_known(number: int, state: Outcome | Running) -> None:
            if is_live or (isinstance(state, Outcome) and state.reason is not None):
                show(number, state)

        return self._run(
            [TileChoice(one, where, self.asked, self.choice) for one in self.joinings],
            show_until_known,
            is_live,
        )

    def _run(
        self,
        jobs: Sequence[Job[Outcome]],
        show: Show[Outcome],
        is_live: bool,
        lines: Sequence[str] | None = None,
    ) -> list[Outcome]:
        if self.ray is None or not jobs:
            return run_here(jobs, show, is_live)
        return run_on_ray(jobs, self.ray, self.cluster, show, is_live, lines)
