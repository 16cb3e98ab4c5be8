"""Determine if two maps overlap, and the transform between them. Start reading at `compare_tiles`.

Maps of overlapping parts of one recording share images, which give the transform at once
(`shared_images.py`). Otherwise nodes of each map are localized in the other one, the most similar
ones first. Each localization gives an estimate of the transform. A consensus needs enough agreeing
estimates from independent images (`transform_consensus.py`). It must then pass a test on nodes that
would stand near a node of the other map. Nearly all of them must be localized at their expected
pose. Nearly all of their matches before guided search must agree with that pose. The test separates
corridors of the same plan: their shared parts agree to centimetres, but the parts that differ match
something else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.atlas.global_descriptors import GlobalDescriptors
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.geometry.transform_consensus import (
    TransformConsensus,
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.lifelong.node_localization import localize_nodes, sample_evenly
from topoloc.lifelong.tiles.shared_images import estimate_by_shared_images
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
    images support the transform. They are images of both maps (`is_from_shared_images`), or nodes
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
    is_from_shared_images: bool = False


@dataclass(frozen=True)
class NotJoined:
    """Hold the reason why two tiles are not joined."""

    reason: str


@dataclass(frozen=True, eq=False)
class _Answer:
    """Hold the localization of node `queried` of one map in the other map, whose nearest match is
    node `matched_row`."""

    queried: Row
    matched_row: Row
    result: Localization


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
        FeatureTypeError, MissingExtraError, WeightsError: the maps' features cannot be compared on
            this machine.
    """
    shared = estimate_by_shared_images(first.topomap, second.topomap)
    if shared is not None:
        return TileTransform(*shared, is_from_shared_images=True)
    is_of_kinds = any(
        set(one.topomap.kinds) <= set(other.topomap.kinds)
        for one, other in ((first, second), (second, first))
    )
    if not is_of_kinds or not first.vectors.keys() & second.vectors.keys():
        return NotJoined("their features are not of the same kinds")
    return _Comparison(first, second).verdict(num_probed, max_queries, min_near)


class _Comparison:
    """Hold two tiles and the localizations so far of each tile's nodes in the other, by row. None
    if a node is not localized."""

    def __init__(self, first: OpenTile, second: OpenTile) -> None:
        self._tiles = first, second
        self._answers: tuple[dict[Row, Localization | None], ...] = (
            {},
            {},
        )  # nodes of the second tile in the first, and nodes of the first in the second

    def verdict(
        self, num_probed: int, max_queries: int, min_near: int
    ) -> TileTransform | NotJoined:
        """Compare the tiles and return the transform, or the reason for no join."""
        orders = self._rank_nodes_by_similarity()
        self._localize_nodes([order[:num_probed] for order in orders])
        if not self._localized_nodes():
            return NotJoined("no node of either is recognised in the other")
        self._localize_nodes([order[:max_queries] for order in orders])
        found = self._find_consensus()
        if isinstance(found, NotJoined):
            return found
        consensus, ends = found
        first_from_second, covariance = consensus.between(
            self._tiles[0].world_from_node(ends[0]),
            self._tiles[1].world_from_node(ends[1]).inverse(),
        )
        near = self._find_nearby_nodes(first_from_second, max_queries)
        self._localize_nodes(near)
        tested = self._verify(first_from_second, near)
        joint = TileTransform(
            first_from_second, covariance, int(np.count_nonzero(consensus.is_inlier)), *tested
        )
        return self._decide(joint, min_near)

    def _decide(self, found: TileTransform, min_near: int) -> TileTransform | NotJoined:
        # Minimum share of these nodes that are localized at their expected pose.
        min_recognised = 0.9
        # Minimum share of unguided matches that agree with the pose, in three quarters of
        # these nodes. Another place of the same plan may match as often, but its
        # different parts match something else.
        min_agreeing = 0.75
        if found.num_near < min_near:
            return NotJoined(
                f"{found.num_agreeing} answers agree, but only {found.num_near} nodes stand near"
                " one of the other tile"
            )
        if found.num_recognised < min_recognised * found.num_near:
            return NotJoined(
                f"{found.num_agreeing} answers agree, but {found.num_near - found.num_recognised}"
                f" of {found.num_near} nodes that should be recognised are not"
            )
        if found.agreeing < min_agreeing:
            return NotJoined(
                f"{found.num_agreeing} answers agree, but {1.0 - found.agreeing:.0%} of what is"
                " matched there does not"
            )
        return found

    def _rank_nodes_by_similarity(self) -> list[list[Row]]:
        """Return the rows of the second tile's nodes, and of the first's, by similarity to the
        other tile's most similar node."""
        first, second = (tile.vectors for tile in self._tiles)
        kind = [kind for kind in first if kind in second][-1]
        alike = first[kind] @ second[kind].T
        return [as_rows(np.argsort(-alike.max(axis=side), kind="stable")) for side in (0, 1)]

    def _localize_nodes(self, rows: Sequence[Sequence[Row]]) -> None:
        """Localize nodes of the second tile in the first, and nodes of the first in the second, if
        not done before."""
        for queried, of, known, wanted in zip(
            self._tiles, self._tiles[::-1], self._answers, rows, strict=True
        ):
            if set(queried.topomap.kinds) <= set(of.topomap.kinds):
                known.update(
                    localize_nodes(
                        queried.localizer, of.topomap, [row for row in wanted if row not in known]
                    )
                )

    def _localized_nodes(self) -> list[list[_Answer]]:
        """Return the successful localizations in the first tile and in the second. Return an empty
        list if there is none."""
        found = [
            [
                _Answer(row, queried.topomap.row_of(result.node_id), result)
                for row, result in known.items()
                if result is not None
            ]
            for queried, known in zip(self._tiles, self._answers, strict=True)
        ]
        return found if any(found) else []

    def _find_consensus(self) -> tuple[TransformConsensus, tuple[Row, Row]] | NotJoined:
        """Return the transform between two nodes, one of each tile, and the rows of these nodes."""
        by_first, by_second = self._localized_nodes()
        answers = [*by_first, *by_second]
        pairs = [(one.matched_row, one.queried) for one in by_first] + [
            (one.queried, one.matched_row) for one in by_second
        ]
        ends = pairs[int(np.argmax([one.result.num_inliers for one in answers]))]
        estimates, covariances = [], []
        for number, one in enumerate(answers):
            estimate, covariance = self._estimate_transform(
                one, ends, is_from_second=number >= len(by_first)
            )
            estimates.append(estimate)
            covariances.append(covariance)
        consensus = find_consensus(
            estimates, np.stack(covariances), np.array(pairs), rival_share=0.34
        )
        return (
            NotJoined(f"{len(answers)} nodes are recognised, but do not agree")
            if consensus is None
            else (consensus, ends)
        )

    def _estimate_transform(
        self, one: _Answer, ends: tuple[Row, Row], is_from_second: bool
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """Return the transform between the nodes `ends` according to one localization:
        first_from_second."""
        # Factor applied to the sigmas of the localizations, because neighbours share
        # errors of the map.
        widened = 3.0
        sigma = 0.01  # additional position sigma of a localization, in metres
        sigma_deg = 0.2  # additional rotation sigma of a localization, in degrees
        first, second = self._tiles
        matched_row = second if is_from_second else first
        node_from_world = matched_row.world_from_node(one.matched_row).inverse()
        adjoint = node_from_world.adjoint()
        by_from_asked = node_from_world @ one.result.world_from_cam
        covariance = widened**2 * adjoint @ one.result.covariance @ adjoint.T + diagonal_covariance(
            sigma, sigma_deg
        )
        a, b = one.matched_row, one.queried
        if is_from_second:
            covariance, by_from_asked = (
                inverse_covariance(by_from_asked, covariance),
                by_from_asked.inverse(),
            )
            a, b = b, a
        to_first = first.world_from_node(ends[0]).inverse() @ first.world_from_node(a)
        from_second = second.world_from_node(b).inverse() @ second.world_from_node(ends[1])
        return propagate_estimate(
            to_first, by_from_asked, covariance, from_second, drift=0.01, drift_deg=0.1
        )

    def _find_nearby_nodes(self, first_from_second: Rigid3, max_queries: int) -> list[list[Row]]:
        """Return nodes of the second tile, and of the first, that the transform puts near a node of
        the other. At most `max_queries` of each tile are chosen, evenly spaced."""
        # A node must be localized if it is within this many D_thresh (distance of Eq. 1)
        # of a node of the other tile.
        max_distance = 3.0
        rows = []
        for queried, of, pose in zip(
            self._tiles,
            self._tiles[::-1],
            (first_from_second, first_from_second.inverse()),
            strict=True,
        ):
            config, node_poses = queried.topomap.config, queried.topomap.node_poses
            apart = [
                node_distances(pose @ summary.world_from_cam, node_poses, config.lambda_rot).min()
                for summary in of.topomap.summaries
            ]
            near = np.flatnonzero(np.array(apart) <= max_distance * config.d_thresh)
            rows.append(sample_evenly(as_rows(near), max_queries))
        return rows

    def _verify(
        self, first_from_second: Rigid3, near: Sequence[Sequence[Row]]
    ) -> tuple[int, int, float]:
        """Return the number of tested nodes, the number localized at their expected pose, and the
        lower quartile of the share of agreeing matches."""
        num_at_pose, shares = 0, list[float]()
        poses = (first_from_second, first_from_second.inverse())
        for queried, of, known, rows, pose in zip(
            self._tiles, self._tiles[::-1], self._answers, near, poses, strict=True
        ):
            d_thresh = queried.topomap.config.d_thresh
            for row in rows:
                if row not in known:
                    continue
                result, share = known[row], 0.0
                if result is not None and result.world_from_cam.is_same(
                    pose @ of.world_from_node(row), 0.3 * d_thresh, math.radians(2.0)
                ):
                    num_at_pose, share = num_at_pose + 1, _unguided_inlier_ratio(result)
                shares.append(share)
        return len(shares), num_at_pose, float(np.quantile(shares, 0.25)) if shares else 0.0


def _unguided_inlier_ratio(result: Localization) -> float:
    """Return the share of unguided matches that agree with the pose."""
    evidence = result.evidence
    return 0.0 if evidence is None else evidence.num_inliers / max(evidence.num_matches, 1)
