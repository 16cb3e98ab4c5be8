"""An atlas built on a Ray cluster: one task a recording, each of which adds its own tile.

Maps never pass through the driver. Whoever dies is begun again (`tasks.py`), and what lies in the
atlas by then is found there and not made twice (`tiles.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from topoloc import read_manifest
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.remote import Progress
from topoloc.apps.cluster.tasks import OnJobState, run_on_ray
from topoloc.apps.cluster.tiles import Outcome, TileJob, build_tile
from topoloc.plugin import absolute_address


@dataclass(frozen=True)
class AtlasBuild:
    """Recordings, and the atlas that they become tiles of; `replaces` as of `build_tile`."""

    jobs: Sequence[TileJob]
    atlas: str
    replaces: bool = False
    config: ClusterConfig = field(default_factory=ClusterConfig)


@dataclass(frozen=True)
class TileTask:
    """A recording that becomes a tile, as a `Job`."""

    job: TileJob
    atlas: str
    replaces: bool

    @property
    def name(self) -> str:
        return f"build {self.job.tile_id}"

    def run(self, progress: Progress) -> Outcome:
        return build_tile(self.job, self.atlas, self.replaces, progress)

    def failure_outcome(self, reason: str) -> Outcome:
        return Outcome(self.job.recording, self.job.tile_id, "failed", reason)


def build_on_ray(
    build: AtlasBuild, address: str, show: OnJobState[Outcome] | None = None, is_live: bool = False
) -> list[Outcome]:
    """All recordings mapped, and their tiles in the atlas; what became of each, in their order.

    Args:
        address, show, is_live: as of `run_on_ray`.

    Raises:
        MissingExtraError, ClusterError: as of `connect_to_cluster`.
        AtlasError: what lies where the atlas is to be is none, or its store does not answer.
    """
    read_manifest(build.atlas)  # known before a cluster is asked
    tasks = [TileTask(job, absolute_address(build.atlas), build.replaces) for job in build.jobs]
    return run_on_ray(tasks, address, build.config, show, is_live)
