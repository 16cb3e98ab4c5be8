"""Decide the answer of a map: search it, then let each check change or refuse the answer.

`CHECKS` holds all that may change an answer after the belief, in order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from topoloc.localization.answer import Answer, Finding, probability_within
from topoloc.localization.belief import Hypothesis
from topoloc.localization.exact.appearance import check_colours
from topoloc.localization.exact.last_step import refine_answer
from topoloc.localization.exact.pixel_evidence import weigh_pixels
from topoloc.localization.image_calibration_check import SeenCamera, check_image_calibration
from topoloc.localization.map_query import MapQuery
from topoloc.localization.result import Localization


def check_camera(query: MapQuery, answer: Answer) -> Finding | None:
    """Compare the image with its calibration, and with a camera that turned during the image.

    If the image contradicts its calibration, or if the camera turned, the pose is by the camera
    that the image shows. Its uncertainty is added to the covariance and lowers the probability.
    """
    search, best, pose = answer.search, answer.best, answer.pose
    if pose is None or best is None or best.fit.pose.camera is not None:
        return None
    with search.query.clock.stage("calibration"):
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


def check_threshold(query: MapQuery, answer: Answer) -> Finding | None:
    """Refuse a pose whose probability is below the threshold of the map's certificate, which
    looks as on another floor, or which is less precise than the tolerance."""
    pose, certified = answer.pose, query.opened.topomap.certificate
    config = query.opened.config.evidence
    if pose is None:
        return None
    least = 0.0 if certified is None else certified.applied_min_probability
    if pose.probability < least:
        text = f"probability {pose.probability:.3g}, below the map's certified threshold"
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
    return None


Check = Callable[[MapQuery, Answer], Finding | None]
CHECKS: tuple[Check, ...] = (
    weigh_pixels,
    check_camera,
    refine_answer,
    check_colours,
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
