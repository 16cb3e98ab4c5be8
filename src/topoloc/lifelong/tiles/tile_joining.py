"""Join the overlapping tiles of an atlas. Start reading at `join_tiles`. Also find the tile of an
atlas that a recording belongs to, by localizing a sample of its images.

Only tiles with similar places are compared, according to the atlas's index of global descriptors.
`tile_comparison.py` compares each pair. Each join is committed at once, so an interrupted run can
continue. The manifest adjusts all joins together (`atlas/joint_worlds.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import add_joins
from topoloc.atlas.joint_worlds import MAX_WORLD_OFFSET_M, Join
from topoloc.atlas.manifest import Manifest, Tile
from topoloc.atlas.map_cache import MapCache
from topoloc.errors import AtlasError, MapError, TrajectoryError
from topoloc.json_data import OneLine
from topoloc.lifelong.node_localization import sample_evenly
from topoloc.lifelong.tiles.tile_comparison import NotJoined, OpenTile, TileTransform, compare_tiles
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.config import Progress
from topoloc.recordings.frame import StereoSequence


def find_tile_of_recording(
    atlas: Atlas, localizer: Localizer, sequence: StereoSequence, progress: Progress
) -> Tile:
    """Return the tile in which most sampled images of a recording are localized. Raises
    TrajectoryError if too few images are localized, or they are in tiles of several worlds, and
    UnreadableImageError, QueryError and AtlasError as `Localizer.localize`."""
    # Number of images of the recording, evenly spaced, that are localized in the atlas.
    num_queries = 12
    rows = sample_evenly(range(len(sequence)), num_queries)
    answers = list[Localization]()
    for done, row in enumerate(rows):
        frame = sequence[row]
        result = localizer.localize(frame.image, frame.camera)
        if isinstance(result, Localization):
            answers.append(result)
        progress("which tile", done + 1, len(rows))
    return find_best_tile(sequence.name, len(rows), answers, atlas.manifest.by_id)


def find_best_tile(
    name: str, num_asked: int, answers: Sequence[Localization], tiles: Mapping[str, Tile]
) -> Tile:
    """Return the tile (of `tiles`, by id) with the most localizations (`answers`) of the
    `num_asked` sampled images of the recording `name`. Raises TrajectoryError if no tile has
    enough, or they are in tiles of several worlds."""
    min_answers = 3  # minimum number of images localized in the tile
    # Minimum share of the localized images that are in the tile or in tiles of the same
    # world.
    min_share = 0.67
    found = (answer.provenance.tile for answer in answers)
    counts = Counter(tile_id for tile_id in found if tile_id is not None)
    if not counts or max(counts.values()) < min_answers:
        raise TrajectoryError(
            f"{name}: no tile recognises it: {_format_counts(counts)} of {num_asked} pictures"
            " asked; the atlas stays as it is"
        )
    best = min(counts, key=lambda tile_id: (-counts[tile_id], tile_id))
    world = tiles[best].in_joint_world.joint
    of_world = sum(
        number for tile_id, number in counts.items() if tiles[tile_id].in_joint_world.joint == world
    )
    if of_world < min_share * counts.total():
        raise TrajectoryError(
            f"{name}: it looks like several tiles: {_format_counts(counts)} of {num_asked} pictures"
            " asked; the atlas stays as it is"
        )
    return tiles[best]


def _format_counts(counts: Counter[str]) -> str:
    """Format the number of localized images per tile, the largest first."""
    known = (f"{tile_id} knows {number}" for tile_id, number in counts.most_common(4))
    return ", ".join(known) or "none knows any"


_NUM_RETRIEVED = 32
_NUM_BEST = 3
_MAX_BYTES = 512_000_000

OnCompared = Callable[["PairResult"], None]
RunPairJobs = Callable[[list["PairJob"]], list["PairResult"]]
"""Runs jobs elsewhere, such as on a cluster; the results are in the order of the jobs."""


@dataclass(frozen=True)
class NotCompared(NotJoined):
    """Hold the reason why a comparison of two tiles did not finish."""


@dataclass(frozen=True, repr=False)
class PairResult(OneLine):
    """Hold the ids of two tiles and the result of comparing them."""

    first: str
    second: str
    found: TileTransform | NotJoined

    @property
    def problem(self) -> str | None:
        """Why the tiles could not be compared; None if they were."""
        return self.found.reason if isinstance(self.found, NotCompared) else None

    def __str__(self) -> str:
        if isinstance(self.found, NotJoined):
            return self.found.reason
        if self.found.shares_images:
            return f"joined, by {self.found.num_agreeing} pictures that are part of both"
        return (
            f"joined, {self.found.num_agreeing} nodes agree, {self.found.num_recognised} of"
            f" {self.found.num_near} that must be recognised are"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the pair, whether it was joined, and the figures or the reason."""
        found, row = self.found, {"first": self.first, "second": self.second}
        if isinstance(found, NotJoined):
            return row | {"joined": False, "reason": found.reason}
        return row | {
            "joined": True,
            "num_agreeing": found.num_agreeing,
            "same_pictures": found.shares_images,
            "num_near": found.num_near,
            "num_recognised": found.num_recognised,
            "agreeing": round(found.agreeing, 3),
        }


@dataclass(frozen=True, eq=False)
class TileJoiningResult:
    """Hold the manifest of the atlas after joining, and the results of all pairs."""

    manifest: Manifest
    pair_results: list[PairResult]


def join_tiles(
    where: str,
    tile_ids: Sequence[str] = (),
    on_compared: OnCompared | None = None,
    pairs: Sequence[tuple[str, str]] | None = None,
    run_jobs: RunPairJobs | None = None,
) -> TileJoiningResult:
    """Join overlapping tiles that have no direct join yet.

    Args:
        where: the atlas.
        tile_ids: compare only pairs with one of these tiles. Empty means all tiles.
        on_compared: is called with the result of each pair.
        pairs: compare exactly these pairs of tile ids. None means pairs of similar tiles.
        run_jobs: compares the pairs instead, as jobs; `on_compared` is not called then.

    Raises:
        AtlasError: there is no such atlas or tile, or the atlas cannot be written.
        FeatureTypeError, WeightsError: the maps' features cannot be compared on this machine.
    """
    atlas = Atlas.open(where)
    wanted = {atlas.tile(tile_id).tile_id for tile_id in tile_ids} or set(atlas.manifest.by_id)
    if pairs is None:
        selected = find_candidate_pairs(atlas, wanted)
    else:
        known = {join.pair for join in atlas.manifest.joins}
        ordered = [(min(pair), max(pair)) for pair in pairs]
        selected = [(atlas.tile(a), atlas.tile(b)) for a, b in ordered if (a, b) not in known]
    pair_results = list[PairResult]()
    if run_jobs is not None:
        jobs = [PairJob(atlas.address, first.tile_id, second.tile_id) for first, second in selected]
        pair_results = run_jobs(jobs) if jobs else []
    else:
        with closing(MapCache([], Localizer, _MAX_BYTES)) as maps:
            for first, second in selected:
                pair_results.append(_join_pair(atlas, maps, first, second))
                if on_compared is not None:
                    on_compared(pair_results[-1])
    return TileJoiningResult(Atlas.open(where).manifest, pair_results)


@dataclass(frozen=True)
class PairJob:
    """Compare two tiles of the atlas at `where` and join them if they overlap, as a job of a
    cluster."""

    where: str
    first: str
    second: str

    @property
    def name(self) -> str:
        """Return the name of the job."""
        return f"join {self.first} {self.second}"

    def run(self, progress: Progress) -> PairResult:
        """Compare and join the tiles. Raises as `join_tiles`, and AtlasError if a tile does not
        exist any more."""
        atlas = Atlas.open(self.where)
        with closing(MapCache([], Localizer, _MAX_BYTES)) as maps:
            return _join_pair(atlas, maps, atlas.tile(self.first), atlas.tile(self.second))

    def failure_outcome(self, reason: str) -> PairResult:
        """Return the result of a job that did not finish."""
        return PairResult(self.first, self.second, NotCompared(reason))


def _join_pair(atlas: Atlas, maps: MapCache[Localizer], first: Tile, second: Tile) -> PairResult:
    """Compare a pair of tiles and return the result. A join is added to the manifest."""
    ids = first.tile_id, second.tile_id
    try:
        vectors = [atlas.places_of(tile) for tile in (first, second)]
        with (
            maps.use_map(ids[0], atlas.map_path(first)) as one,
            maps.use_map(ids[1], atlas.map_path(second)) as other,
        ):
            found = compare_tiles(
                OpenTile(one.content, vectors[0]), OpenTile(other.content, vectors[1])
            )
    except (MapError, AtlasError) as error:
        found = NotCompared(str(error))
    if isinstance(found, TileTransform):
        join = Join(*ids, found.first_from_second, found.covariance, found.num_agreeing)
        add_joins(atlas.store.where, [join], dict(zip(ids, (first, second), strict=True)))
    return PairResult(*ids, found)


def find_candidate_pairs(atlas: Atlas, wanted: Collection[str]) -> list[tuple[Tile, Tile]]:
    """Return pairs of tiles that may overlap, the most similar first, each in the order of its ids.

    The tiles of a pair are in different worlds, have no join yet and are not known to be far apart.
    Their most similar places have at least `min_likeness`.
    """
    # Minimum similarity of two tiles: the median over their few most similar places. Less
    # similar tiles are not compared.
    min_likeness = 0.35
    # Maximum number of pairs of tiles to compare. The most similar pairs come first.
    max_pairs = 10_000
    manifest, index = atlas.manifest, atlas.index
    scores, known = dict[tuple[str, str], float](), {join.pair for join in manifest.joins}
    for tile in manifest.tiles:
        if tile.tile_id not in wanted or tile.tile_id in index.problems:
            continue
        candidate_ids = [other.tile_id for other in manifest.tiles if _may_overlap(tile, other)]
        if not candidate_ids or not index.kinds:
            continue
        for other_id, score in _find_similar_tiles(atlas, tile, candidate_ids):
            pair = (min(tile.tile_id, other_id), max(tile.tile_id, other_id))
            if pair not in known and score >= min_likeness:
                scores[pair] = max(score, scores.get(pair, -1.0))
    best = sorted(scores, key=lambda pair: (-scores[pair], pair))[:max_pairs]
    return [(manifest.by_id[first], manifest.by_id[second]) for first, second in best]


def _find_similar_tiles(
    atlas: Atlas, tile: Tile, candidate_ids: Sequence[str]
) -> list[tuple[str, float]]:
    """Return the most similar tiles with their similarity: the median over the most similar
    places."""
    num_neighbours = 6  # number of most similar other tiles that each tile is compared with
    places, found = atlas.places_of(tile), dict[str, list[float]]()
    kind = next((kind for kind in tile.kinds if kind in places), next(iter(places)))
    for row in sample_evenly(range(len(places[kind])), _NUM_RETRIEVED):
        query = {kind: places[kind][row]}
        for other_id, likeness in atlas.index.rank(query, num_neighbours, candidate_ids):
            found.setdefault(other_id, []).append(likeness)
    scores = {
        other_id: float(np.median(sorted(values)[-_NUM_BEST:]))
        for other_id, values in found.items()
    }
    return sorted(scores.items(), key=lambda pair: -pair[1])[:num_neighbours]


def _may_overlap(tile: Tile, other: Tile) -> bool:
    """Return whether two tiles are in different worlds and not known to be far apart."""
    if tile.world == other.world:
        return False
    world_from_other = tile.from_world_of(other)
    if world_from_other is None:
        return True
    boxes = tile.box_world, other.box_world
    reach = sum(float(np.linalg.norm(np.diff(box, axis=0))) / 2.0 for box in boxes)
    centres = [box.mean(axis=0) for box in boxes]
    apart = float(np.linalg.norm(world_from_other.apply(centres[1]) - centres[0]))
    return apart <= reach + MAX_WORLD_OFFSET_M
