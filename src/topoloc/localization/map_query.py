"""Search one map for one image: verify the proposals of its feature types until one is settled.

**Sources** of a feature type, cheapest first: a prior pose alone; or retrieval, poses of the
preceding type, votes, node viewpoints, similar places, repetitions, virtual views. If another type
follows and the pose is not clear, only retrieval is used; if `is_hopeless`, virtual views follow.

**Feature types**: each next one is used if the pose is not settled. If none localizes the image,
the first one continues with its other sources, unless the last one makes that needless.

After the deadline only the proposal at hand is finished.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

from topoloc.geometry.camera import UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import Answer, lead
from topoloc.localization.map_context import MapContext
from topoloc.localization.propose import (
    propose_first,
    propose_from_other_features,
    propose_node_viewpoints,
    propose_repetitions,
    propose_similar_places,
    propose_voted_places,
)
from topoloc.localization.propose_twins import propose_twins
from topoloc.localization.refine import confirm_hypotheses
from topoloc.localization.search import Proposal, Search, verify
from topoloc.localization.walls.propose_virtual_views import propose_virtual_views


def propose(search: Search, prior: Rigid3 | None) -> Iterator[Proposal]:
    """Generate the proposals of one feature type."""
    yield propose_first(search, prior)
    if prior is None and (search.is_last or search.is_clear):
        yield from propose_from_other_features(search)
        yield from propose_more(search)


def propose_more(search: Search) -> Iterator[Proposal]:
    """Generate the proposals of one feature type that follow retrieval.

    If the retrieved nodes agree by chance only, votes are counted last, and only if no pose is
    probable: an image that looks aside shares a small part with the nodes of its place.
    """
    is_by_chance = search.num_retrieved < search.config.num_chance_inliers
    if not is_by_chance and not search.is_clear:
        yield from propose_voted_places(search)
    if not search.is_clear:
        yield from propose_node_viewpoints(search)
    if search.is_clear:
        yield from propose_similar_places(search)
    yield from propose_rivals(search)
    yield from propose_virtual_views(search)
    best, least = search.best, search.config.evidence.min_probability
    if search.is_last and is_by_chance and (best is None or best.probability < least):
        yield from propose_voted_places(search)
        yield from propose_rivals(search)


def propose_rivals(search: Search) -> Iterator[Proposal]:
    """Generate the poses from which other places look as from the best one."""
    yield from propose_twins(search)
    yield from propose_repetitions(search)


@dataclass(eq=False)
class MapQuery:
    """Hold the searches of an image in one map, by feature type. `prior` is world_from_cam."""

    opened: MapContext
    searches: list[Search]
    prior: Rigid3 | None = None

    @cached_property
    def _first_proposals(self) -> Iterator[Proposal]:
        return propose(self.searches[0], self.prior)

    def search_first(self) -> Answer:
        """Verify the first proposal, the cheapest one that localizes a clear image. Raises
        MapError: the map cannot be read."""
        verify_all(self.searches[0], islice(self._first_proposals, 1))
        return lead(self.searches[0])

    def search_all(self) -> Answer:
        """Verify all proposals that can settle the answer, after those of `search_first`. Raises
        MapError: the map cannot be read."""
        first, (*earlier, last) = self.searches[0], self.searches
        for search in earlier:
            answer = self._search_type(search)
            if search.is_stopped or (answer.pose and search.is_settled):
                return answer
            is_found_by_prior = self.prior is not None and search is first and answer.poses
            if is_found_by_prior and not search.is_settled:
                confirmed = confirm_hypotheses(first, last)
                if confirmed.poses:
                    return confirmed
        answer = self._search_type(last)
        if last.is_stopped or answer.poses or not earlier or self.prior is not None:
            return answer
        more = propose_more if last.weights.stop.continues_earlier else propose_virtual_views
        verify_all(first, more(first))
        confirmed = confirm_hypotheses(first, last)
        return confirmed if confirmed.poses else answer

    def without_calibration(self) -> MapQuery:
        """Return a query whose camera is unknown but for about its focal length. Features are not
        extracted again."""
        searches = list[Search]()
        for one in self.searches:
            camera = one.query.camera
            guess = UncalibratedCamera.from_focal_guess(camera.width, camera.height, camera.fx)
            query = replace(one.query, input_camera=replace(guess, mask=camera.mask))
            first = Search(query, one.map, one.config, one.weights, one.correlated_error_share)
            previous = searches[-1] if searches else None
            searches.append(replace(first, previous=previous, is_last=one.is_last, trace=one.trace))
        return MapQuery(self.opened, searches, self.prior)

    def _search_type(self, search: Search) -> Answer:
        """Verify the proposals of one feature type."""
        is_first = search is self.searches[0]
        verify_all(search, self._first_proposals if is_first else propose(search, self.prior))
        return lead(search)


def verify_all(search: Search, proposals: Iterable[Proposal]) -> None:
    """Verify proposals of a search, until the deadline."""
    for proposal in proposals:
        verify(proposal)
        if search.query.deadline.is_past:
            search.is_stopped = True
            return
