"""Decide the answer of a map: search it, then let each check change or refuse the answer.

`CHECKS` holds all that may change an answer after the belief, in order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from topoloc.geometry.calibration_check import CalibrationMismatch
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraBelief,
    CameraHypothesis,
    WeighedCamera,
)
from topoloc.localization.answer import Answer, Finding, probability_within
from topoloc.localization.belief import Hypothesis
from topoloc.localization.evidence import compute_normalized_uncertainty
from topoloc.localization.exact.appearance import check_colours
from topoloc.localization.exact.last_step import look_again, refine_answer
from topoloc.localization.image_calibration_check import TurningCamera, check_image_calibration
from topoloc.localization.map_query import MapQuery
from topoloc.localization.result import Localization


def check_camera(query: MapQuery, answer: Answer) -> Finding | None:
    """Compare the image with its calibration, and with a camera that turned during the image.

    If the image contradicts its calibration, the covariance grows by the shift that the error
    causes. The probability falls accordingly. If the camera turned, the pose is that of the middle
    row.
    """
    search, best, pose = answer.search, answer.best, answer.pose
    if pose is None or best is None or best.fit.pose.camera is not None:
        return None
    with search.query.clock.stage("calibration"):
        found = check_image_calibration(search, best.fit, best.evidence.is_of_nodes)
    facts: dict[str, Any] = {"seen_camera": found.seen}
    if found.doubt is not None:
        return _doubt_camera(answer, pose, best, facts, found.doubt)
    if found.turning is None:
        return Finding("camera", "the image agrees with its calibration", facts=facts)
    angle_deg = float(np.rad2deg(np.linalg.norm(found.turning.rotation)))
    text = f"the camera turned by {angle_deg:.2f} degrees during the image"
    facts["frame_rotation_deg"] = angle_deg
    undone = _undo_rotation(best, found.turning)
    return Finding("camera", text, facts=facts, hypothesis=undone)


def _doubt_camera(
    answer: Answer,
    pose: Localization,
    best: Hypothesis,
    facts: dict[str, Any],
    doubt: CalibrationMismatch,
) -> Finding:
    """Return the finding of a contradicted calibration: an uncertain pose, or a refusal."""
    search, text = answer.search, f"the calibration is doubtful: {doubt}"
    # inliers by the wrong camera hide a part of the shift: half of it in `benchmarks/inputs.py`
    half = best.covariance + 0.25 * np.outer(doubt.shift, doubt.shift)
    shifted = WeighedCamera(CameraHypothesis(), 1.0, doubt.shift, half)
    factor = probability_within(search, best, CameraBelief(shifted.hypothesis, [shifted]))
    if factor * pose.probability < search.config.evidence.min_probability:
        return Finding("camera", text, factor, facts, refusal=("too_few_inliers", text))
    covariance = best.covariance + np.outer(doubt.shift, doubt.shift)
    uncertainty = compute_normalized_uncertainty(
        covariance, best.fit.median_depth, search.config.evidence
    )
    evidence = replace(best.evidence, doubt=max(best.evidence.doubt, uncertainty))
    penalized = replace(best, covariance=covariance, evidence=evidence)
    facts["calibration_doubt"] = doubt
    return Finding("camera", text, factor, facts, hypothesis=penalized)


def _undo_rotation(best: Hypothesis, turning: TurningCamera) -> Hypothesis:
    """Return the hypothesis as if all rows had been read with the middle one."""
    fit = best.fit
    points_img = turning.undo(fit.features.points_img, fit.camera)
    covariance = fit.pose.covariance + turning.covariance
    pose = replace(fit.pose, cam_from_world=turning.cam_from_world, covariance=covariance)
    fit = replace(fit, features=replace(fit.features, points_img=points_img), pose=pose)
    return replace(best, fit=fit, covariance=best.covariance + turning.covariance)


def check_threshold(query: MapQuery, answer: Answer) -> Finding | None:
    """Refuse a pose whose probability is below the threshold of the map's certificate, or which
    looks as on another floor."""
    pose, certified = answer.pose, query.opened.topomap.certificate
    if pose is None:
        return None
    least = 0.0 if certified is None else certified.applied_min_probability
    if pose.probability < least:
        text = f"probability {pose.probability:.3g}, below the map's certified threshold"
        text = f"{text} {least:.3g}"
        return Finding("threshold", text, refusal=("too_few_inliers", text))
    if pose.probability < query.opened.config.evidence.min_probability:
        text = "without colours in view nothing tells the look-alike floors apart"
        if (seen := pose.appearance) is not None:
            text = f"the shape agrees, but not the colours, as on another floor ({seen:.2g})"
        return Finding("threshold", text, refusal=("not_in_map", text))
    return None


Check = Callable[[MapQuery, Answer], Finding | None]
CHECKS: tuple[Check, ...] = (
    look_again,
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
