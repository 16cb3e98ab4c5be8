"""Determine if two maps overlap, and the transform between them. Start reading at `compare_tiles`.

Maps of overlapping parts of one recording share images, which give the transform at once.
Otherwise nodes of each map are localized in the other one, the most similar
ones first. Each localization gives an estimate of the transform. A consensus needs enough agreeing
estimates from independent images (`transform_consensus.py`). It must then pass a test on nodes that
would stand near a node of the other map. Nearly all of them must be localized at their expected
pose. Nearly all of their matches before guided search must agree with that pose. The test separates
corridors of the same plan: their shared parts agree to centimetres, but the parts that differ match
something else.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from topoloc.atlas.index import GlobalDescriptors
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.geometry.transform_consensus import (
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.lifelong.node_localization import localize_nodes, sample_evenly
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.nodes import node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row, as_rows


@dataclass(frozen=True, eq=False)
class OpenTile:
    """Hold a tile with its open map and the global descriptors of its nodes."""

    localizer: Localizer
    vectors: GlobalDescriptors

    @property
    def topomap(self) -> TopoMetricMap:
        """Return the tile's map."""
        return self.localizer.topomap

    def world_from_node(self, row: Row) -> Rigid3:
        """Return the pose of the node of a row."""
        return self.topomap.summaries[row].world_from_cam


@dataclass(frozen=True, eq=False)
class TileTransform:
    """Hold the transform between two maps and the evidence for it.

    The covariance belongs to the left perturbation of `first_from_second` (m, rad). `num_agreeing`
    images support the transform. They are images of both maps (`shares_images`), or nodes
    of one map localized in the other. `num_near` nodes should be localized, and `num_recognised` of
    them are. In three quarters of these nodes, at least the share `agreeing` of the matches agrees
    with the pose.
    """

    first_from_second: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    num_agreeing: int
    num_near: int = 0
    num_recognised: int = 0
    agreeing: float = 0.0
    shares_images: bool = False


@dataclass(frozen=True)
class NotJoined:
    """Hold the reason why two tiles are not joined."""

    reason: str


def compare_tiles(
    first: OpenTile,
    second: OpenTile,
    num_probed: int = 8,
    max_queries: int = 32,
    min_near: int = 12,
) -> TileTransform | NotJoined:
    """Return the transform from the second map to the first, if they overlap and the evidence is
    sufficient.

    Args:
        num_probed: number of nodes of each tile that are localized in the other one first. The
            comparison ends if none is localized.
        max_queries: maximum number of nodes of each tile that are localized in each step.
        min_near: minimum number of nodes, of both tiles together, that stand near a node of the
            other tile.

    Raises:
        MapError: a map cannot be read.
        FeatureTypeError, WeightsError: the maps' features cannot be compared on this machine.
    """
    shared = estimate_by_shared_images(first.topomap, second.topomap)
    if shared is not None:
        return TileTransform(*shared, shares_images=True)
    queries = _NodeQueries(first, second), _NodeQueries(second, first)
    common = [kind for kind in first.vectors if kind in second.vectors]
    if not common or not any(one.is_possible for one in queries):
        return NotJoined("their features are not of the same kinds")
    alike = first.vectors[common[-1]] @ second.vectors[common[-1]].T
    for num_queries in (num_probed, max_queries):
        for side, one in enumerate(queries):  # the most similar nodes first
            one.localize(as_rows(np.argsort(-alike.max(axis=side), kind="stable")[:num_queries]))
        if not any(answer is not None for one in queries for answer in one.answers.values()):
            return NotJoined("no node of either is recognised in the other")
    found = _find_consensus(*queries)
    if isinstance(found, NotJoined):
        return found
    shares = list[float | None]()
    for one, pose in zip(queries, (found[0], found[0].inverse()), strict=True):
        near = one.find_nearby_nodes(pose, max_queries)
        one.localize(near)
        shares += one.verify(pose, near)
    return _decide(found, shares, min_near)


def _decide(
    found: _FoundTransform, shares: Sequence[float | None], min_near: int
) -> TileTransform | NotJoined:
    """Return the transform if the nodes that should be localized pass the test. `shares` are their
    shares of agreeing matches, None if a node is not localized at its expected pose."""
    # Minimum share of these nodes that are localized at their expected pose.
    min_recognised = 0.9
    # Minimum share of unguided matches that agree with the pose, in three quarters of these nodes.
    # Another place of the same plan may match as often, but its different parts match something
    # else.
    min_agreeing = 0.75
    num_agreeing, num_near, num_missed = found[2], len(shares), shares.count(None)
    agreeing = float(np.quantile([share or 0.0 for share in shares], 0.25)) if shares else 0.0
    if num_near < min_near:
        fault = f"only {num_near} nodes stand near one of the other tile"
    elif num_near - num_missed < min_recognised * num_near:
        fault = f"{num_missed} of {num_near} nodes that should be recognised are not"
    elif agreeing < min_agreeing:
        fault = f"{1.0 - agreeing:.0%} of what is matched there does not"
    else:
        return TileTransform(*found, num_near, num_near - num_missed, agreeing)
    return NotJoined(f"{num_agreeing} answers agree, but {fault}")


@dataclass(frozen=True, eq=False)
class _NodeQueries:
    """Localize nodes of the tile `source` in the tile `target`. `answers` holds the localizations
    so far by row, None if a node is not localized."""

    target: OpenTile
    source: OpenTile
    answers: dict[Row, Localization | None] = field(default_factory=dict)

    @property
    def is_possible(self) -> bool:
        """Return whether the source has all feature types of the target."""
        return set(self.target.topomap.kinds) <= set(self.source.topomap.kinds)

    def localize(self, rows: Sequence[Row]) -> None:
        """Localize nodes, if that is possible and not done before."""
        if self.is_possible:
            new = [row for row in rows if row not in self.answers]
            self.answers.update(localize_nodes(self.target.localizer, self.source.topomap, new))

    def estimate_node_transforms(self) -> Iterator[tuple[Row, Row, Rigid3, np.ndarray, int]]:
        """Yield for each localized node its row, the row of the node of the target that it matches
        best, the transform to that node with its covariance, and the number of inliers."""
        # Factor applied to the sigmas of the localizations, because neighbours share
        # errors of the map.
        widened = 3.0
        sigma = 0.01  # additional position sigma of a localization, in metres
        sigma_deg = 0.2  # additional rotation sigma of a localization, in degrees
        for row, result in self.answers.items():
            if result is not None:
                matched = self.target.topomap.row_of(result.node_id)
                node_from_world = self.target.world_from_node(matched).inverse()
                covariance = widened**2 * node_from_world.transform_covariance(result.covariance)
                covariance = covariance + diagonal_covariance(sigma, sigma_deg)
                pose = node_from_world @ result.world_from_cam
                yield row, matched, pose, covariance, result.num_inliers

    def find_nearby_nodes(self, target_from_source: Rigid3, max_queries: int) -> list[Row]:
        """Return nodes that the transform puts near a node of the target. At most `max_queries` are
        chosen, evenly spaced."""
        # A node must be localized if it is within this many D_thresh (distance of Eq. 1)
        # of a node of the other tile.
        max_distance = 3.0
        config, poses = self.target.topomap.config, self.target.topomap.node_poses
        moved = (target_from_source @ one.world_from_cam for one in self.source.topomap.summaries)
        apart = [node_distances(pose, poses, config.lambda_rot).min() for pose in moved]
        near = np.flatnonzero(np.array(apart) <= max_distance * config.d_thresh)
        return sample_evenly(as_rows(near), max_queries)

    def verify(self, target_from_source: Rigid3, rows: Sequence[Row]) -> list[float | None]:
        """Return the share of unguided matches that agree with the pose, for each node that was
        queried. It is None if the node is not localized at its expected pose."""
        max_m, shares = 0.3 * self.target.topomap.config.d_thresh, list[float | None]()
        for row in rows:
            if row in self.answers:
                result, expected = self.answers[row], self.source.world_from_node(row)
                limits = target_from_source @ expected, max_m, math.radians(2.0)
                share = None
                if result is not None and result.world_from_cam.is_same(*limits):
                    evidence = result.evidence
                    share = evidence.num_inliers / max(evidence.num_matches, 1) if evidence else 0.0
                shares.append(share)
        return shares


_FoundTransform = tuple[Rigid3, Float[np.ndarray, "6 6"], int]
"""first_from_second, the covariance of its left perturbation (m, rad), and the number of
observations that agree."""


def _find_consensus(in_first: _NodeQueries, in_second: _NodeQueries) -> _FoundTransform | NotJoined:
    """Return the transform between the tiles that most localizations agree on."""
    steps = [
        (matched, row, pose, covariance, num_inliers)
        for row, matched, pose, covariance, num_inliers in in_first.estimate_node_transforms()
    ]
    steps += [
        (row, matched, pose.inverse(), inverse_covariance(pose, covariance), num_inliers)
        for row, matched, pose, covariance, num_inliers in in_second.estimate_node_transforms()
    ]
    first, second = in_first.target, in_second.target
    found = _find_common_transform(
        [
            (first.world_from_node(a), second.world_from_node(b), pose, covariance)
            for a, b, pose, covariance, _ in steps
        ],
        int(np.argmax([num_inliers for *_, num_inliers in steps])),
        np.array([(a, b) for a, b, *_ in steps]),
    )
    if found is None:
        return NotJoined(f"{len(steps)} nodes are recognised, but do not agree")
    return found


def _find_common_transform(
    observations: Sequence[tuple[Rigid3, Rigid3, Rigid3, np.ndarray]],
    reference: int,
    pairs: Int[np.ndarray, "n 2"] | None = None,
) -> _FoundTransform | None:
    """Return the transform between two maps that most observations agree on.

    An observation holds the poses of a camera in the first map and of one in the second, and the
    transform between these cameras with its covariance. All are moved to the cameras of the
    observation `reference`. `pairs` are the nodes of each observation, if they may repeat.
    """
    one, other, *_ = observations[reference]
    estimates = [
        propagate_estimate(
            one.inverse() @ a, pose, covariance, b.inverse() @ other, drift=0.01, drift_deg=0.1
        )
        for a, b, pose, covariance in observations
    ]
    poses, covariances = zip(*estimates, strict=True)
    consensus = find_consensus(list(poses), np.stack(covariances), pairs, rival_share=0.34)
    if consensus is None:
        return None
    return *consensus.between(one, other.inverse()), int(np.count_nonzero(consensus.is_inlier))


def estimate_by_shared_images(
    first: TopoMetricMap, second: TopoMetricMap
) -> _FoundTransform | None:
    """Estimate first_from_second (metres) from the images that both maps contain.

    Because of noise, two images of a camera are never identical. So maps with identical images show
    the same place, even if other places look similar. Return first_from_second, the covariance of
    its left perturbation (m, rad), and the number of images that agree. Return None if the maps
    share too few images or the images do not agree.
    """
    max_images = 200  # evenly spaced
    sigma_m, sigma_deg = 0.01, 0.1  # of the transform between the maps as one image gives it
    here, there = _image_poses(first), _image_poses(second)
    shared = sample_evenly(sorted(here.keys() & there.keys()), max_images)
    if not shared:
        return None
    covariance = diagonal_covariance(sigma_m, sigma_deg)
    observations = [(here[one], there[one], Rigid3.identity(), covariance) for one in shared]
    return _find_common_transform(observations, len(shared) // 2)


def _image_poses(topomap: TopoMetricMap) -> dict[tuple[str, bytes], Rigid3]:
    """Return world_from_cam of each mapping image by its name and bytes. Images that occur several
    times are left out, such as images of a covered camera."""
    images = [(image.name, image.jpeg, image.world_from_cam) for image in topomap.place_images]
    times = Counter(jpeg for _, jpeg, _ in images)
    return {(name, jpeg): pose for name, jpeg, pose in images if times[jpeg] == 1}
