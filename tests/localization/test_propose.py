"""Test the sources of pose proposals and when they are skipped: similar places, node
viewpoints, a prior."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from built_room import built_room, unseen_views
from doubled_room import ELSEWHERE, twice
from tiny_world import CAMERA
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization import decision, map_query, propose
from topoloc.localization.belief import Belief
from topoloc.localization.config import LocalizerConfig, NodeViewpointsConfig, SimilarPlacesConfig
from topoloc.localization.exact.pixel_evidence import weigh_pixels
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.localizer import Localizer
from topoloc.localization.pose_fit import PointMatches, PoseFit
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.refine import NodeProposal, is_already_found
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.search import Proposal, Trace, verify
from topoloc.mapping.topomap import TopoMetricMap

LIGHTS = (0.055, 0.05, 0.045)
ONLY_RETRIEVAL = LocalizerConfig(
    look_alikes=SimilarPlacesConfig(max_groups=0),
    viewpoints=NodeViewpointsConfig(num_nodes=0),
)


@pytest.fixture(scope="module")
def room(tiny_recording: Path) -> TopoMetricMap:
    return built_room(tiny_recording)


def _sources(trace: Trace) -> list[str]:
    return [tried.source for tried in trace.tried]


# similar places


def test_a_place_that_is_in_the_map_twice_is_ambiguous_and_both_poses_are_named(
    room: TopoMetricMap,
):
    localizer = Localizer(twice(room))
    results = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    assert not any(isinstance(result, Localization) for result, _ in results)
    ambiguous = [
        (r, truth)
        for r, truth in results
        if isinstance(r, NotLocalized) and r.reason == "ambiguous"
    ]
    assert len(ambiguous) >= 0.9 * len(results)
    for result, truth in ambiguous:
        first, second = result.alternatives[:2]
        assert sorted(one.node_id < len(room.nodes) for one in (first, second)) == [False, True]
        for one in (first, second):
            expected = truth if one.node_id < len(room.nodes) else ELSEWHERE @ truth
            assert translation_error(one.world_from_cam, expected) < 0.05
        assert 0.8 < sum(one.probability for one in result.alternatives) <= 1.0
        named = result.to_json("view.png")["alternatives"]
        assert [one["node"] for one in named] == [one.node_id for one in result.alternatives]


def test_retrieval_alone_misses_the_second_place_or_the_pose(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    """What other proposals are for."""
    monkeypatch.setattr(map_query, "propose_more", lambda _: iter(()))
    localizer = Localizer(twice(room))
    results = [localizer.localize(picture, CAMERA) for picture, _ in unseen_views()]
    assert not any(
        isinstance(result, NotLocalized) and result.reason == "ambiguous" for result in results
    )


def test_a_partly_similar_place_is_distinguished(room: TopoMetricMap):
    localizer = Localizer(twice(room, share_alike=0.2))
    found = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    right = [
        isinstance(r, Localization) and translation_error(r.world_from_cam, truth) < 0.05
        for r, truth in found
    ]
    assert np.mean(right) >= 0.8
    assert not any(
        isinstance(r, Localization) and translation_error(r.world_from_cam, truth) > 0.5
        for r, truth in found
    )


def test_a_place_that_is_in_the_map_once_is_answered_as_by_retrieval_alone(room: TopoMetricMap):
    with_them, without = Localizer(room), Localizer(room, ONLY_RETRIEVAL)
    for picture, _ in unseen_views():
        one, other = with_them.localize(picture, CAMERA), without.localize(picture, CAMERA)
        assert isinstance(one, Localization)
        assert isinstance(other, Localization)
        np.testing.assert_array_equal(one.world_from_cam.matrix(), other.world_from_cam.matrix())


# viewpoints


def _dark(picture: np.ndarray, light: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 5.0, picture.shape)
    return np.clip(light * picture + noise, 0, 255).astype(np.uint8)


def test_dark_images_are_localized_only_with_viewpoints(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    without_pixels = tuple(one for one in decision.CHECKS if one is not weigh_pixels)
    monkeypatch.setattr(decision, "CHECKS", without_pixels)  # they recognise a pose with low odds
    views = [
        (_dark(picture, light, k), truth)
        for light in LIGHTS
        for k, (picture, truth) in enumerate(unseen_views())
    ]
    num_right, sources = {}, []
    for num_nodes in (0, NodeViewpointsConfig().num_nodes):
        localizer = Localizer(
            room, LocalizerConfig(viewpoints=NodeViewpointsConfig(num_nodes=num_nodes))
        )
        errors = []
        for picture, truth in views:
            trace = Trace()
            result = localizer.localize(picture, CAMERA, trace=trace)
            errors += (
                [translation_error(result.world_from_cam, truth)]
                if isinstance(result, Localization)
                else []
            )
            sources += _sources(trace) if num_nodes == 0 else []
        assert max(errors, default=0.0) < 0.25
        num_right[num_nodes] = len(errors)
    assert num_right[NodeViewpointsConfig().num_nodes] > num_right[0]
    assert "viewpoints" not in sources


def _never_clear(room: TopoMetricMap, config: LocalizerConfig | None = None) -> Localizer:
    """Return a localizer for which no image has a clear pose."""
    weights = load_fitted_weights("surf")
    return Localizer(
        room,
        config,
        weights=replace(weights, evidence=structs.replace(weights.evidence, clear_log_odds=1e9)),
    )


def test_images_without_a_clear_pose_are_localized_and_out_of_map_images_are_not(
    room: TopoMetricMap,
):
    localizer = _never_clear(room)
    here = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    assert all(
        isinstance(result, Localization) and translation_error(result.world_from_cam, truth) < 0.05
        for result, truth in here
    )
    assert not any(
        isinstance(localizer.localize(picture, CAMERA), Localization)
        for picture, _ in unseen_views(seed=7)
    )


def test_a_pose_of_several_viewpoints_is_tried_once_with_most_inliers_first(
    room: TopoMetricMap,
):
    """All nodes around show the same place, so that one pose follows."""
    trace = Trace()
    _never_clear(room).localize(unseen_views()[2][0], CAMERA, trace=trace)
    fits = [tried.first for tried in trace.tried if tried.source == "viewpoints"]
    assert 1 <= len(fits) <= 4
    assert [fit.num_inliers for fit in fits] == sorted(
        (fit.num_inliers for fit in fits), reverse=True
    )
    centres = [fit.world_from_cam.translation for fit in fits if isinstance(fit, PoseFit)]
    assert len(centres) == len(fits)
    assert all(np.linalg.norm(a - b) > 0.05 for k, a in enumerate(centres) for b in centres[:k])


def test_the_number_of_tried_viewpoints_is_limited(room: TopoMetricMap):
    trace = Trace()
    _never_clear(room, LocalizerConfig()).localize(unseen_views()[2][0], CAMERA, trace=trace)
    assert 1 <= _sources(trace).count("viewpoints") <= 4


# when nothing more is sought


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[PointMatches]:
    """Return the list of fits with enough matches that RANSAC finds from now on."""
    found, fit_pose = list[PointMatches](), propose.fit_pose

    def told(*arguments: Any, min_matches: float = 4.0, **settings: Any) -> PointMatches:
        fit = fit_pose(*arguments, min_matches=min_matches, **settings)
        found.extend([fit] * (len(fit.matches) >= min_matches))
        return fit

    monkeypatch.setattr(propose, "fit_pose", told)
    return found


def test_an_out_of_map_image_is_refused_after_the_first_proposal(
    room: TopoMetricMap, fits: list[PointMatches]
):
    """No similar place is tried and no viewpoint uses RANSAC, so that a refusal is as
    fast as a pose."""
    localizer = Localizer(room)
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    for picture in (noise, *(picture for picture, _ in unseen_views(seed=1, step=4.0))):
        fits.clear()
        trace = Trace()
        assert isinstance(localizer.localize(picture, CAMERA, trace=trace), NotLocalized)
        assert _sources(trace) == ["retrieval"]
        assert len(fits) <= 1


def test_a_clear_image_is_compared_with_no_viewpoint(room: TopoMetricMap, fits: list[PointMatches]):
    trace = Trace()
    result = Localizer(room).localize(unseen_views()[2][0], CAMERA, trace=trace)
    assert isinstance(result, Localization)
    assert "viewpoints" not in _sources(trace)
    assert _sources(trace)[0] == "retrieval"
    assert len(fits) == len(trace.tried)


# a prior


def _no_search(*_: object) -> None:
    pytest.fail("the coarse localizer was asked")


def test_a_prior_replaces_the_coarse_search(room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch):
    localizer, (picture, truth) = Localizer(room), unseen_views()[2]
    monkeypatch.setattr(localizer.context.first.map.coarse, "rank", _no_search)
    about = truth @ Rigid3(exp_so3(np.array([0.0, 0.05, 0.0])), np.array([0.1, 0.0, -0.1]))
    trace = Trace()
    result = localizer.localize(picture, CAMERA, prior=about, trace=trace)
    assert isinstance(result, Localization)
    assert translation_error(result.world_from_cam, truth) < 0.02
    assert _sources(trace) == ["prior"]
    assert len(result.candidates) == localizer.config.num_candidates
    scores = [candidate.score for candidate in result.candidates]
    assert scores == sorted(scores, reverse=True)
    nearest = min(
        room.summaries, key=lambda summary: translation_error(summary.world_from_cam, truth)
    )
    assert nearest.node_id in {candidate.node_id for candidate in result.candidates}


def test_a_wrong_prior_does_not_localize_an_out_of_map_image(room: TopoMetricMap):
    localizer, (_, somewhere) = Localizer(room), unseen_views()[2]
    for picture, _ in unseen_views(seed=1, step=4.0):
        assert isinstance(localizer.localize(picture, CAMERA, prior=somewhere), NotLocalized)


# repeated poses


def test_a_repeated_pose_is_not_tried_again(room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch):
    followed = list[Proposal]()

    def follow(proposal: Proposal) -> None:
        followed.append(proposal)
        verify(proposal)

    monkeypatch.setattr(map_query, "verify", follow)
    for picture, _ in unseen_views():
        followed.clear()
        assert isinstance(Localizer(room).localize(picture, CAMERA), Localization)
        proposal = followed[0]
        assert isinstance(proposal, NodeProposal)
        assert is_already_found(proposal)
        assert proposal.refine() is None
        assert isinstance(proposal.fit, PoseFit)
        pose = proposal.fit.pose
        beside = replace(
            pose, cam_from_world=Rigid3(np.eye(3), np.array([0.3, 0.0, 0.0])) @ pose.cam_from_world
        )
        assert not is_already_found(replace(proposal, fit=replace(proposal.fit, pose=beside)))
        before = replace(proposal.search, belief=Belief())
        assert not is_already_found(replace(proposal, search=before))


# refinement


def test_a_clear_pose_is_refined_with_its_own_nodes_if_the_nearest_ones_differ(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    """This happens around a bend. The farthest node stands for the nearest ones."""
    localizer, (picture, truth) = Localizer(room), unseen_views()[0]
    (search, *_) = localizer.context.searches(QueryImage(picture, CAMERA), StageClock(), Deadline())
    first = propose.propose_first(search, None)
    assert isinstance(first, NodeProposal)
    assert first.fit.num_inliers >= search.config.num_clear_inliers
    farthest = search.map.nearest(truth, len(room.nodes))[-1:]
    monkeypatch.setattr(type(search.map), "nearest", lambda *_: farthest)
    final = first.refine()
    assert isinstance(final, PoseFit)
    assert set(final.local_map.node_ids) != {room.summaries[farthest[0]].node_id}
    assert final.num_inliers >= first.fit.num_inliers
    assert translation_error(final.world_from_cam, truth) < 0.02
