"""Pixels of all points in view weigh poses that are not clear."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import Answer, lead
from topoloc.localization.belief import Belief, Hypothesis
from topoloc.localization.exact import pixel_evidence
from topoloc.localization.exact.pixel_evidence import (
    PixelAgreement,
    load_pixel_weights,
    measure_pixels,
    weigh_pixels,
)
from topoloc.localization.exact.templates import NodeTemplate
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_query import MapQuery
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="module")
def room(room_map: Path) -> Iterator[TopoMetricMap]:
    with TopoMetricMap.load(room_map) as topomap:
        yield topomap


def _refused(room: TopoMetricMap, image: np.ndarray, log_odds: float) -> tuple[MapQuery, Answer]:
    """Return the query of an image, and its answer if the odds of its pose were these."""
    context = Localizer(room).context
    searches = context.searches(QueryImage(image, CAMERA), StageClock(), Deadline())
    query = MapQuery(context, searches)
    query.search_all()
    for search in searches:
        belief = Belief()
        for one in search.belief.hypotheses:
            weighed = replace(one, log_odds=min(one.log_odds, log_odds))
            belief = belief.with_hypothesis(weighed, search.config.evidence, search.weights.rivals)
        search.belief = belief
    return query, lead(searches[0])


def _moved(one: Hypothesis, metres: float) -> Hypothesis:
    """Return a hypothesis whose camera is moved aside."""
    shift = Rigid3(np.eye(3), np.array([metres, 0.0, 0.0]))
    pose = replace(one.fit.pose, cam_from_world=shift @ one.fit.pose.cam_from_world)
    return replace(one, fit=replace(one.fit, pose=pose))


def test_patches_agree_at_the_right_pose_only(room: TopoMetricMap):
    query, _ = _refused(room, unseen_views(step=0.75)[0][0], -2.0)
    search = query.searches[0]
    best = search.belief.hypotheses[0]
    right, wrong = measure_pixels(search, best), measure_pixels(search, _moved(best, 0.4))
    assert right is not None
    assert wrong is not None
    assert right.found > 0.5 > 3.0 * right.by_chance
    assert wrong.found < 0.3 * right.found
    weights = load_pixel_weights()
    assert right.log_odds(0.0, weights) > wrong.log_odds(0.0, weights) + 1.0


def test_surfaces_are_not_seen_from_behind(room: TopoMetricMap):
    query, _ = _refused(room, unseen_views(step=0.75)[0][0], -2.0)
    search = query.searches[0]
    best = search.belief.hypotheses[0]
    half_turn = np.diag([-1.0, 1.0, -1.0])  # about the camera's y axis
    there = np.array([0.0, 0.0, 2.0 * best.fit.median_depth])
    behind = Rigid3(half_turn, half_turn @ -there) @ best.fit.pose.cam_from_world
    fit = replace(best.fit, pose=replace(best.fit.pose, cam_from_world=behind))
    assert measure_pixels(search, replace(best, fit=fit)) is None


def test_a_right_pose_with_low_odds_is_answered_and_explained(room: TopoMetricMap):
    image, truth = unseen_views(step=0.75)[0]
    query, refused = _refused(room, image, -2.0)
    assert refused.pose is None
    finding = weigh_pixels(query, refused)
    assert finding is not None
    assert "log odds -2.0 ->" in finding.text
    pose = refused.after(finding).pose
    assert pose is not None
    assert np.linalg.norm((pose.world_from_cam.inverse() @ truth).translation) < 0.02


def test_odds_far_below_are_not_weighed(room: TopoMetricMap):
    far_below = load_pixel_weights().min_log_odds - 0.1
    query, refused = _refused(room, unseen_views(step=0.75)[0][0], far_below)
    assert weigh_pixels(query, refused) is None


@pytest.mark.parametrize("log_odds", [-5.9, 3.0])
def test_pixels_change_the_odds_by_a_bounded_amount(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch, log_odds: float
):
    weights = load_pixel_weights()
    all_agree, none_do = PixelAgreement(1.0, 0.0, 0.4, 4.0), PixelAgreement(0.0, 0.2, 0.0, -4.0)
    agreement = none_do if log_odds > 0.0 else all_agree
    monkeypatch.setattr(pixel_evidence, "measure_pixels", lambda *given: agreement)
    query, refused = _refused(room, unseen_views(step=0.75)[0][0], log_odds)
    finding = weigh_pixels(query, refused)
    assert finding is not None
    bound = -weights.max_loss if log_odds > 0.0 else weights.max_gain
    assert f"log odds {log_odds:.1f} -> {log_odds + bound:.1f}" in finding.text


def test_pixels_do_not_tell_two_poses_apart(room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch):
    query, _ = _refused(room, unseen_views(step=0.75)[0][0], -1.0)
    search = query.searches[0]
    best = search.belief.hypotheses[0]
    other = _moved(best, 2.0)
    search.belief = Belief((best, other))
    shown = {id(best): 0.9, id(other): 0.2}
    monkeypatch.setattr(
        pixel_evidence,
        "measure_pixels",
        lambda _, one: PixelAgreement(shown[id(one)], 0.0, 0.0, 0.0),
    )
    by_pixels = msgspec.structs.replace(load_pixel_weights(), place=0.0)
    monkeypatch.setattr(pixel_evidence, "load_pixel_weights", lambda: by_pixels)
    finding = weigh_pixels(query, lead(search))
    assert finding is not None
    assert finding.answer is not None
    odds = [one.log_odds for one in finding.answer.search.belief.all_hypotheses]
    assert len(odds) == 2
    assert odds[0] == pytest.approx(odds[1])
    assert odds[0] > -1.0


def test_without_images_of_the_nodes_a_refusal_remains(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    read = NodeTemplate.of_node
    monkeypatch.setattr(
        NodeTemplate,
        "of_node",
        staticmethod(lambda node: read(replace(node, template=b""))),
    )
    query, refused = _refused(room, unseen_views(step=0.75)[0][0], -2.0)
    assert weigh_pixels(query, refused) is None
