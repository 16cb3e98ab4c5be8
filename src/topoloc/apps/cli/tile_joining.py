"""Tiles that are joined: here, or on a cluster, a task a pair; a line for each pair that was
compared."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from topoloc.apps.cli.settings_file import Settings

if TYPE_CHECKING:
    from topoloc.lifelong.tile_joining import PairResult, TileJoiningResult


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
    from topoloc import TileJoinConfig, join_tiles
    from topoloc.lifelong.tile_joining import NotCompared

    def report_pair(one: PairResult) -> None:
        if is_verbose and not isinstance(one.found, NotCompared):
            print(f"{one.first} and {one.second}: {_format_result(one)}", file=sys.stderr)

    if ray is None:
        done = join_tiles(where, tile_ids, settings.of(TileJoinConfig), report_pair, pairs)
    else:
        done = _join_on_ray(where, tile_ids, settings, report_pair, pairs, ray)
    lost = [
        f"{one.first} and {one.second}: {one.found.reason}"
        for one in done.pair_results
        if isinstance(one.found, NotCompared)
    ]
    return JoinedTiles(done.manifest, [_result_to_json(one) for one in done.pair_results], lost)


def _join_on_ray(
    where: str,
    tile_ids: Sequence[str],
    settings: Settings,
    report_pair: Callable[[PairResult], None],
    pairs: Sequence[tuple[str, str]] | None,
    ray: str,
) -> TileJoiningResult:
    """As `join_tiles`, a task a pair; told in the order in which they are done."""
    from topoloc import Atlas, TileJoinConfig
    from topoloc.apps.cluster.config import ClusterConfig
    from topoloc.apps.cluster.tasks import JobProgress, run_on_ray
    from topoloc.atlas.atlas import absolute_address
    from topoloc.lifelong.tile_joining import PairJob, TileJoiningResult, select_tile_pairs

    def show(number: int, state: PairResult | JobProgress) -> None:
        if not isinstance(state, JobProgress):
            report_pair(state)

    config = settings.of(TileJoinConfig)
    jobs = [
        PairJob(absolute_address(where), first, second, config)
        for first, second in select_tile_pairs(where, tile_ids, config, pairs)
    ]
    pair_results = run_on_ray(jobs, ray, settings.of(ClusterConfig), show) if jobs else []
    return TileJoiningResult(Atlas.open(where).manifest, pair_results)


def _format_result(one: PairResult) -> str:
    from topoloc.lifelong.tile_comparison import NotJoined

    found = one.found
    if isinstance(found, NotJoined):
        return found.reason
    if found.is_from_shared_images:
        return f"joined, by {found.num_agreeing} pictures that are part of both"
    return (
        f"joined, {found.num_agreeing} nodes agree, {found.num_recognised} of {found.num_near} that"
        " must be recognised are"
    )


def _result_to_json(one: PairResult) -> dict[str, Any]:
    from topoloc.lifelong.tile_comparison import NotJoined

    row: dict[str, Any] = {
        "first": one.first,
        "second": one.second,
        "joined": not isinstance(one.found, NotJoined),
    }
    if isinstance(one.found, NotJoined):
        return row | {"reason": one.found.reason}
    found = one.found
    row |= {"num_agreeing": found.num_agreeing, "same_pictures": found.is_from_shared_images}
    return row | {
        "num_near": found.num_near,
        "num_recognised": found.num_recognised,
        "agreeing": round(found.agreeing, 3),
    }
