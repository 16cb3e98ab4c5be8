"""Schedule the pose proposals for one image: over tiles, feature types and sources.

`Localizer` verifies each proposal and adds its hypothesis to the belief of its search, which is one
feature type of one tile. The schedule skips what the beliefs make needless, and stops. After the
deadline only the proposal at hand is finished.

**Sources** of a feature type, cheapest first: a prior pose alone; or retrieval, poses of the
preceding type, votes, node viewpoints, similar places, repetitions, virtual views. If another type
follows and the pose is not clear, only retrieval is used; if `is_hopeless`, virtual views follow.

**Feature types** of a tile: each next one is used if the pose is not settled. If none localizes the
image, the first one continues with its other sources, unless the last one makes that needless.

**Tiles**: a single one is searched exhaustively. Of several, the index ranks them by the cheapest
feature type. Unless one leads clearly, the likeliest are searched coarse only, by retrieval, until
a pose is clear; if none is, the next feature type ranks them. The most promising ones are then
searched exhaustively until one localizes the image. Similar tiles may then hold a rival pose.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from typing import Literal

from topoloc.atlas.config import AtlasConfig
from topoloc.errors import MapError, ObjectStoreError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact.last_step import make_precise
from topoloc.localization.map_context import MapContext
from topoloc.localization.proposals.propose import (
    min_rival_inliers,
    propose_first,
    propose_from_other_features,
    propose_node_viewpoints,
    propose_quick,
    propose_repetitions,
    propose_similar_places,
)
from topoloc.localization.proposals.votes import propose_voted_places
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.refine import confirm_hypotheses, find_best_case_evidence
from topoloc.localization.result import Localization
from topoloc.localization.result_decision import (
    ResultWithInliers,
    decide_final_result,
    decide_result,
)
from topoloc.localization.search import Proposal, Search, Trace
from topoloc.localization.tiles.tiles import (
    Reach,
    TileRanking,
    TileResult,
    Tiles,
    is_negligible_rival,
    merge_tile_results,
    ranking_margin,
)
from topoloc.localization.walls.propose_virtual_views import propose_virtual_views

TileProposals = Generator[Proposal, None, ResultWithInliers]
"""Proposals of a search in one tile; returns the result."""


def propose(search: Search, prior: Rigid3 | None) -> Iterator[Proposal]:
    """Generate the proposals of one feature type."""
    yield propose_first(search, prior)
    if prior is None and (search.is_last or search.is_clear):
        yield from propose_from_other_features(search)
        yield from propose_more(search)


def propose_more(search: Search) -> Iterator[Proposal]:
    """Generate the proposals of one feature type that follow retrieval."""
    for propose_unclear in (propose_voted_places, propose_node_viewpoints):
        if not search.is_clear:
            yield from propose_unclear(search)
    if search.is_clear:
        yield from propose_similar_places(search)
    yield from propose_repetitions(search)
    yield from propose_virtual_views(search)


def _until_late(search: Search, proposals: Iterable[Proposal]) -> Iterator[Proposal]:
    """Generate the proposals until the deadline. Raises MapError: the map cannot be read."""
    for proposal in proposals:
        yield proposal
        if search.failure is not None:
            raise search.failure
        if search.query.deadline.is_past:
            search.is_stopped = True
            return


@dataclass(eq=False)
class TileQuery:
    """Hold the searches of a query in one tile, by feature type. `prior` is world_from_cam."""

    opened: MapContext
    searches: list[Search]
    prior: Rigid3 | None = None

    @cached_property
    def _first_proposals(self) -> Iterator[Proposal]:
        return propose(self.searches[0], self.prior)

    def coarse_only(self) -> TileProposals:
        """Generate the first proposal, the cheapest one that localizes a clear image."""
        yield from _until_late(self.searches[0], islice(self._first_proposals, 1))
        return decide_result(self.searches[0])

    def exhaustive(self) -> TileProposals:
        """Generate all proposals that can settle the result, after those of a coarse search."""
        first, last, outcomes = self.searches[0], self.searches[-1], list[ResultWithInliers]()
        for search in self.searches:
            is_first = search is first
            proposals = self._first_proposals if is_first else propose(search, self.prior)
            yield from _until_late(search, proposals)
            is_final = search.is_stopped or search.is_settled or search.is_last
            result, named = decide_final_result(search) if is_final else decide_result(search)
            outcomes.append((result, named))
            is_localized = is_final and isinstance(result, Localization)
            # other types have the same calibration, so they are not used if it is refuted
            if search.is_stopped or is_localized or search.is_refuted:
                return result, named
            if is_first and self.prior is not None and named and not is_final:
                confirmed = confirm_hypotheses(first, last)
                if confirmed[1]:
                    return confirmed
        if first is not last and not outcomes[-1][1] and self.prior is None:
            more = propose_more if last.weights.stop.continues_earlier else propose_virtual_views
            yield from _until_late(first, more(first))
            confirmed = confirm_hypotheses(first, last)
            if confirmed[1]:
                return confirmed
        return outcomes[-1]


@dataclass(eq=False)
class Schedule:
    """Generate the proposals for one image until the deadline.

    `reach` holds the tiles that may be searched, None for all. `queries` holds the searches in each
    tile. If its map was closed since, new ones start.
    """

    tiles: Tiles
    config: AtlasConfig
    query_image: QueryImage
    deadline: Deadline
    reach: Reach | None = None
    trace: Trace | None = None
    clock: StageClock = field(default_factory=StageClock)
    ranking: TileRanking = field(default_factory=list)
    results: dict[str, TileResult] = field(default_factory=dict)
    queries: dict[str, TileQuery] = field(default_factory=dict)

    def propose_all(self) -> Generator[Proposal, None, None]:
        """Generate proposals until a tile localizes the image, then those of similar tiles."""
        for ranking in self.tiles.rankings(self.query_image, self.clock, self.reach):
            self.ranking = ranking
            yield from self._propose_coarse_only(self.config.num_coarse_first)
            if self._has_clear_pose or self.deadline.is_past:
                break
        else:
            yield from self._propose_coarse_only(self.config.num_glanced)
        hopeful = self._candidates()
        for number in range(self.config.num_asked):
            # after the first one, a tile must have a coarse pose or be similar, or cannot be ranked
            least = (0.0, self.config.min_similarity) if number else (0.0, -math.inf)
            searched = {one.tile_id for one in self.results.values() if one.is_exhaustive}
            left = [one for one in self._readable(hopeful) if one[0] not in searched]
            left = [one for one in left if self._priority(one) >= least or self._is_unranked(one)]
            if not left or self._localized or (self.results and self.deadline.is_past):
                break
            yield from self.propose_in_tile(*max(left, key=self._priority))
        while not self.results and (left := self._readable(self.ranking)):
            yield from self.propose_in_tile(*left[0])  # the likely tiles cannot be read
        if self._localized:
            yield from self._propose_in_similar_tiles()

    def _propose_coarse_only(self, num_tiles: int) -> Iterator[Proposal]:
        """Generate the first proposals of the likeliest tiles, unless one leads clearly."""
        if ranking_margin(self._readable(self.ranking)) >= self.config.min_ranking_margin:
            return
        for tile_id, similarity in self._candidates()[:num_tiles]:
            if self._has_clear_pose or self.deadline.is_past:
                return
            if tile_id not in self.results:
                yield from self.propose_in_tile(tile_id, similarity, "coarse")

    def _propose_in_similar_tiles(self) -> Iterator[Proposal]:
        """Generate the proposals of tiles about as similar to the image as the localized one."""
        least = min(one.similarity for one in self._localized) - self.config.max_rival_gap
        alike = [one for one in self.ranking if one[1] >= least and one[0] not in self.results]
        for tile_id, similarity in alike[: self.config.num_rivals]:
            if not self.deadline.is_past:
                yield from self.propose_in_tile(tile_id, similarity, "rival")
        for one in list(self.results.values()):
            if one.is_clear and not one.is_exhaustive:  # one of them may hold the true pose
                yield from self.propose_in_tile(one.tile_id, one.similarity)

    def propose_in_tile(
        self,
        tile_id: str,
        similarity: float = 1.0,
        mode: Literal["exhaustive", "coarse", "rival"] = "exhaustive",
        prior: Rigid3 | None = None,
    ) -> Generator[Proposal, None, None]:
        """Generate the proposals of one tile, and record its result or why it cannot be read.
        A rival is searched coarse only, if it may rival a pose that was found.

        Raises:
            ObjectStoreError: the object store of the tile does not respond.
            MapError: the map cannot be read, and no other tile is left.
        """
        if not self.tiles.can_search(tile_id):
            self.results.pop(tile_id, None)
            return
        if prior is None and self.reach is not None:
            prior = self.reach.get(tile_id)
        is_exhaustive = mode == "exhaustive"
        try:
            with self.tiles.use(tile_id) as opened:
                query = self.queries.get(tile_id)
                if query is None or query.opened is not opened:
                    state = self.query_image, self.clock, self.deadline, self.trace
                    query = TileQuery(opened, opened.searches(*state), prior)
                    self.queries[tile_id] = query
                if mode == "rival" and not self._may_be_rival(query):
                    return
                outcome = yield from query.exhaustive() if is_exhaustive else query.coarse_only()
                if is_exhaustive:
                    outcome = make_precise(query.searches, outcome, query.prior is not None)
                result, poses = opened.name_outcome(outcome, self.query_image.camera)
        except ObjectStoreError:  # the tile is fine, but its result is unknown
            raise
        except MapError as error:
            self.results.pop(tile_id, None)
            self.tiles.report(tile_id, error)
            return
        self.results[tile_id] = TileResult(tile_id, result, poses, is_exhaustive, similarity)

    def outcome(self) -> ResultWithInliers:
        """Return the result of all searched tiles. Raises AtlasError: there are none."""
        result, poses = merge_tile_results(self.tiles, list(self.results.values()))
        return replace(result, times_ms=self.clock.times_ms()), poses

    def _candidates(self) -> TileRanking:
        """Return the tiles nearly as similar to the image as the best one."""
        ranking = self._readable(self.ranking)
        least = ranking[0][1] - self.config.max_similarity_gap if ranking else 0.0
        return [one for one in ranking if one[1] >= least or self._is_unranked(one)]

    def _is_unranked(self, ranked: tuple[str, float]) -> bool:
        return ranked[0] in self.tiles.unranked

    def _may_be_rival(self, query: TileQuery) -> bool:
        """Return whether a pose of a further tile may rival one of the found poses.

        It may if the prior pose there is known. Otherwise the best evidence of a coarse search by
        the strongest features shows it.
        """
        if query.prior is not None:
            return True
        search, known = query.searches[0], self._localized
        least = min(min_rival_inliers(self.queries[one.tile_id].searches[0]) for one in known)
        quick = propose_quick(replace(search), least)
        evidence = None if quick is None else find_best_case_evidence(quick)
        poses = [one.localized for one in known if one.localized is not None]
        return evidence is not None and not all(
            is_negligible_rival(evidence, search.map.kind.name, pose) for pose in poses
        )

    def _readable(self, ranking: TileRanking) -> TileRanking:
        """Return the ranking without unreadable tiles."""
        return [one for one in ranking if self.tiles.can_search(one[0])]

    def _priority(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Return the sort key of a tile: the probability of its coarse pose, its similarity."""
        known = self.results.get(ranked[0])
        found = [one.probability for one, _ in known.poses] if known else []
        return max(found, default=0.0), ranked[1]

    @property
    def _localized(self) -> list[TileResult]:
        """Return the tiles that localized the image in an exhaustive search."""
        return [one for one in self.results.values() if one.localized is not None]

    @property
    def _has_clear_pose(self) -> bool:
        return any(one.is_clear for one in self.results.values())
