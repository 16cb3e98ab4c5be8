"""Weigh poses that are not clear by the pixels of all points in view.

Key points change with the view and the light, and those of a pose agree by its choice. So the
patches of all points that the image must show are correlated with the images of their nodes, at
their predicted pixels and, for control, a third of the image away. At a right pose many correlate,
fewer from another direction. In another place few do. In a place that looks alike, such as another
floor, many do, but their colours differ. Pixels weigh a pose against "not in the map" only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from msgspec import Struct

from topoloc.errors import FeatureTypeError
from topoloc.json_data import Finite, decode_json
from topoloc.localization.answer import Answer, Finding, lead
from topoloc.localization.belief import Belief, Hypothesis, agree_on_pose
from topoloc.localization.exact.appearance import (
    compare_colours,
    load_appearance_weights,
    select_shown_points,
)
from topoloc.localization.exact.patch_alignment import (
    correlate,
    load_last_step_weights,
    predict_patches,
)
from topoloc.localization.map_query import MapQuery
from topoloc.localization.result import NotLocalized
from topoloc.localization.search import Search


class PixelWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the fitted weights of the pixels.

    - Of each feature type, `max_hypotheses` with log-odds above `min_log_odds` are weighed. At
      least `min_points` points must have texture. A patch is found if it correlates by
      `min_correlation` within `reach_px` of its predicted pixel.
    - The log-odds are `place` times those of the place (`FittedWeights.place_log_odds`), `found`
      times the logarithm of the share of found patches, less the share by chance, `angle` times
      the median angle between the rays of the node and of the camera to a point (radians, at most
      `max_angle`), `colours` times those of the colours of the same points
      (`ColourAgreement.log_odds`, at most `max_colours` either way, 0 for grey images), and
      `bias`. They differ by `max_gain` or `max_loss` from those without pixels.
    """

    corpus: str
    date: str
    command: str
    max_hypotheses: int
    min_log_odds: Finite
    min_points: int
    min_correlation: Finite
    reach_px: int
    place: Finite
    found: Finite
    angle: Finite
    max_angle: Finite
    colours: Finite
    max_colours: Finite
    bias: Finite
    max_gain: Finite
    max_loss: Finite


@cache
def load_pixel_weights() -> PixelWeights:
    """Return the shipped weights. Raises FeatureTypeError: the file is damaged."""
    path = Path(__file__).parent / "pixels.json"
    return decode_json(path.read_bytes(), PixelWeights, FeatureTypeError, str(path))


@dataclass(frozen=True)
class PixelAgreement:
    """Hold how the pixels around points in view agree with the nodes' images.

    `found` and `by_chance` are shares of the patches with texture, at their predicted pixels and a
    third of the image away. `angle` (radians) is the median change of the viewing direction.
    `colours` are the log-odds of the colours.
    """

    found: float
    by_chance: float
    angle: float
    colours: float

    def inputs(self, weights: PixelWeights) -> tuple[float, float, float]:
        """Return the inputs of the regression."""
        # finite without any patch found
        found = math.log(max(self.found - self.by_chance, 0.0) + 0.01)
        colours = min(max(self.colours, -weights.max_colours), weights.max_colours)
        return found, min(self.angle, weights.max_angle), colours

    def log_odds(self, place_log_odds: float, weights: PixelWeights) -> float:
        """Return the log-odds of a pose with these log-odds of its place."""
        factors = weights.found, weights.angle, weights.colours
        by_pixels = sum(w * x for w, x in zip(factors, self.inputs(weights), strict=True))
        return weights.place * place_log_odds + by_pixels + weights.bias

    def explain(self, log_odds: float, gain: float) -> str:
        """Return the text of the finding about a pose with these log-odds."""
        return (
            f"of the points in view {self.found:.0%} look as in the map, {self.by_chance:.0%} by"
            f" chance, from {math.degrees(self.angle):.0f} degrees aside: log odds"
            f" {log_odds:.1f} -> {log_odds + gain:.1f}"
        )


def select_unclear(search: Search) -> list[Hypothesis]:
    """Return the likeliest hypotheses of nodes that are not clear, at most `max_hypotheses`."""
    weights = load_pixel_weights()
    unclear = [
        one
        for one in search.belief.of_nodes
        if one.log_odds > weights.min_log_odds
        and not search.weights.for_evidence(one.evidence).is_clear(one.log_odds)
    ]
    return unclear[: weights.max_hypotheses]


def measure_pixels(search: Search, hypothesis: Hypothesis) -> PixelAgreement | None:
    """Compare the pixels around the points in view. None: too few points have texture."""
    weights, last_step = load_pixel_weights(), load_last_step_weights()
    camera, world_from_cam = hypothesis.fit.camera, hypothesis.world_from_cam
    shown = select_shown_points(search, hypothesis.fit.node_id, world_from_cam, camera)
    if len(shown.places) < weights.min_points:
        return None
    templates, grey = search.templates(shown.node_ids), search.query.grey
    points = shown.points_world
    patches = predict_patches(points, templates, world_from_cam.inverse(), camera)
    size = np.array([camera.width, camera.height])
    moved = replace(patches, predicted=np.mod(patches.predicted + size / 3.0, size))
    there, elsewhere = (
        correlate(grey, one, weights.reach_px, last_step)[1] for one in (patches, moved)
    )
    rays = points - templates.origins, points - world_from_cam.translation
    lengths = np.prod([np.linalg.norm(one, axis=1) for one in rays], axis=0)
    angles = np.arccos(np.clip(np.sum(rays[0] * rays[1], axis=1) / lengths, -1.0, 1.0))
    there[angles > math.pi / 2.0] = np.nan  # a node's surface is not seen from behind
    has_texture = np.isfinite(there)
    if np.count_nonzero(has_texture) < weights.min_points:
        return None
    found, by_chance = (
        np.count_nonzero(one > weights.min_correlation) / max(np.count_nonzero(np.isfinite(one)), 1)
        for one in (there, elsewhere)
    )
    colours = compare_colours(search, shown)
    by_colours = 0.0 if colours is None else colours.log_odds(load_appearance_weights())
    return PixelAgreement(found, by_chance, float(np.median(angles[has_texture])), by_colours)


def weigh_pixels(query: MapQuery, answer: Answer) -> Finding | None:
    """Weigh the pose of an answer that is not clear, or the hypotheses of a refusal, by pixels.

    If a prior pose limits the search, a similar place may stand there, and the refusal remains. If
    feature types find different poses, it remains as well.
    """
    first, pose, best = query.searches[0], answer.pose, answer.best
    if query.prior is not None or first.query.deadline.is_past or not first.query.grey.any():
        return None
    if isinstance(answer.result, NotLocalized) and answer.result.reason == "ambiguous":
        return None
    if pose is not None and best is not None:
        weights = answer.search.weights.for_evidence(best.evidence)
        if not best.evidence.is_of_nodes or weights.is_clear(best.log_odds):
            return None
    with first.query.clock.stage("pixels"):
        asked = query.searches if pose is None else [answer.search]
        looked = [found for search in asked if (found := _weigh(search)) is not None]
    if not looked:
        return None
    found, text = max(looked, key=lambda one: one[0].pose.probability if one[0].pose else 0.0)
    leading = [one.best for one, _ in looked if one.pose is not None and one.best is not None]
    if not all(agree_on_pose(leading[0], one, first.config.evidence) for one in leading):
        return Finding("pixels", f"{text}, but feature types disagree")
    return Finding("pixels", text, answer=found if found.pose or pose else None)


def _weigh(search: Search) -> tuple[Answer, str] | None:
    """Return the answer of a search by pixels and the text of its likeliest hypothesis. None: there
    is nothing to weigh."""
    weights = load_pixel_weights()
    looked = list[tuple[Hypothesis, float, str]]()
    for one in select_unclear(search):
        agreement = measure_pixels(search, one)
        if agreement is not None:
            log_odds = agreement.log_odds(search.weights.place_log_odds(one.evidence), weights)
            gain = float(np.clip(log_odds - one.log_odds, -weights.max_loss, weights.max_gain))
            looked.append((one, gain, agreement.explain(one.log_odds, gain)))
    if not looked:
        return None
    measured = {id(one): gain for one, gain, _ in looked}
    rivals = [(one, measured.get(id(one), 0.0)) for one in search.belief.of_nodes]
    gains = {id(one): gain for one, gain in _keep_apart(rivals)}
    belief = Belief()
    for one in search.belief.hypotheses:
        weighed = replace(one, log_odds=one.log_odds + gains.get(id(one), 0.0))
        belief = belief.with_hypothesis(weighed, search.config.evidence, search.weights.rivals)
    text = max(looked, key=lambda one: one[0].log_odds + one[1])[2]
    return lead(replace(search, belief=belief)), text


def _keep_apart(looked: Sequence[tuple[Hypothesis, float]]) -> list[tuple[Hypothesis, float]]:
    """Return the gains. Poses that all pass get the least one, for pixels do not tell them
    apart. That of a pose that shows too few points is 0."""
    passing = [gain for one, gain in looked if one.log_odds + gain > 0.0]
    least = min(passing, default=0.0)
    return [(one, least if one.log_odds + gain > 0.0 else gain) for one, gain in looked]
