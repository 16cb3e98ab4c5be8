"""Compare the colours in view with those of the map, because floors of a building look alike.

They share walls, lamps and doors, so a pose on another floor has as many inliers as a right one.
Paint, posters and furniture differ. Points of all nodes near the pose are compared, not only the
inliers, which agree by their choice. Another light multiplies the colours by factors that vary
slowly over the image. So the comparison is of logarithms, less a quadratic function of the pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from msgspec import Struct

from topoloc.errors import FeatureTypeError
from topoloc.json_data import Finite, decode_json
from topoloc.localization.evidence import sample_rows
from topoloc.localization.exact.patch_alignment import sample_colours, small_colours
from topoloc.localization.guided import select_visible_points
from topoloc.localization.result import Localization
from topoloc.localization.search import Search
from topoloc.node_ids import NodeId


class AppearanceWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the weights of the appearance, fitted to images of this floor and of other ones.

    - Points of `num_nodes` nodes are compared, at least `min_points`. Colours farther than
      `max_contrast` (in logarithms) from their median count as that far. `noise` is the standard
      deviation of colours that are no contrast.
    - The log-odds are `agreement` times the inverse hyperbolic tangent of the correlation, `light`
      times the standard deviation of the change of brightness, and `bias`.
    - `floor_odds`: how likely an image is of another floor, relative to this one, in most maps and
      in maps with look-alike floors.
    """

    corpus: str
    date: str
    command: str
    num_nodes: int
    min_points: int
    max_contrast: Finite
    noise: Finite
    agreement: Finite
    light: Finite
    bias: Finite
    floor_odds: tuple[Finite, Finite]


@cache
def load_appearance_weights() -> AppearanceWeights:
    """Return the shipped weights. Raises FeatureTypeError: the file is damaged."""
    path = Path(__file__).parent / "appearance.json"
    return decode_json(path.read_bytes(), AppearanceWeights, FeatureTypeError, str(path))


@dataclass(frozen=True)
class ColourAgreement:
    """Hold the correlation of the colours, -1 to 1, and the standard deviation of the change of
    brightness (natural logarithm)."""

    correlation: float
    light_change: float

    def appearance(self, weights: AppearanceWeights) -> float:
        """Return `Localization.appearance`."""
        log_odds = (
            weights.agreement * math.atanh(min(max(self.correlation, -0.97), 0.97))
            + weights.light * self.light_change
            + weights.bias
        )
        return 1.0 / (1.0 + math.exp(-log_odds))


def compare_colours(search: Search, found: Localization) -> ColourAgreement | None:
    """Compare the colours of the points in view. None: an image is grey, or has one colour."""
    weights, query = load_appearance_weights(), search.query
    in_query = small_colours(query.image)
    if in_query is None:
        return None
    # the nodes near a pose beside a bend look past its walls; those of its inliers do not
    topomap = search.map.topomap
    seen_from = topomap.summaries[topomap.row_of(found.node_id)].world_from_cam
    points = search.map.local_map(search.map.nearest(seen_from, weights.num_nodes))
    cam_from_world = found.world_from_cam.inverse()
    rows, pixels = select_visible_points(points, cam_from_world, query.camera)
    sampled = sample_rows(len(rows)) if len(rows) else rows
    rows, of_map = rows[sampled], np.full((len(sampled), 3), np.nan)
    of_query = sample_colours(in_query, pixels[sampled], query.camera)
    for node_id in np.unique(points.node_ids[rows]):
        template = search.template(NodeId(int(node_id)))
        if template.colours is not None:
            of_node = points.node_ids[rows] == node_id
            in_node = template.world_from_cam.inverse().apply(points.points_world[rows[of_node]])
            at = template.camera.img_from_cam(in_node)
            of_map[of_node] = sample_colours(template.colours, at, template.camera)
    known = np.isfinite(of_map[:, 0]) & np.isfinite(of_query[:, 0])
    if np.count_nonzero(known) < weights.min_points:
        return None
    size = [query.camera.width, query.camera.height]
    x, y = (2.0 * pixels[sampled][known] / size - 1.0).T
    slow = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    return _correlate(of_query[known], of_map[known], slow, weights)


def _correlate(
    of_query: Float[np.ndarray, "n 3"],
    of_map: Float[np.ndarray, "n 3"],
    slow: Float[np.ndarray, "n 6"],
    weights: AppearanceWeights,
) -> ColourAgreement | None:
    """Correlate colours, given as brightness, red over green and blue over yellow."""
    both = np.column_stack([of_query[:, 1:], of_map[:, 1:]])
    contrasts = np.clip(both - np.median(both, axis=0), -weights.max_contrast, weights.max_contrast)
    contrasts -= slow @ np.linalg.lstsq(slow, contrasts, rcond=None)[0]
    variances = np.mean(contrasts**2, axis=0)
    if variances.max() < weights.noise**2:
        return None
    products = np.mean(contrasts[:, :2] * contrasts[:, 2:], axis=0)
    correlations = products / np.sqrt(np.multiply(*np.split(variances + weights.noise**2, 2)))
    light_change = float(np.std(of_query[:, 0] - of_map[:, 0]))
    return ColourAgreement(float(correlations.mean()), light_change)


def weigh_appearance(search: Search, found: Localization) -> Localization:
    """Return the pose with its appearance, which the probability includes.

    Without colours nothing tells floors apart, and a map with look-alike floors is honest about it.
    """
    weights, has_look_alikes = (
        load_appearance_weights(),
        search.map.topomap.config.look_alike_floors,
    )
    agreement = compare_colours(search, found) if found.is_of_nodes else None
    if agreement is None and not has_look_alikes:
        return found
    appearance = None if agreement is None else agreement.appearance(weights)
    this_floor = 0.5 if appearance is None else appearance
    other_floors = weights.floor_odds[has_look_alikes] * (1.0 - this_floor)
    probability = found.probability * this_floor / (this_floor + other_floors)
    return replace(found, appearance=appearance, probability=probability)
