"""Localizing a single image in the topo-metric map: section III-B of the paper, read from the top.

The coarse localizer names the nodes that the image may belong to; the image is patch-normalised and its features are
matched with those of the nodes; PnP on the matches gives the camera's global pose. Unlike the paper's blind first choice,
several candidate nodes pool their points; the nodes nearest to the pose so found, whose points are sought where they must
be seen, make it exact; and it is reported only where the evidence is strong. One candidate and no guided step
(`num_candidates=1`, `guided.num_nodes=0`) give the paper's own behaviour.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field

import cv2
import numpy as np

from topoloc.errors import EmptyMapError, MapError, QueryError
from topoloc.features.extraction import FeatureConfig, extract_normalized, normalize_image
from topoloc.features.features import Features, Matches
from topoloc.features.matching import MatchingConfig, match_pooled
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, covariance_of_inverse, estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import GuidedConfig, count_visible, match_guided
from topoloc.localization.local_map import LocalMap
from topoloc.localization.result import Localization, NotLocalized
from topoloc.localization.seen_points import SeenPoints
from topoloc.localization.stages import StageClock
from topoloc.localization.verification import Evidence, VerificationConfig, probability_of
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.places.coarse import Image, NodeScore, open_coarse
from topoloc.sequences.pictures import grey_image

NODES_IN_MEMORY = 256


@dataclass(frozen=True)
class LocalizerConfig:
    """How a query is answered. The features are those that the map was built with."""

    coarse: str | None = None
    """Which of the map's coarse localizers is asked (None: the map's default)."""
    num_candidates: int = 4
    """Nodes whose points are pooled; 1 is the paper's single node."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    guided: GuidedConfig = field(default_factory=GuidedConfig)
    pose: AbsolutePoseConfig = field(default_factory=lambda: AbsolutePoseConfig(max_reprojection_error_px=8.0))
    num_first_features: int = 500
    """The image's strongest features are matched first; the rest only where these give fewer inliers than the next number."""
    num_clear_inliers: int = 40
    min_matches: int = 8
    """With fewer first matches no pose is sought."""
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    max_side_px: int = 1600
    """Larger images are reduced to this width or height first: nothing is gained from more, but time and memory."""


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A pose sought in a part of the map."""

    local_map: LocalMap
    matches: Matches
    pose: AbsolutePose | None

    @property
    def num_inliers(self) -> int:
        return int(self.pose.inliers.sum()) if self.pose else 0


class Localizer:
    """Holds an open map, its coarse localizer and the nodes used lately.

    Raises:
        EmptyMapError: the map has no node.
        MapError: the map has no such coarse localizer.
    """

    def __init__(self, topomap: TopoMetricMap, config: LocalizerConfig | None = None) -> None:
        self.config = config or LocalizerConfig()
        self.topomap = topomap
        if len(topomap.summaries) == 0:
            raise EmptyMapError("the map has no nodes")
        coarse = self.config.coarse or topomap.default_coarse
        if coarse not in topomap.coarse_models:
            available = ", ".join(topomap.coarse_models) or "none"
            raise MapError(f"the map has no coarse localizer {coarse!r} (it has: {available})")
        self._coarse = open_coarse(topomap.coarse_models[coarse])
        self._feature_config = FeatureConfig(**topomap.config["features"])
        self._node_poses = NodePoses.of([summary.world_from_cam for summary in topomap.summaries])
        self._lambda_rot = float(topomap.config["nodes"]["lambda_rot"])
        self._local_maps: OrderedDict[int, LocalMap] = OrderedDict()

    def localize(self, image: Image, camera: Camera) -> Localization | NotLocalized:
        """Where was this image (grey or RGB, uint8) taken, by a camera of this calibration?

        Raises:
            QueryError: the camera is of another image size.
        """
        return self.localize_near(image, camera, None)[0]

    def localize_near(self, image: Image, camera: Camera, near: Rigid3 | None) -> tuple[Localization | NotLocalized, SeenPoints | None]:
        """As `localize`, where the camera is known to be about `near` (world_from_cam): the nodes nearest to it replace the coarse search.

        None for `near` is `localize` itself. Only the choice of nodes is taken from `near`: the pose needs the same evidence as any
        other, of matches that it did not guide. Also returned are the points that the pose stands on, in pixels of `image`.

        Raises:
            QueryError: the camera is of another image size.
        """
        height, width = image.shape[:2]
        if (camera.width, camera.height) != (width, height):
            raise QueryError(f"the image is {width}x{height}, its camera {camera.width}x{camera.height}")
        clock = StageClock()
        image, camera = _reduced(image, camera, self.config.max_side_px)
        features = self._extract(image, clock)
        candidates = self._rank_nodes(image, features, clock) if near is None else self._nodes_near(near)
        first = self._localize_among(candidates, features, camera, clock)
        final = self._localize_around(first, features, camera, clock)
        result = self._judge(first, final, camera, candidates if near is None else [], clock)
        return result, _seen_points(final, features, width / camera.width) if isinstance(result, Localization) else None

    def _extract(self, image: Image, clock: StageClock) -> Features:
        """Patch normalisation, then the local features."""
        grey = grey_image(image)
        with clock.stage("patch_normalization"):
            normalized = normalize_image(grey, self._feature_config)
        with clock.stage("features"):
            return extract_normalized(normalized, self._feature_config)

    def _rank_nodes(self, image: Image, features: Features, clock: StageClock) -> list[NodeScore]:
        """The coarse step: which nodes may this be?"""
        with clock.stage("coarse"):
            return self._coarse.rank(image, features, self.config.num_candidates)

    def _localize_among(self, candidates: list[NodeScore], features: Features, camera: Camera, clock: StageClock) -> _Attempt:
        """The candidates' points together. The strongest features are nearly always enough; all are tried where they are not."""
        local_map = self._pooled([candidate.node_id for candidate in candidates])
        attempt = self._localize_in(
            local_map, features.select(np.arange(min(len(features), self.config.num_first_features))), camera, clock
        )
        if attempt.num_inliers < self.config.num_clear_inliers and len(features) > self.config.num_first_features:
            attempt = self._localize_in(local_map, features, camera, clock)
        return attempt

    def _nodes_near(self, world_from_cam: Rigid3) -> list[NodeScore]:
        """As many nodes as the coarse step would name; nearer ones (Eq. 1) score higher."""
        distances = node_distances(world_from_cam, self._node_poses, self._lambda_rot)
        nearest = np.argsort(distances, kind="stable")[: self.config.num_candidates]
        return [NodeScore(int(i), -float(distances[i])) for i in nearest]

    def _localize_in(self, local_map: LocalMap, features: Features, camera: Camera, clock: StageClock) -> _Attempt:
        """The fine step: match with the candidates' points, then robust PnP."""
        with clock.stage("matching"):
            matches = match_pooled(
                features.descriptors, local_map.descriptors, local_map.points_world, local_map.radii, self.config.matching
            )
        if len(matches) < self.config.min_matches:
            return _Attempt(local_map, matches, None)
        return _Attempt(local_map, matches, self._estimate_pose(local_map, matches, features, camera, None, clock))

    def _localize_around(self, first: _Attempt, features: Features, camera: Camera, clock: StageClock) -> _Attempt:
        """Once more with the nodes nearest to the pose found, each point sought where it must be seen."""
        if self.config.guided.num_nodes == 0 or first.pose is None or first.num_inliers < self.config.verification.min_inliers:
            return first
        with clock.stage("matching"):
            cam_from_world = first.pose.cam_from_world
            distances = node_distances(cam_from_world.inverse(), self._node_poses, self._lambda_rot)
            nearest = np.argsort(distances, kind="stable")[: self.config.guided.num_nodes]
            local_map = self._pooled([int(i) for i in nearest])
            matches = match_guided(features, local_map, cam_from_world, camera, self.config.guided)
        return _Attempt(local_map, matches, self._estimate_pose(local_map, matches, features, camera, cam_from_world, clock))

    def _estimate_pose(
        self, local_map: LocalMap, matches: Matches, features: Features, camera: Camera, start: Rigid3 | None, clock: StageClock
    ) -> AbsolutePose | None:
        with clock.stage("pnp"):
            return estimate_absolute_pose(
                features.points_img[matches.query_idx].astype(np.float64),
                local_map.points_world[matches.train_idx],
                camera,
                self.config.pose,
                point_covariances=local_map.covariances[matches.train_idx],
                start=start,
            )

    def _judge(
        self, first: _Attempt, final: _Attempt, camera: Camera, candidates: list[NodeScore], clock: StageClock
    ) -> Localization | NotLocalized:
        """A pose is an answer only where the evidence for it is strong."""
        num_matches, demanded = len(final.matches), self.config.verification
        if len(first.matches) < self.config.min_matches:
            return NotLocalized("too_few_matches", candidates, len(first.matches), 0, clock.times_ms())
        if first.pose is None or final.pose is None or first.num_inliers < demanded.min_inliers or final.num_inliers < demanded.min_found:
            return NotLocalized("too_few_inliers", candidates, num_matches, final.num_inliers, clock.times_ms())
        cam_from_world = final.pose.cam_from_world
        num_visible = count_visible(final.local_map, cam_from_world, camera)
        evidence = Evidence(len(first.matches), first.num_inliers, final.num_inliers, num_visible)
        probability = probability_of(evidence, demanded)
        if probability < demanded.min_probability:
            return NotLocalized("not_in_map", candidates, num_matches, final.num_inliers, clock.times_ms())
        node_ids = final.local_map.node_ids[final.matches.train_idx[final.pose.inliers]]
        return Localization(
            world_from_cam=cam_from_world.inverse(),
            covariance=covariance_of_inverse(cam_from_world, final.pose.covariance),
            probability=probability,
            node_id=int(np.bincount(node_ids).argmax()),
            candidates=candidates,
            num_matches=num_matches,
            num_inliers=final.num_inliers,
            times_ms=clock.times_ms(),
            evidence=evidence,
        )

    def _pooled(self, node_ids: list[int]) -> LocalMap:
        return LocalMap.pooled([self._local_map(node_id) for node_id in node_ids])

    def _local_map(self, node_id: int) -> LocalMap:
        if node_id not in self._local_maps:
            self._local_maps[node_id] = LocalMap.of_node(self.topomap.nodes[node_id])
            if len(self._local_maps) > NODES_IN_MEMORY:
                self._local_maps.popitem(last=False)
        self._local_maps.move_to_end(node_id)
        return self._local_maps[node_id]


def _seen_points(attempt: _Attempt, features: Features, scale: float) -> SeenPoints:
    """The inliers of an attempt, in an image that is `scale` times as wide as that of the features."""
    assert attempt.pose is not None
    query_idx, train_idx = attempt.matches.query_idx[attempt.pose.inliers], attempt.matches.train_idx[attempt.pose.inliers]
    points_img = ((features.points_img[query_idx] + 0.5) * scale - 0.5).astype(np.float32)
    return SeenPoints(points_img, attempt.local_map.points_world[train_idx], attempt.local_map.covariances[train_idx])


def _reduced(image: Image, camera: Camera, max_side_px: int) -> tuple[np.ndarray, Camera]:
    """The image with its camera, smaller where a side is longer than `max_side_px`."""
    height, width = image.shape[:2]
    scale = max_side_px / max(width, height)
    if scale >= 1.0:
        return image, camera
    width, height = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), camera.rescaled(width, height)
