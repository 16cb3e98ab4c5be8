"""Search the tiles of an atlas for one image, likeliest first, and decide the answer of each. A map
is an atlas of one tile.

A single tile is searched exhaustively. Of several, the index ranks them by the cheapest feature
type. Unless one leads clearly, the likeliest are searched coarse only, by retrieval, until a pose
is clear; if none is, the next feature type ranks them. The most promising ones are then searched
exhaustively until one localizes the image. Similar tiles may then hold a rival pose.

`CHECKS` holds all that may change the answer of a tile after the belief, in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from topoloc.atlas.config import AtlasConfig
from topoloc.errors import MapError, ObjectStoreError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import Answer, Finding, ResultWithInliers, probability_within
from topoloc.localization.belief import MIN_ALTERNATIVE_RATIO, Hypothesis
from topoloc.localization.evidence import highest_probability
from topoloc.localization.exact.appearance import check_colours
from topoloc.localization.exact.last_step import refine_answer
from topoloc.localization.exact.pixel_evidence import weigh_pixels
from topoloc.localization.image_calibration_check import (
    SeenCamera,
    check_image_calibration,
    doubt_ratio,
    find_ratio_doubt,
)
from topoloc.localization.map_query import MapQuery
from topoloc.localization.propose import min_rival_inliers, propose_quick
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.refine import find_best_case
from topoloc.localization.result import Localization
from topoloc.localization.search import Search, Trace
from topoloc.localization.tiles.tiles import (
    Reach,
    TileAnswer,
    TileRanking,
    Tiles,
    merge_answers,
    ranking_margin,
)


@dataclass(eq=False)
class Schedule:
    """Search tiles for one image until the deadline.

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
    answers: dict[str, TileAnswer] = field(default_factory=dict)
    queries: dict[str, MapQuery] = field(default_factory=dict)

    def search_all(self) -> None:
        """Search tiles until one localizes the image, then similar tiles."""
        for ranking in self.tiles.rankings(self.query_image, self.clock, self.reach):
            self.ranking = ranking
            self._search_coarsely(self.config.num_coarse_first)
            if self._has_clear_pose or self.deadline.is_past:
                break
        else:
            self._search_coarsely(self.config.num_glanced)
        hopeful = self._candidates()
        for number in range(self.config.num_asked):
            # after the first one, a tile must have a coarse pose or be similar, or cannot be ranked
            least = (0.0, self.config.min_similarity) if number else (0.0, -math.inf)
            searched = {one.tile_id for one in self.answers.values() if one.is_exhaustive}
            left = [one for one in self._readable(hopeful) if one[0] not in searched]
            left = [one for one in left if self._priority(one) >= least or self._is_unranked(one)]
            if not left or self._localized or (self.answers and self.deadline.is_past):
                break
            self.search_tile(*max(left, key=self._priority))
        while not self.answers and (left := self._readable(self.ranking)):
            self.search_tile(*left[0])  # the likely tiles cannot be read
        if self._localized:
            self._search_similar_tiles()

    def _search_coarsely(self, num_tiles: int) -> None:
        """Search the likeliest tiles coarse only, unless one leads clearly."""
        if ranking_margin(self._readable(self.ranking)) >= self.config.min_ranking_margin:
            return
        for tile_id, similarity in self._candidates()[:num_tiles]:
            if self._has_clear_pose or self.deadline.is_past:
                return
            if tile_id not in self.answers:
                self.search_tile(tile_id, similarity, is_exhaustive=False)

    def _search_similar_tiles(self) -> None:
        """Search tiles that are about as similar to the image as the localized one."""
        least = min(one.similarity for one in self._localized) - self.config.max_rival_gap
        alike = [one for one in self.ranking if one[1] >= least and one[0] not in self.answers]
        for tile_id, similarity in alike[: self.config.num_rivals]:
            if not self.deadline.is_past:
                self.search_tile(tile_id, similarity, is_exhaustive=False, only_rival=True)
        for one in list(self.answers.values()):
            if one.is_clear and not one.is_exhaustive:  # one of them may hold the true pose
                self.search_tile(one.tile_id, one.similarity)

    def search_tile(
        self,
        tile_id: str,
        similarity: float = 1.0,
        is_exhaustive: bool = True,
        only_rival: bool = False,
        prior: Rigid3 | None = None,
    ) -> None:
        """Search one tile, and record its result or why it cannot be read.

        Args:
            only_rival: leave the tile out if it cannot rival a pose that was found.

        Raises:
            ObjectStoreError: the object store of the tile does not respond.
            MapError: the map cannot be read, and no other tile is left.
        """
        if not self.tiles.can_search(tile_id):
            self.answers.pop(tile_id, None)
            return
        if prior is None and self.reach is not None:
            prior = self.reach.get(tile_id)
        try:
            with self.tiles.use(tile_id) as opened:
                query = self.queries.get(tile_id)
                if query is None or query.opened is not opened:
                    state = self.query_image, self.clock, self.deadline, self.trace
                    query = MapQuery(opened, opened.searches(*state), prior)
                    self.queries[tile_id] = query
                if only_rival and not self._may_be_rival(query):
                    return
                answer = decide(query) if is_exhaustive else decide_coarsely(query)
                answer = answer.with_provenance(opened, self.query_image.camera)
        except ObjectStoreError:  # the tile is fine, but its result is unknown
            raise
        except MapError as error:
            self.answers.pop(tile_id, None)
            self.tiles.report(tile_id, error)
            return
        self.answers[tile_id] = TileAnswer(tile_id, answer, is_exhaustive, similarity)

    def outcome(self) -> ResultWithInliers:
        """Return the result of all searched tiles. Raises AtlasError: there are none."""
        result, poses = merge_answers(self.tiles, list(self.answers.values()))
        return replace(result, times_ms=self.clock.times_ms()), poses

    def _candidates(self) -> TileRanking:
        """Return the tiles nearly as similar to the image as the best one."""
        ranking = self._readable(self.ranking)
        least = ranking[0][1] - self.config.max_similarity_gap if ranking else 0.0
        return [one for one in ranking if one[1] >= least or self._is_unranked(one)]

    def _is_unranked(self, ranked: tuple[str, float]) -> bool:
        return ranked[0] in self.tiles.unranked

    def _may_be_rival(self, query: MapQuery) -> bool:
        """Return whether a pose of a further tile may rival one of the found poses.

        It may if the prior pose there is known. Otherwise the best evidence of a coarse search by
        the strongest features shows it.
        """
        if query.prior is not None:
            return True
        search, known = query.searches[0], self._localized
        least = min(min_rival_inliers(self.queries[one.tile_id].searches[0]) for one in known)
        quick = propose_quick(replace(search), least)
        rival = None if quick is None else find_best_case(quick)
        negligible = -math.log(MIN_ALTERNATIVE_RATIO)
        return rival is not None and any(
            one.answer.margin_over(search, rival) <= negligible for one in known
        )

    def _readable(self, ranking: TileRanking) -> TileRanking:
        """Return the ranking without unreadable tiles."""
        return [one for one in ranking if self.tiles.can_search(one[0])]

    def _priority(self, ranked: tuple[str, float]) -> tuple[float, float]:
        """Return the sort key of a tile: the probability of its coarse pose, its similarity."""
        known = self.answers.get(ranked[0])
        found = [one.probability for one, _ in known.answer.poses] if known else []
        return max(found, default=0.0), ranked[1]

    @property
    def _localized(self) -> list[TileAnswer]:
        """Return the tiles that localized the image in an exhaustive search."""
        return [one for one in self.answers.values() if one.localized is not None]

    @property
    def _has_clear_pose(self) -> bool:
        return any(one.is_clear for one in self.answers.values())


def check_camera(query: MapQuery, answer: Answer) -> Finding | None:
    """Compare the image with its calibration, and with a camera that turned during the image.

    If the image contradicts its calibration, or if the camera turned, the pose is by the camera
    that the image shows. Its uncertainty is added to the covariance and lowers the probability.
    """
    with answer.search.query.clock.stage("calibration"):
        found = _compare_camera(query, answer)
    if found is not None and found.refusal is None and "frame_rotation_deg" in found.facts:
        return found  # a turn scales rows as well
    return _find_other_ratio(query, answer.search) or found


def _compare_camera(query: MapQuery, answer: Answer) -> Finding | None:
    search, best, pose = answer.search, answer.best, answer.pose
    if pose is None or best is None or best.fit.pose.camera is not None:
        return None
    found = check_image_calibration(search, best.fit, best.evidence.is_of_nodes)
    facts: dict[str, Any] = {"seen_camera": found.seen}
    if found.other is None:
        return Finding("camera", "the image agrees with its calibration", facts=facts)
    factor = probability_within(search, best, found.other.belief)
    if found.doubt is not None:
        text = f"the calibration is doubtful: {found.doubt}"
        facts["calibration_doubt"] = found.doubt
        factor *= _share_without_pixels(query, best, pose)
    else:
        angle_deg = float(np.rad2deg(np.linalg.norm(found.other.rotation)))
        text = f"the camera turned by {angle_deg:.2f} degrees during the image"
        facts["frame_rotation_deg"] = angle_deg
    refusal = None
    if factor * pose.probability < search.config.evidence.min_probability:
        refusal = ("too_few_inliers", text)
    by_image = _with_camera(best, found.other)
    return Finding("camera", text, factor, facts, by_image, refusal=refusal)


def _find_other_ratio(query: MapQuery, search: Search) -> Finding | None:
    """Return the answer by a camera whose fy is not that of the calibration, as of an image whose
    width and height were scaled apart after it was calibrated. None if it is not so."""
    least = 0.02  # of the ratio, two of its standard deviations
    by_calibration = find_ratio_doubt(search)
    if by_calibration is None or search.query.deadline.is_past:
        return None
    other = query.without_calibration()
    answer = other.search_all()
    answer = answer.after(weigh_pixels(other, answer))
    if answer.pose is None or answer.best is None:
        text = "width and height of the image were scaled apart, unlike its calibration"
        return Finding("camera", text, refusal=("too_few_inliers", f"{text}: state --camera"))
    fit, calibrated = answer.best.fit, by_calibration.camera
    ratio = fit.camera.fy / fit.camera.fx * calibrated.fx / calibrated.fy
    if abs(math.log(ratio)) < least:
        return None
    text = f"the image has {ratio:.2f} times the height that its calibration states"
    doubt = doubt_ratio(search, by_calibration, fit)
    pose = replace(answer.pose, calibration_doubt=doubt, focal_length_px=None)
    poses = [(pose, answer.poses[0][1])]
    return Finding("camera", text, answer=replace(answer, result=pose, poses=poses))


def _share_without_pixels(query: MapQuery, best: Hypothesis, pose: Localization) -> float:
    """Return the factor that takes back what pixels added: the doubted camera predicted them."""
    known = (one for search in query.searches for one in search.belief.hypotheses)
    before = next((one.probability for one in known if one.fit is best.fit), 1.0)
    return min(1.0, before / pose.probability)


def _with_camera(best: Hypothesis, other: SeenCamera) -> Hypothesis:
    """Return the hypothesis by the camera that the image shows, as if all rows had been read with
    the middle one."""
    fit, added = best.fit, other.belief.covariance
    features = replace(fit.features, points_img=other.undo_rotation(fit.features.points_img))
    covariance = fit.pose.covariance + added
    pose = replace(fit.pose, cam_from_world=other.cam_from_world, covariance=covariance)
    fit = replace(fit, features=features, camera=other.camera, pose=pose)
    return replace(best, fit=fit, covariance=best.covariance + added)


def widen_by_scale(query: MapQuery, answer: Answer) -> Finding | None:
    """Add the uncertainty of the map's scale to the covariance: the whole map grows or shrinks
    about the world's origin."""
    pose, sigma = answer.pose, query.opened.topomap.config.scale_sigma
    if pose is None or not sigma:  # without scale, units are exact
        return None
    covariance, shift = pose.covariance.copy(), sigma * pose.world_from_cam.translation
    covariance[:3, :3] += np.outer(shift, shift)
    wider = replace(pose, covariance=covariance)
    share = pose.noise_share * (pose.position_sigma_m / wider.position_sigma_m) ** 2
    text = f"the scale of the map is known to {100.0 * sigma:.1f} %"
    return Finding("scale", text, facts={"covariance": covariance, "noise_share": share})


def check_threshold(query: MapQuery, answer: Answer) -> Finding | None:
    """Refuse a pose whose probability is below the threshold of the map's certificate, which
    looks as on another floor, or which is less precise than the tolerance. The probability of
    others is limited by the covariance, now that the last step has changed it, and by how little
    of the image agrees: pixels of a door agree with each of its copies."""
    pose, certified = answer.pose, query.opened.topomap.certificate
    config = query.opened.config.evidence
    if pose is None:
        return None
    least = 0.0 if certified is None else certified.applied_min_probability
    depth = math.inf if answer.best is None else answer.best.fit.median_depth
    precise = highest_probability(pose.camera_covariance, depth, config)
    probability = min(pose.probability, precise, _highest_of_part(answer))
    if probability < least:
        text = f"probability {probability:.3g}, below the map's certified threshold"
        text = f"{text} {least:.3g}"
        return Finding("threshold", text, refusal=("too_few_inliers", text))
    if pose.probability < config.min_probability:
        text = "without colours in view nothing tells the look-alike floors apart"
        if (seen := pose.appearance) is not None:
            text = f"the shape agrees, but not the colours, as on another floor ({seen:.2g})"
        return Finding("threshold", text, refusal=("not_in_map", text))
    # those of the weights refuse no pose: covariances are upper bounds
    sigmas, asked = (pose.position_sigma_m, pose.rotation_sigma_deg), config.tolerance
    if asked is not None and (sigmas[0] > asked[0] or sigmas[1] > asked[1]):
        text = "in the map, but where is known to {:.2f} m and {:.1f} degrees only".format(*sigmas)
        return Finding("threshold", text, refusal=("imprecise", text))
    if probability < pose.probability:
        text = "only a small part of the image agrees"
        if probability == precise:
            text = "standard deviations of {:.2f} m and {:.1f} degrees".format(*sigmas)
        text = f"{text}: at most a probability of {probability:.2f}"
        return Finding("threshold", text, facts={"probability": probability})
    return None


def _highest_of_part(answer: Answer) -> float:
    """Return the highest probability of a pose by the part of the image where points agree."""
    if answer.best is None:
        return 1.0
    evidence = answer.best.evidence
    weights = answer.search.weights.for_evidence(evidence)
    as_precise = replace(evidence, doubt=min(evidence.doubt, 0.1))  # the covariance limits it, too
    return 1.0 / (1.0 + math.exp(-weights.highest_log_odds(as_precise)))


Check = Callable[[MapQuery, Answer], Finding | None]
CHECKS: tuple[Check, ...] = (
    weigh_pixels,
    check_camera,
    refine_answer,
    check_colours,
    widen_by_scale,
    check_threshold,
)
"""All that may change an answer after the belief. `docs/architecture.md` describes each."""


def decide(query: MapQuery) -> Answer:
    """Search a map for a query image and return the answer after all checks."""
    return _after_checks(query, query.search_all(), CHECKS)


def decide_coarsely(query: MapQuery) -> Answer:
    """Return the answer of the cheapest proposal, whose probability alone is checked."""
    return _after_checks(query, query.search_first(), (check_threshold,))


def _after_checks(query: MapQuery, answer: Answer, checks: tuple[Check, ...]) -> Answer:
    for check in checks:
        answer = answer.after(check(query, answer))
    if answer.search.trace is not None:
        answer.search.trace.findings += answer.findings
    return answer
