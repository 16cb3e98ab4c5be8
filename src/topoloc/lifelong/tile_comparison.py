"""Do two maps overlap, and how do they lie to each other? Read from `compare_tiles`.

Maps of overlapping pieces of one recording have pictures in common, which say it at once
(`shared_images.py`). Of all others, nodes of either are asked of the other as pictures would be,
those that look most alike first. Each answer says how the maps lie to each other; what enough of
them agree on, from pictures of which none counts twice, is taken for true
(`transform_consensus.py`) if it stands a test: of the nodes that then stand about where one of the
other map stands, nearly all must be recognised there, and nearly all that they match before a pose
is known must agree with it. Two corridors of one plan agree by the centimetre on what they share;
but what one of them has and the other has not is matched with something else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.atlas.global_descriptors import GlobalDescriptors
from topoloc.bounds import Above, AtLeast, Between
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.geometry.transform_consensus import (
    ConsensusConfig,
    DriftConfig,
    TransformConsensus,
    diagonal_covariance,
    find_consensus,
    propagate_estimate,
)
from topoloc.lifelong.node_localization import localize_nodes
from topoloc.lifelong.shared_images import estimate_by_shared_images
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap


@dataclass(frozen=True)
class TileJoinConfig:
    """Which tiles are compared, and what joins them."""

    num_neighbours: Annotated[int, Between(1, 1000)] = 6
    """Other tiles, those that look most alike, that a tile is compared with."""
    max_pairs: Annotated[int, Between(0, 1_000_000)] = 10_000
    """Pairs of tiles that are compared at most, the most alike first."""
    min_likeness: Annotated[float, Between(-1, 1)] = 0.35
    """Tiles whose most similar places (the median of the best few) are less like each other than
    this are not compared."""
    num_probed: Annotated[int, Between(1, 1000)] = 8
    """Nodes of either tile that are asked of the other first; where it recognises none, no further
    ones are asked."""
    num_asked: Annotated[int, Between(1, 10_000)] = 32
    """Nodes of either tile that are asked of the other at most."""
    consensus: ConsensusConfig = field(
        default_factory=lambda: ConsensusConfig(min_independent=3, rival_share=0.34)
    )
    along: DriftConfig = field(default_factory=lambda: DriftConfig(0.01, 0.1))
    """How wrong the way between two nodes of a tile may be."""
    widened: Annotated[float, Above(0)] = 3.0
    """Answers are trusted as if their sigmas were so many times as large: neighbours share errors
    of the map."""
    sigma: Annotated[float, Above(0)] = 0.01
    """Metres by which an answer may be wrong (one sigma), besides, ..."""
    sigma_deg: Annotated[float, Above(0)] = 0.2
    """... and degrees."""
    near: Annotated[float, Above(0)] = 3.0
    """A node that stands so many D_thresh (distance of Eq. 1) from one of the other tile, or
    nearer, must be recognised."""
    min_near: Annotated[int, AtLeast(1)] = 12
    """Such nodes there must be, of both tiles together; ..."""
    min_recognised: Annotated[float, Between(0, 1)] = 0.9
    """... this share of them must be recognised where the join has them, ..."""
    min_agreeing: Annotated[float, Between(0, 1)] = 0.75
    """... and of three in four of them this share of the matches that no pose guided must agree
    with the pose: another place of the same plan matches as many, but what differs is matched with
    something else."""


@dataclass(frozen=True, eq=False)
class OpenTile:
    """A tile whose map is open, and the place vectors of its nodes."""

    localizer: Localizer
    vectors: GlobalDescriptors

    @property
    def topomap(self) -> TopoMetricMap:
        return self.localizer.topomap

    @cached_property
    def poses(self) -> NodePoses:
        return NodePoses.of([summary.world_from_cam for summary in self.topomap.summaries])

    @property
    def apart(self) -> tuple[float, float]:
        """D_thresh and lambda of Eq. 1."""
        nodes = self.topomap.config.nodes
        assert nodes.d_thresh is not None, "a map's own configuration is resolved"
        assert nodes.lambda_rot is not None, "a map's own configuration is resolved"
        return nodes.d_thresh, nodes.lambda_rot

    def world_from_node(self, row: int) -> Rigid3:
        return self.topomap.summaries[row].world_from_cam


@dataclass(frozen=True, eq=False)
class TileTransform:
    """How two maps lie to each other; the covariance is that of the left perturbation of
    `first_from_second` (m, rad).

    `num_agreeing` pictures say so: the same ones of both maps (`is_from_shared_images`), or nodes
    of either that are recognised in the other. Of these, `num_near` must be recognised and
    `num_recognised` are; in three in four of them at least the share `agreeing` of the matches
    agrees with the pose.
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
    """Why two tiles are not joined, in a few words."""

    reason: str


@dataclass(frozen=True, eq=False)
class _Answer:
    """Node `queried` of one map as the other one places it, which recognises its node `by` in
    it."""

    queried: int
    matched_row: int
    result: Localization


def compare_tiles(
    first: OpenTile, second: OpenTile, config: TileJoinConfig
) -> TileTransform | NotJoined:
    """How the second map lies to the first, if they overlap and that is beyond doubt.

    Raises:
        MapError: a map cannot be read.
        FeatureKindError, MissingExtraError, WeightsError: the maps' features cannot be compared
            here.
    """
    shared = estimate_by_shared_images(
        first.topomap, second.topomap, config.along, config.consensus
    )
    if shared is not None:
        return TileTransform(*shared, is_from_shared_images=True)
    is_of_kinds = any(
        set(one.topomap.kinds) <= set(other.topomap.kinds)
        for one, other in ((first, second), (second, first))
    )
    if not is_of_kinds or not first.vectors.keys() & second.vectors.keys():
        return NotJoined("their features are not of the same kinds")
    return _Comparison(first, second, config).verdict()


class _Comparison:
    """Two tiles, and what each has answered so far to the other's nodes, by their rows; None where
    it does not know the place."""

    def __init__(self, first: OpenTile, second: OpenTile, config: TileJoinConfig) -> None:
        self._tiles, self._config = (first, second), config
        self._answers: tuple[dict[int, Localization | None], ...] = (
            {},
            {},
        )  # of the first to the second's nodes, of the second

    def verdict(self) -> TileTransform | NotJoined:
        config = self._config
        orders = self._rank_nodes_by_similarity()
        self._localize_nodes([order[: config.num_probed] for order in orders])
        if not self._localized_nodes():
            return NotJoined("no node of either is recognised in the other")
        self._localize_nodes([order[: config.num_asked] for order in orders])
        found = self._find_consensus()
        if isinstance(found, NotJoined):
            return found
        consensus, ends = found
        first_from_second = (
            self._tiles[0].world_from_node(ends[0])
            @ consensus.a_from_b
            @ self._tiles[1].world_from_node(ends[1]).inverse()
        )
        near = self._find_nearby_nodes(first_from_second)
        self._localize_nodes(near)
        tested = self._verify(first_from_second, near)
        to_world = self._tiles[0].world_from_node(ends[0]).adjoint()
        covariance = to_world @ consensus.covariance @ to_world.T
        joint = TileTransform(
            first_from_second,
            0.5 * (covariance + covariance.T),
            int(np.count_nonzero(consensus.is_inlier)),
            *tested,
        )
        return self._decide(joint)

    def _decide(self, found: TileTransform) -> TileTransform | NotJoined:
        config = self._config
        if found.num_near < config.min_near:
            return NotJoined(
                f"{found.num_agreeing} answers agree, but only {found.num_near} nodes stand near"
                " one of the other tile"
            )
        if found.num_recognised < config.min_recognised * found.num_near:
            return NotJoined(
                f"{found.num_agreeing} answers agree, but {found.num_near - found.num_recognised}"
                f" of {found.num_near} nodes that should be recognised are not"
            )
        if found.agreeing < config.min_agreeing:
            return NotJoined(
                f"{found.num_agreeing} answers agree, but {1.0 - found.agreeing:.0%} of what is"
                " matched there does not"
            )
        return found

    def _rank_nodes_by_similarity(self) -> list[list[int]]:
        """The nodes of the second tile, and of the first, by how alike the other's most similar
        place looks."""
        first, second = (tile.vectors for tile in self._tiles)
        kind = [kind for kind in first if kind in second][-1]
        alike = first[kind] @ second[kind].T
        return [np.argsort(-alike.max(axis=side), kind="stable").tolist() for side in (0, 1)]

    def _localize_nodes(self, rows: Sequence[Sequence[int]]) -> None:
        """Nodes of the second tile of the first, and nodes of the first of the second, where these
        were not asked before."""
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
        """The answers that have a pose, of the first tile and of the second; an empty list where
        neither has any."""
        found = [
            [
                _Answer(row, queried.topomap.row_of(result.node_id), result)
                for row, result in known.items()
                if result is not None
            ]
            for queried, known in zip(self._tiles, self._answers, strict=True)
        ]
        return found if any(found) else []

    def _find_consensus(self) -> tuple[TransformConsensus, tuple[int, int]] | NotJoined:
        """How two nodes, one of either tile, lie to each other, and which these are."""
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
            estimates, np.stack(covariances), self._config.consensus, np.array(pairs)
        )
        return (
            NotJoined(f"{len(answers)} nodes are recognised, but do not agree")
            if consensus is None
            else (consensus, ends)
        )

    def _estimate_transform(
        self, one: _Answer, ends: tuple[int, int], is_from_second: bool
    ) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
        """How the nodes `ends` lie to each other as an answer has it: first_from_second."""
        config, (first, second) = self._config, self._tiles
        matched_row = second if is_from_second else first
        node_from_world = matched_row.world_from_node(one.matched_row).inverse()
        adjoint = node_from_world.adjoint()
        by_from_asked = node_from_world @ one.result.world_from_cam
        covariance = (
            config.widened** 2 * adjoint @ one.result.covariance @ adjoint.T
            + diagonal_covariance(config.sigma, config.sigma_deg)
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
        return propagate_estimate(to_first, by_from_asked, covariance, from_second, config.along)

    def _find_nearby_nodes(self, first_from_second: Rigid3) -> list[list[int]]:
        """Nodes of the second tile, and of the first, that the join has near one of the other, at
        most `num_asked` each, evenly."""
        rows = []
        for queried, of, pose in zip(
            self._tiles,
            self._tiles[::-1],
            (first_from_second, first_from_second.inverse()),
            strict=True,
        ):
            d_thresh, lambda_rot = queried.apart
            apart = [
                node_distances(pose @ summary.world_from_cam, queried.poses, lambda_rot).min()
                for summary in of.topomap.summaries
            ]
            near = np.flatnonzero(np.array(apart) <= self._config.near * d_thresh)
            chosen = np.unique(
                np.linspace(0, len(near) - 1, min(len(near), self._config.num_asked))
                .round()
                .astype(int)
            )
            rows.append(near[chosen].tolist() if len(near) else [])
        return rows

    def _verify(
        self, first_from_second: Rigid3, near: Sequence[Sequence[int]]
    ) -> tuple[int, int, float]:
        """How many nodes must be recognised, how many are, and what share of the matches agrees
        with their pose in three in four of all."""
        num_at_pose, shares = 0, list[float]()
        poses = (first_from_second, first_from_second.inverse())
        for queried, of, known, rows, pose in zip(
            self._tiles, self._tiles[::-1], self._answers, near, poses, strict=True
        ):
            d_thresh, _ = queried.apart
            for row in rows:
                if row not in known:
                    continue
                result, world_from_cam = known[row], pose @ of.world_from_node(row)
                is_at_pose = result is not None and _is_at_pose(result, world_from_cam, d_thresh)
                num_at_pose += is_at_pose
                shares.append(_unguided_inlier_ratio(result) if is_at_pose else 0.0)
        return len(shares), num_at_pose, float(np.quantile(shares, 0.25)) if shares else 0.0


def _is_at_pose(result: Localization | None, world_from_cam: Rigid3, d_thresh: float) -> bool:
    if result is None:
        return False
    off = result.world_from_cam.inverse() @ world_from_cam
    return bool(
        np.linalg.norm(off.translation) <= 0.3 * d_thresh and np.degrees(off.angle()) <= 2.0
    )


def _unguided_inlier_ratio(result: Localization | None) -> float:
    """Of the matches that no pose guided, those that agree with the pose."""
    evidence = None if result is None else result.evidence
    return 0.0 if evidence is None else evidence.num_inliers / max(evidence.num_matches, 1)
