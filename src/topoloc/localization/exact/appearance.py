"""Compare the colours in view with those of the map, because floors of a building look alike.

They share walls, lamps and doors, so a pose on another floor has as many inliers as a right one.
Paint, posters and furniture differ. All points in view are compared, because inliers agree by their
choice. Another light multiplies colours by factors that vary slowly over the image. So logarithms
are correlated, less a quadratic function of the pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from msgspec import Struct

from topoloc.errors import FeatureTypeError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import Finite, decode_json
from topoloc.localization.answer import Answer, Finding
from topoloc.localization.evidence import sample_rows
from topoloc.localization.exact.templates import sample_colours, small_colours
from topoloc.localization.guided import select_visible_points
from topoloc.localization.map_query import MapQuery
from topoloc.localization.search import Search
from topoloc.node_ids import NodeId


class AppearanceWeights(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the fitted weights of the appearance.

    - At least `min_points` points of `num_nodes` nodes are compared. In each of `parts` (columns,
      rows) of the image, points beyond `max_depth` times the nearer ones are hidden. Logarithms of
      colours are at most `max_contrast` from their median. A spread below `noise` says little.
    - The log-odds are `agreement` times the inverse hyperbolic tangent of the correlation, `light`
      times the standard deviation of the change of brightness, and `bias`. Log-odds of the pose
      above the first of `clear_log_odds`, times the second, are added: a room may be painted anew.
    - `floor_odds`: odds of another floor, in most maps and in maps with look-alike floors. The
      log-odds of three places of a stream must exceed theirs by `places_log_odds`, and three times
      the mean of n places by this times the root of 3/n.
    - Red and blue of an image are swapped if the log-odds gain `swapped` then. An image is grey if
      its brightness explains its colours but for `grey` times the noise.
    """

    corpus: str
    date: str
    command: str
    num_nodes: int
    min_points: int
    parts: tuple[int, int]
    max_depth: Finite
    max_contrast: Finite
    noise: Finite
    agreement: Finite
    light: Finite
    bias: Finite
    clear_log_odds: tuple[Finite, Finite]
    floor_odds: tuple[Finite, Finite]
    places_log_odds: tuple[Finite, Finite]
    swapped: Finite
    grey: Finite


SWAP_RED_AND_BLUE: Float[np.ndarray, "3 3"] = np.array(
    [[1.0, 0.0, 0.0], [0.0, 0.5, 0.75], [0.0, 1.0, -0.5]]
)
"""Turns `small_colours` (a row) into those of the image with red and blue swapped."""


@cache
def load_appearance_weights() -> AppearanceWeights:
    """Return the shipped weights. Raises FeatureTypeError: the file is damaged."""
    path = Path(__file__).parent / "appearance.json"
    return decode_json(path.read_bytes(), AppearanceWeights, FeatureTypeError, str(path))


@dataclass(frozen=True)
class ColourAgreement:
    """Hold the correlation of the colours, -1 to 1, the standard deviation of the change of
    brightness, and that of the colours where it is less: in the image or in the map. Red and blue
    of the image may be swapped."""

    correlation: float
    light_change: float
    contrast: float
    is_swapped: bool = False

    def log_odds(self, weights: AppearanceWeights) -> float:
        """Return the log-odds of this floor against another one."""
        correlation = min(max(self.correlation, -0.97), 0.97)
        log_odds = weights.agreement * math.atanh(correlation) + weights.light * self.light_change
        share = self.contrast**2 / (self.contrast**2 + weights.noise**2)
        return share * (log_odds + weights.bias)

    def appearance(self, probability: float, weights: AppearanceWeights) -> float:
        """Return `Localization.appearance` of a pose with this probability without it."""
        known = min(max(probability, 0.5), 0.9999)
        least, slope = weights.clear_log_odds
        clear = slope * max(0.0, math.log(known / (1.0 - known)) - least)
        return 1.0 / (1.0 + math.exp(-self.log_odds(weights) - clear))


def compare_colours(search: Search, points: ShownPoints) -> ColourAgreement | None:
    """Compare the colours of the points in view. None: an image is grey, or few points are.

    An image whose red and blue are swapped, as OpenCV reads it, is compared as if they were not.
    """
    weights = load_appearance_weights()
    in_query = small_colours(search.query.image)
    if in_query is None or len(points.places) < weights.min_points:
        return None
    of_query = sample_colours(in_query, points.places)
    of_map = search.templates(points.node_ids).sample_colours(points.points_world)
    known = np.isfinite(of_map[:, 0])
    if np.count_nonzero(known) < weights.min_points:
        return None
    compared = of_map[known], points.places[known], weights
    found, surely = _correlate(of_query[known], *compared), 0.7  # no others are much better
    if found is None or found.correlation > surely:
        return found
    if _is_grey(of_query[known & ~_is_tinted(search.query.image, points.places)], weights):
        return None
    swapped = _correlate(of_query[known] @ SWAP_RED_AND_BLUE, *compared)
    if swapped is None or swapped.log_odds(weights) < found.log_odds(weights) + weights.swapped:
        return found
    return replace(swapped, is_swapped=True)


def _is_tinted(
    image: UInt8[np.ndarray, "h w 3"], places: Float[np.ndarray, "n 2"]
) -> Bool[np.ndarray, " n"]:
    """Return at which places a share of some channels is saturated, which changes the colour. White
    remains white."""
    brightest, least_share, size = 250, 0.05, (80, 60)
    is_bright = cv2.threshold(image, brightest, 255, cv2.THRESH_BINARY)[1]
    shares = cv2.resize(is_bright, size, interpolation=cv2.INTER_AREA) / 255.0
    columns, rows = np.clip(places * size, 0, np.array(size) - 1).astype(int).T
    return np.ptp(shares, axis=2)[rows, columns] > least_share


@dataclass(frozen=True, eq=False)
class ShownPoints:
    """Hold map points that an image shows, with the nodes whose images show them. Places are
    pixels over the image size."""

    places: Float[np.ndarray, "n 2"]
    points_world: Float[np.ndarray, "n 3"]
    node_ids: Int[np.ndarray, " n"]


def select_shown_points(
    search: Search, node_id: NodeId, world_from_cam: Rigid3, camera: Camera
) -> ShownPoints:
    """Return some of the points in view that no nearer ones hide, of the nodes around a node."""
    weights, opened = load_appearance_weights(), search.map
    # the nodes near a pose beside a bend look past its walls; those of its inliers do not
    seen_from = opened.node_poses.world_from_node(opened.topomap.row_of(node_id))
    nodes = opened.local_maps(opened.nearest(seen_from, weights.num_nodes))
    points_world = np.concatenate([one.points_world for one in nodes])
    cam_from_world = world_from_cam.inverse()
    rows, pixels = select_visible_points(points_world, cam_from_world, camera)
    places = pixels / [camera.width, camera.height]
    depths = cam_from_world.apply(points_world[rows])[:, 2]
    shown = np.flatnonzero(find_shown_points(places, depths))
    if len(shown) > 0:
        shown = shown[sample_rows(len(shown))]
    node_ids = np.concatenate([one.node_ids for one in nodes])
    return ShownPoints(places[shown], points_world[rows[shown]], node_ids[rows[shown]])


def find_shown_points(
    places: Float[np.ndarray, "n 2"], depths: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which points are not hidden by nearer ones. Places are pixels over the image size."""
    weights = load_appearance_weights()
    counts = np.array(weights.parts)
    columns, rows = np.clip(places * counts, 0, counts - 1).astype(int).T
    part = rows * counts[0] + columns
    numbers = np.bincount(part, minlength=int(counts.prod()))
    thin_share = 0.2  # nearer points belong to thin things
    ranks = np.cumsum(numbers) - numbers + (thin_share * numbers).astype(int)
    farthest = 2.0 * depths.max(initial=1e-9)
    nearer = (np.sort(part + depths / farthest)[ranks[part]] - part) * farthest
    return depths <= weights.max_depth * nearer


def _correlate(
    of_query: Float[np.ndarray, "n 3"],
    of_map: Float[np.ndarray, "n 3"],
    places: Float[np.ndarray, "n 2"],
    weights: AppearanceWeights,
) -> ColourAgreement | None:
    """Correlate `small_colours`. None: the image or the map is grey."""
    if _is_grey(of_map, weights):
        return None
    x, y = (2.0 * places - 1.0).T
    slow = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    both = np.column_stack([of_query[:, 1:], of_map[:, 1:]])
    colours = np.clip(both - np.median(both, axis=0), -weights.max_contrast, weights.max_contrast)
    colours -= slow @ np.linalg.lstsq(slow, colours, rcond=None)[0]
    products = np.mean(colours[:, :2] * colours[:, 2:], axis=0)
    variances = np.mean(colours**2, axis=0).reshape(2, 2)
    least_variance = 1e-4  # of the noise of pixels
    correlation = (products / np.sqrt((variances + least_variance).prod(axis=0))).mean()
    light_change = float(np.std(of_query[:, 0] - of_map[:, 0]))
    contrast = math.sqrt(variances.mean(axis=1).min())
    return ColourAgreement(float(correlation), light_change, contrast)


def _is_grey(colours: Float[np.ndarray, "n 3"], weights: AppearanceWeights) -> bool:
    """Return whether the colours follow from the brightness, as those of grey and toned images."""
    if len(colours) < weights.min_points:
        return False
    brightness = colours[:, 0] - colours[:, 0].mean()
    tones = brightness[:, None] ** np.arange(4)
    rest = colours[:, 1:] - tones @ np.linalg.lstsq(tones, colours[:, 1:], rcond=None)[0]
    return float(np.sqrt(np.mean(rest**2))) < weights.grey * weights.noise


def check_colours(query: MapQuery, answer: Answer) -> Finding | None:
    """Compare the colours in view with those of the map. The probability includes that of another
    floor.

    Without colours nothing tells floors apart, and a map with look-alike floors is honest about it.
    In other maps the odds include the colours if pixels weighed the pose.
    """
    found, best, search = answer.pose, answer.best, query.searches[0]
    if found is None or best is None or not search.query.grey.any():  # only features
        return None
    has_look_alikes = search.map.topomap.config.look_alike_floors
    is_weighed = any(one.check == "pixels" and one.answer for one in answer.findings)
    if is_weighed and not has_look_alikes:
        return None
    agreement = None
    if best.evidence.is_of_nodes:
        with search.query.clock.stage("appearance"):
            camera = best.fit.camera
            points = select_shown_points(search, found.node_id, found.world_from_cam, camera)
            agreement = compare_colours(search, points)
    appearance, text = None, "no colours can be compared"
    if agreement is not None:
        # where floors look alike, a clear pose tells no floor
        certainty = 0.0 if has_look_alikes else found.probability
        appearance = agreement.appearance(certainty, load_appearance_weights())
        text = f"the colours agree with this floor with a probability of {appearance:.2g}"
        text += ", with red and blue of the image swapped" if agreement.is_swapped else ""
    share = share_of_this_floor(appearance, has_look_alikes)
    return Finding("colours", text, share, {"appearance": appearance})


def share_of_this_floor(appearance: float | None, has_look_alikes: bool) -> float:
    """Return the factor of the probability that follows from the appearance."""
    if appearance is None:
        appearance = 0.5 if has_look_alikes else 1.0
    others = load_appearance_weights().floor_odds[has_look_alikes] * (1.0 - appearance)
    return appearance / max(appearance + others, 1e-9)
