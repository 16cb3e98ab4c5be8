"""Tiles that are joined: here, or on a cluster, a task a pair; a line for each pair that was
compared."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from topoloc.apps.cli.settings_file import Settings

if TYPE_CHECKING:
    from topoloc.lifelong.neighbours import Neighbours, Tried


@dataclass(frozen=True, eq=False)
class JoinedNeighbours:
    """The atlas's manifest afterwards, what was found of each pair, as JSON has it, and a line for
    each that could not be compared."""

    manifest: Any
    rows: list[dict[str, Any]]
    not_compared: list[str]


def joined_neighbours(
    where: str,
    tile_ids: Sequence[str],
    settings: Settings,
    is_told: bool,
    pairs: Sequence[tuple[str, str]] | None = None,
    ray: str | None = None,
) -> JoinedNeighbours:
    """These tiles joined with those that they overlap with, or just these `pairs`; on the cluster
    `ray`, if it is given.

    Raises:
        TopolocError: as of `join_tiles` and `run_on_ray`.
    """
    from topoloc.lifelong.neighbours import NotCompared, join_tiles
    from topoloc.lifelong.tile_joins import TileJoinConfig

    def tell(one: Tried) -> None:
        if is_told and not isinstance(one.found, NotCompared):
            print(f"{one.first} and {one.second}: {_said(one)}", file=sys.stderr)

    if ray is None:
        done = join_tiles(where, tile_ids, settings.of(TileJoinConfig), tell, pairs)
    else:
        done = _joined_on_ray(where, tile_ids, settings, tell, pairs, ray)
    lost = [
        f"{one.first} and {one.second}: {one.found.reason}"
        for one in done.tried
        if isinstance(one.found, NotCompared)
    ]
    return JoinedNeighbours(done.manifest, [_row(one) for one in done.tried], lost)


def _joined_on_ray(
    where: str,
    tile_ids: Sequence[str],
    settings: Settings,
    tell: Callable[[Tried], None],
    pairs: Sequence[tuple[str, str]] | None,
    ray: str,
) -> Neighbours:
    """As `join_tiles`, a task a pair; told in the order in which they are done."""
    from topoloc.apps.cluster.config import ClusterConfig
    from topoloc.apps.cluster.tasks import Running, run_on_ray
    from topoloc.atlas.atlas import Atlas, whole_address
    from topoloc.lifelong.neighbours import Neighbours, PairJob, pairs_to_join
    from topoloc.lifelong.tile_joins import TileJoinConfig

    def show(number: int, state: Tried | Running) -> None:
        if not isinstance(state, Running):
            tell(state)

    config = settings.of(TileJoinConfig)
    jobs = [
        PairJob(whole_address(where), first, second, config)
        for first, second in pairs_to_join(where, tile_ids, config, pairs)
    ]
    tried = run_on_ray(jobs, ray, settings.of(ClusterConfig), show) if jobs else []
    return Neighbours(Atlas.open(where).manifest, tried)


def _said(one: Tried) -> str:
    from topoloc.lifelong.tile_joins import NotJoined

    found = one.found
    if isinstance(found, NotJoined):
        return found.reason
    if found.is_by_shared:
        return f"joined, by {found.num_agreeing} pictures that are part of both"
    return (
        f"joined, {found.num_agreeing} nodes agree, {found.num_recognised} of {found.num_near} that"
        " must be recognised are"
    )


def _row(one: Tried) -> dict[str, Any]:
    from topoloc.lifelong.tile_joins import NotJoined

    row: dict[str, Any] = {
        "first": one.first,
        "second": one.second,
        "joined": not isinstance(one.found, NotJoined),
    }
    if isinstance(one.found, NotJoined):
        return row | {"reason": one.found.reason}
    found = one.found
    row |= {"num_agreeing": found.num_agreeing, "same_pictures": found.is_by_shared}
    return row | {
        "num_near": found.num_near,
        "num_recognised": found.num_recognised,
        "agreeing": round(found.agreeing, 3),
    }
