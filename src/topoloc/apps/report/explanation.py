"""Why a picture got this answer, or none: what was tried, what spoke for it, and what would
help."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from topoloc import (
    Camera,
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

_MIN_FEATURES, _MIN_PROBABILITY = 150, 0.5
_DARKER, _BRIGHTER = 0.6, 1.7  # times the light of the nearest session
_MAX_VIEW_ANGLE_DEG, _MAX_NODE_DISTANCE = (
    25.0,
    4.0,
)  # from the nearest node: degrees, and so many D_thresh
_SAME_POSITION_M, _SAME_ROTATION = 0.3, math.radians(3.0)


@dataclass(frozen=True, eq=False)
class EvaluatedPose:
    """One first pose and what became of it. `probability` is that of it against "nowhere"
    alone."""

    tried: TriedProposal
    probability: float | None
    verdict: str


@dataclass(frozen=True, eq=False)
class Explanation:
    """`advice` is what would help, the most telling first; `poses` are in the order in which they
    were tried."""

    result: Localization | NotLocalized
    num_features: dict[str, int]
    light: Illumination
    session_lights: dict[str, Illumination]
    poses: list[EvaluatedPose]
    advice: list[str]

    @property
    def best(self) -> EvaluatedPose | None:
        """What has most for it."""
        likely = [pose for pose in self.poses if pose.probability is not None]
        found = [pose for pose in self.poses if pose.tried.world_from_cam]
        by_odds = max(
            likely,
            key=lambda pose: pose.tried.hypothesis.log_odds if pose.tried.hypothesis else -math.inf,
            default=None,
        )
        return by_odds or max(found, key=lambda pose: pose.tried.fit.num_inliers, default=None)


def explain(
    localizer: Localizer, image: Image, camera: Camera | UncalibratedCamera | None
) -> Explanation:
    """Localize a picture, and say why it came out so. Raises as `Localizer.localize` does."""
    trace = Trace()
    result = localizer.localize(image, camera, trace=trace)
    poses = [_evaluate_pose(tried, result) for tried in trace.tried]
    num_features = {pose.tried.features: len(pose.tried.fit.features) for pose in poses}
    lights = {
        f"{session.session_id} ({session.name})": session.light
        for session in localizer.topomap.sessions
        if session.light is not None
    }
    unsaid = Explanation(result, num_features, Illumination.of_image(image), lights, poses, [])
    advice = list(dict.fromkeys(_collect_advice(unsaid, localizer)))
    return Explanation(result, num_features, unsaid.light, lights, poses, advice)


def explanation_to_json(name: str, explanation: Explanation) -> dict[str, Any]:
    """The result of the picture of this name with all that was tried for it, as JSON."""
    poses = [
        {
            "source": pose.tried.source,
            "features": pose.tried.features,
            "node": pose.tried.fit.node_id if pose.tried.fit.node_id >= 0 else None,
            "num_first_matches": len(pose.tried.first.matches),
            "num_first_inliers": pose.tried.first.num_inliers,
            "probability": pose.probability,
            "verdict": pose.verdict,
        }
        for pose in explanation.poses
    ]
    return explanation.result.to_json(name) | {
        "advice": explanation.advice,
        "num_features": explanation.num_features,
        "tried": poses,
    }


def _evaluate_pose(tried: TriedProposal, result: Localization | NotLocalized) -> EvaluatedPose:
    if tried.hypothesis is not None:
        probability = tried.hypothesis.probability
        return EvaluatedPose(
            tried, probability, _verdict(tried.hypothesis.world_from_cam, probability, result)
        )
    if tried.world_from_cam is None:
        return EvaluatedPose(
            tried, None, f"no pose: the {len(tried.fit.matches)} matches agree on none"
        )
    if tried.refined is None and tried.source != "walls":
        return EvaluatedPose(tried, None, "the same as one that was found already")
    return EvaluatedPose(tried, None, "hopeless: far too little of what must be in view was found")


def _verdict(
    world_from_cam: Rigid3, probability: float, result: Localization | NotLocalized
) -> str:
    if isinstance(result, Localization) and world_from_cam.is_same(
        result.world_from_cam, _SAME_POSITION_M, _SAME_ROTATION
    ):
        return "the answer"
    if any(
        world_from_cam.is_same(other.world_from_cam, _SAME_POSITION_M, _SAME_ROTATION)
        for other in getattr(result, "alternatives", ())
    ):
        return "one of the alternatives"
    if probability < _MIN_PROBABILITY:
        return "lost: more speaks against it than for it"
    if isinstance(result, Localization):
        return "lost: the answer has more for it"
    return (
        "likely, but its calibration is doubtful"
        if "calibration" in result.detail
        else "likely, but not beyond doubt"
    )


def _collect_advice(explanation: Explanation, localizer: Localizer) -> Iterator[str]:
    """What would help, in words."""
    result = explanation.result
    if isinstance(result, Localization) and result.calibration_doubt is not None:
        yield f"The calibration is doubtful: {result.calibration_doubt}."
    if isinstance(result, NotLocalized) and result.detail:
        yield f"{result.detail[0].upper()}{result.detail[1:]}."
    yield from _advice_on_alternatives(result)
    yield from _advice_on_image(explanation)
    best = explanation.best
    if best is not None and best.tried.hypothesis is not None:
        evidence = best.tried.hypothesis.evidence
        if (
            isinstance(result, NotLocalized)
            and best.tried.hypothesis.probability < _MIN_PROBABILITY
        ):
            found = (
                f"{evidence.num_found} of the {evidence.num_visible} points that must be in view"
                " there"
            )
            yield (
                f"The likeliest place is near node {best.tried.fit.node_id}, but only {found}"
                " were found."
            )
            yield (
                "It may be elsewhere, changed, or seen from a side or in a light that the map does"
                " not hold."
            )
        yield from _advice_on_viewpoint(best.tried.hypothesis.world_from_cam, localizer)
    elif isinstance(result, NotLocalized):
        yield (
            "No part of the map looks enough like this picture: it may be of somewhere else, or of"
            " something that changed."
        )
    for kind, lacking in localizer.unavailable_types.items():
        yield f"The map's features {kind}, made for other light, were not asked: {lacking}."
    if (
        isinstance(result, NotLocalized)
        and len(localizer.topomap.kinds) == 1
        and not localizer.unavailable_types
    ):
        yield (
            f"The map holds features {localizer.topomap.kind} alone; `topoloc build --features"
            " both` sees in more kinds of light."
        )


def _advice_on_alternatives(result: Localization | NotLocalized) -> Iterator[str]:
    if isinstance(result, NotLocalized) and len(result.alternatives) > 1:
        nodes = " and ".join(str(other.node_id) for other in result.alternatives[:3])
        yield (
            f"The place repeats itself: nodes {nodes} look alike. A stream (`--stream`) or a rough"
            " prior pose tells them apart."
        )


def _advice_on_image(explanation: Explanation) -> Iterator[str]:
    for kind, count in explanation.num_features.items():
        if count < _MIN_FEATURES:
            yield (
                f"Only {count} features ({kind}) were found: the picture is blurred, blank or very"
                " dark."
            )
    if explanation.session_lights:
        grey = explanation.light.level
        name, nearest = min(
            explanation.session_lights.items(),
            key=lambda pair: abs(math.log((pair[1].level + 0.02) / (grey + 0.02))),
        )
        ratio = (explanation.light.level + 0.02) / (nearest.level + 0.02)
        if ratio < _DARKER or ratio > _BRIGHTER:
            word = "darker" if ratio < 1.0 else "brighter"
            greys = f"mean grey {grey:.2f}; nearest is session {name} with {nearest.level:.2f}"
            yield f"It is {word} than any session of the map ({greys})."


def _advice_on_viewpoint(world_from_cam: Rigid3, localizer: Localizer) -> Iterator[str]:
    """How far the pose is from what the map has seen."""
    opened = localizer.context.first.map
    nodes, d_thresh = opened.node_poses, opened.d_thresh
    ways = np.linalg.norm(nodes.centres - world_from_cam.translation, axis=1)
    cosines = nodes.rotations[:, :, 2] @ world_from_cam.rotation[:, 2]
    near = ways < max(_MAX_NODE_DISTANCE * d_thresh, float(ways.min()) * 1.5)
    turn = math.degrees(math.acos(min(1.0, float(cosines[near].max()))))
    if float(ways.min()) > _MAX_NODE_DISTANCE * d_thresh:
        yield (
            f"It was taken {ways.min():.1f} m from the nearest node; nodes here are about"
            f" {d_thresh:.1f} m apart."
        )
    if turn > _MAX_VIEW_ANGLE_DEG:
        yield f"It looks {turn:.0f} degrees away from any view that the map holds there."
