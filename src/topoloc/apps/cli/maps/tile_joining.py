"""Tiles that are joined: here, or on a cluster, a task a pair; a line for each pair that was
compared."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from topoloc.apps.cli.settings_file import Settings

if TYPE_CHECKING:
    from topoloc import PairResult


@dataclass(frozen=True, eq=False)
class JoinedTiles:
    """The atlas's manifest afterwards, what was found of each pair, as JSON has it, and a line for
    each that could not be compared."""

    manifest: Any
    rows: list[dict[str, Any]]
    not_compared: list[str]


def join_overlapping_tiles(
    where: str,
    tile_ids: Sequence[str],
    settings: Settings,
    is_verbose: bool,
    pairs: Sequence[tuple[str, str]] | None = None,
    ray: str | None = None,
) -> JoinedTiles:
    """These tiles joined with those that they overlap with, or just these `pairs`; on the cluster
    `ray`, if it is given.

    Raises:
        TopolocError: as of `join_tiles` and `run_on_ray`.
    """
    from topoloc import join_tiles

    def report_pair(one: PairResult) -> None:
        if is_verbose and one.problem is None:
            print(f"{one.first} and {one.second}: {one}", file=sys.stderr)

    run_jobs = None if ray is None else _run_jobs_on(ray, settings, report_pair)
    done = join_tiles(where, tile_ids, report_pair, pairs, run_jobs)
    lost = [
        f"{one.first} and {one.second}: {one.problem}"
        for one in done.pair_results
        if one.problem is not None
    ]
    return JoinedTiles(done.manifest, [one.to_json() for one in done.pair_results], lost)


def _run_jobs_on(
    ray: str, settings: Settings, report_pair: Callable[[PairResult], None]
) -> Callable[[Sequence[Any]], list[PairResult]]:
    """A task for each pair; pairs are reported in the order in which they are done."""
    from topoloc.apps.cluster.config import ClusterConfig
    from topoloc.apps.cluster.tasks import JobProgress, run_on_ray

    def show(number: int, state: PairResult | JobProgress) -> None:
        if not isinstance(state, JobProgress):
            report_pair(state)

    return lambda jobs: run_on_ray(jobs, ray, settings.of(ClusterConfig), show)
