"""Explain a result: the tried pose proposals, their evidence, and advice."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from topoloc import (
    Camera,
    Finding,
    Illumination,
    Image,
    Localization,
    Localizer,
    NotLocalized,
    Rigid3,
    Trace,
    TriedProposal,
    UncalibratedCamera,
)
from topoloc.apps.core_names import Deadline

_MIN_FEATURES, _MIN_PROBABILITY = 150, 0.5
_DARKER, _BRIGHTER = 0.6, 1.7  # times the light of the nearest session
# From the nearest node: degrees, and multiples of D_thresh.
_MAX_VIEW_ANGLE_DEG, _MAX_NODE_DISTANCE = 25.0, 4.0
_SAME_POSITION_M, _SAME_ROTATION = 0.3, math.radians(3.0)


@dataclass(frozen=True, eq=False)
class EvaluatedPose:
    """A pose proposal and its outcome. `probability` compares it with "nowhere in the map" only."""

    tried: TriedProposal
    probability: float | None
    verdict: str

    @property
    def node_id(self) -> int:
        """The node with the most inliers, -1 without inliers."""
        return self.tried.fit.node_id

    @property
    def num_inliers(self) -> int:
        """Number of inliers."""
        return self.tried.fit.num_inliers


@dataclass(frozen=True, eq=False)
class Explanation:
    """`poses` are in the order in which they were tried. The most important `advice` is first.
    `findings` are those of the checks of the likeliest pose, in order. `nodes_without_image` are
    nodes whose image was needed, and is missing or damaged."""

    result: Localization | NotLocalized
    num_features: dict[str, int]
    light: Illumination
    session_lights: dict[str, Illumination]
    poses: list[EvaluatedPose]
    advice: list[str]
    nodes_without_image: list[int]
    findings: list[Finding]

    @property
    def best(self) -> EvaluatedPose | None:
        """The pose with the highest odds, else the one with the most inliers."""
        weighed = [(p.tried.hypothesis.log_odds, p) for p in self.poses if p.tried.hypothesis]
        if weighed:
            return max(weighed, key=lambda pair: pair[0])[1]
        found = [pose for pose in self.poses if pose.tried.world_from_cam]
        return max(found, key=lambda pose: pose.num_inliers, default=None)


def explain(
    localizer: Localizer,
    image: Image,
    camera: Camera | UncalibratedCamera | None,
    deadline: Deadline | None = None,
) -> Explanation:
    """Localize an image until a deadline and explain the result. Raises the errors of
    `Localizer.localize`."""
    trace = Trace()
    result = localizer.localize(image, camera, max_ms=deadline, trace=trace)
    poses = [_evaluate_pose(tried, result) for tried in trace.tried]
    near = {pose.tried.fit.node_id for pose in poses if pose.num_inliers and pose.node_id >= 0}
    templates = zip(near, localizer.context.first.map.templates(near), strict=True)
    without = trace.nodes_without_image | {one for one, image in templates if image.is_black}
    num_features = {pose.tried.features: len(pose.tried.fit.features) for pose in poses}
    lights = {
        f"{session.session_id} ({session.name})": session.light
        for session in localizer.topomap.sessions
        if session.light is not None
    }
    light = Illumination.of_image(image)
    facts = Explanation(
        result, num_features, light, lights, poses, [], sorted(without), trace.findings
    )
    return replace(facts, advice=list(dict.fromkeys(_collect_advice(facts, localizer))))


def explanation_to_json(name: str, explanation: Explanation) -> dict[str, Any]:
    """Return the result for the image `name`, with all tried proposals and the advice, as JSON."""
    poses = [
        {
            "source": pose.tried.source,
            "features": pose.tried.features,
            "node": pose.node_id if pose.node_id >= 0 else None,
            "num_first_matches": len(pose.tried.first.matches),
            "num_first_inliers": pose.tried.first.num_inliers,
            "probability": pose.probability,
            "verdict": pose.verdict,
        }
        for pose in explanation.poses
    ]
    return explanation.result.to_json(name) | {
        "advice": explanation.advice,
        "checks": [
            {
                "check": finding.check,
                "finding": finding.text,
                "factor": finding.factor,
                "refused": finding.refusal is not None,
            }
            for finding in explanation.findings
        ],
        "nodes_without_image": explanation.nodes_without_image,
        "num_features": explanation.num_features,
        "tried": poses,
    }


def _evaluate_pose(tried: TriedProposal, result: Localization | NotLocalized) -> EvaluatedPose:
    if tried.hypothesis is not None:
        probability = tried.hypothesis.probability
        verdict = _verdict(tried.hypothesis.world_from_cam, probability, result)
        return EvaluatedPose(tried, probability, verdict)
    if tried.world_from_cam is None:
        verdict = f"no pose: the {len(tried.fit.matches)} matches agree on none"
    elif tried.refined is None:
        verdict = "the same as an earlier pose"
    else:
        verdict = f"rejected: only {tried.refined.num_inliers} points were found again"
    return EvaluatedPose(tried, None, verdict)


def _verdict(
    world_from_cam: Rigid3, probability: float, result: Localization | NotLocalized
) -> str:
    is_localized = isinstance(result, Localization)
    others = [result] if is_localized else result.alternatives
    if any(
        world_from_cam.is_same(other.world_from_cam, _SAME_POSITION_M, _SAME_ROTATION)
        for other in others
    ):
        return "the answer" if is_localized else "one of the alternatives"
    if probability < _MIN_PROBABILITY:
        return "rejected: the evidence against it is stronger"
    if is_localized:
        return "less probable than the answer"
    doubtful = "calibration" in result.detail
    return "likely, but its calibration is doubtful" if doubtful else "likely, but not certain"


def _collect_advice(explanation: Explanation, localizer: Localizer) -> Iterator[str]:
    result, best = explanation.result, explanation.best
    refused = isinstance(result, NotLocalized)
    if not refused and result.calibration_doubt is not None:
        yield f"The calibration is doubtful: {result.calibration_doubt}."
    if refused and result.detail:
        yield f"{result.detail[0].upper()}{result.detail[1:]}."
    if refused and len(result.alternatives) > 1:
        nodes = " and ".join(str(other.node_id) for other in result.alternatives[:3])
        yield (
            f"Nodes {nodes} look alike. Use a stream (`--stream`) or an approximate pose as prior."
        )
    yield from _advice_on_image(explanation)
    hypothesis = None if best is None else best.tried.hypothesis
    if best is not None and hypothesis is not None:
        if refused and hypothesis.probability < _MIN_PROBABILITY:
            evidence = hypothesis.evidence
            yield (
                f"The most likely place is near node {best.node_id}, but only {evidence.num_found}"
                f" of the {evidence.num_visible} points that must be visible were found."
            )
            yield (
                "The image may be out of the map. Or the place changed, or the map lacks this view"
                " or light."
            )
        yield from _advice_on_viewpoint(hypothesis.world_from_cam, localizer)
    elif refused:
        yield (
            "No part of the map is similar enough to this image. The image may be out of the map,"
            " or the place changed."
        )
    if without := explanation.nodes_without_image:
        nodes = ", ".join(map(str, without[:5])) + (", ..." if len(without) > 5 else "")
        yield (
            f"Images of nodes that are missing or damaged: {len(without)} (nodes {nodes}). This"
            " makes the pose less exact. `topoloc info MAP --check` names the damage."
        )
    for kind, reason in localizer.unavailable_types.items():
        yield f"The map's features {kind}, for other light, were not used: {reason}."
    if refused and len(localizer.topomap.kinds) == 1 and not localizer.unavailable_types:
        yield (
            f"The map has {localizer.topomap.kind} features only. `topoloc build --features both`"
            " works in more kinds of light."
        )


def _advice_on_image(explanation: Explanation) -> Iterator[str]:
    for kind, count in explanation.num_features.items():
        if count < _MIN_FEATURES:
            cause = "the image is blurred, blank or very dark"
            yield f"Only {count} features ({kind}) were found: {cause}."
    if explanation.session_lights:
        grey = explanation.light.level
        name, nearest = min(
            explanation.session_lights.items(),
            key=lambda pair: abs(math.log((pair[1].level + 0.02) / (grey + 0.02))),
        )
        ratio = (grey + 0.02) / (nearest.level + 0.02)
        if ratio < _DARKER or ratio > _BRIGHTER:
            word = "darker" if ratio < 1.0 else "brighter"
            greys = f"mean grey {grey:.2f}; nearest is session {name} with {nearest.level:.2f}"
            yield f"It is {word} than any session of the map ({greys})."


def _advice_on_viewpoint(world_from_cam: Rigid3, localizer: Localizer) -> Iterator[str]:
    """Compare the pose with the nodes of the map."""
    opened = localizer.context.first.map
    nodes, d_thresh = opened.node_poses, opened.d_thresh
    distances = np.linalg.norm(nodes.centres - world_from_cam.translation, axis=1)
    nearest, reach = float(distances.min()), _MAX_NODE_DISTANCE * d_thresh
    cosines = nodes.rotations[:, :, 2] @ world_from_cam.rotation[:, 2]
    near = distances < max(reach, 1.5 * nearest)
    angle = math.degrees(math.acos(min(1.0, float(cosines[near].max()))))
    if nearest > reach:
        yield (
            f"It was taken {nearest:.1f} m from the nearest node. The nodes are about"
            f" {d_thresh:.1f} m apart."
        )
    if angle > _MAX_VIEW_ANGLE_DEG:
        yield f"Its viewing direction is {angle:.0f} degrees from any view of the map there."
