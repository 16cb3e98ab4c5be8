"""Measure the correlated errors of a map's points, which inflate the covariances of poses.

PnP treats the errors of n matches as independent, so its covariance shrinks with n. But the points
of one node share the errors of the node's pose, depth and calibration. Let rho be the share of a
match's variance that is common to all matches, and v the variance. The variance of the mean of n
matches is then not v / n but v / n (1 + (n - 1) rho). This is the design effect of cluster samples
(Kish, *Survey Sampling*, 1965). The PnP covariance is therefore multiplied by 1 + n rho.

rho is measured from the map itself. A node is localized like a query, with nodes a few steps away,
and the result is compared with its recorded pose. This takes about a second. The map file stores
rho with a digest of the nodes and settings. If the digest differs from the requested one, rho is
measured again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from msgspec import to_builtins

from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.fitted_weights import CorrelatedErrorWeights
from topoloc.localization.guided import GuidedConfig, match_guided
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.nodes import compute_nodes_digest, node_distances
from topoloc.mapping.storage.entries import CorrelatedErrors
from topoloc.mapping.topomap import TopoMetricMap, TopoNode
from topoloc.node_ids import as_rows

MeasuredPoses: TypeAlias = Mapping[tuple[int, str], Rigid3]
"""Poses (world_from_cam) by session and name of the image."""
_MEDIAN_CHI_SQUARE_6 = 5.348
_METHOD = 1  # part of the digest: increase if the same settings give another rho


_SETTINGS: dict[str, Any] = {
    # nodes, evenly spaced in the map, that are localized with other nodes
    "num_nodes": 20,
    # Minimum distance, in D_thresh (Eq. 1), of nodes used to localize a node. Nearer nodes were
    # refined with its image. The second value is used if the first leaves too few nodes.
    "min_distances": (3.0, 1.0),
    # nearest allowed nodes whose points are used
    "num_helpers": 3,
    # Nodes localized with fewer inliers are not compared.
    "min_inliers": 20,
    # With fewer compared nodes, rho is set to the value for unknown maps.
    "min_nodes": 5,
    # Percentile of rho over the nodes. It is above the median, because some parts of a map are
    # worse.
    "percentile": 75.0,
}
"""Settings of the measurement, part of the digest."""


@dataclass(frozen=True, eq=False)
class ErrorShareMeasurement:
    """Measure rho of a map for a feature type (see the module docstring).

    `guided` and `pose` are the settings of query matching and pose estimation.
    """

    topomap: TopoMetricMap
    kind: str
    guided: GuidedConfig
    pose: AbsolutePoseConfig
    weights: CorrelatedErrorWeights

    def find(self) -> float:
        """Return rho from the map's file if the digest matches, and measure it otherwise."""
        known = self.topomap.layers[self.kind].shared_errors
        if known is not None and known.digest == self._digest():
            return known.rho
        return self.measure()

    def with_digest(self, rho: float) -> CorrelatedErrors:
        """Return rho of these or nearly the same nodes, to be stored in the map."""
        return CorrelatedErrors(rho, self._digest())

    def measure(self, measured_poses: MeasuredPoses | None = None) -> float:
        """Measure rho. Nodes are compared with `measured_poses` instead of their own, if these
        have one: poses that images corrected agree among each other better than with the world."""
        poses, config = self.topomap.node_poses, self.topomap.config
        nodes = self.topomap.layers[self.kind].nodes
        rows = np.linspace(0, len(self.topomap.summaries) - 1, _SETTINGS["num_nodes"])
        for min_distance in _SETTINGS["min_distances"]:
            rhos = []
            for row in as_rows(np.unique(rows.round().astype(int))):
                distances = node_distances(
                    nodes[row].summary.world_from_cam, poses, config.lambda_rot
                )
                order = np.argsort(distances, kind="stable")
                is_far = distances[order] > min_distance * config.d_thresh
                helpers = order[is_far][: _SETTINGS["num_helpers"]]
                rho = self._measure_at_node(
                    nodes[row], [nodes[int(k)] for k in helpers], measured_poses or {}
                )
                if rho is not None:
                    rhos.append(rho)
            if len(rhos) >= _SETTINGS["min_nodes"]:
                rho = float(np.percentile(rhos, _SETTINGS["percentile"]))
                return max(self.weights.factor * rho, self.weights.least)
        return self.weights.unknown

    def _digest(self) -> str:
        """Return a digest of all inputs of rho."""
        settings = {
            "guided": asdict(self.guided),
            "pose": asdict(self.pose) | {"confidence": 0.999, "max_refinement_steps": 10},
            "config": _SETTINGS | to_builtins(self.weights),
            "nodes": asdict(self.topomap.config.nodes),
        }
        return compute_nodes_digest(
            self.topomap.summaries, json.dumps([_METHOD, settings], sort_keys=True).encode()
        )

    def _measure_at_node(
        self, node: TopoNode, helpers: list[TopoNode], measured_poses: MeasuredPoses
    ) -> float | None:
        """Estimate rho from the pose of one node, localized with the points of `helpers`.

        None if they have too few points in common.
        """
        if not helpers:
            return None
        min_inliers = _SETTINGS["min_inliers"]
        summary = node.summary
        world_from_cam = measured_poses.get((summary.session_id, summary.name))
        cam_from_world = (world_from_cam or summary.world_from_cam).inverse()
        local_map = LocalMap.concatenate([LocalMap.of_node(helper) for helper in helpers])
        matches = match_guided(node.features, local_map, cam_from_world, node.camera, self.guided)
        if len(matches) < min_inliers:
            return None
        found: AbsolutePose | None = estimate_absolute_pose(
            node.features.points_img[matches.query_idx].astype(np.float64),
            local_map.points_world[matches.train_idx],
            node.camera,
            self.pose,
            point_covariances=local_map.covariances[matches.train_idx],
            start=cam_from_world,
        )
        if found is None or np.count_nonzero(found.inliers) < min_inliers:
            return None
        error: Float[np.ndarray, " 6"] = (found.cam_from_world @ cam_from_world.inverse()).log()
        excess = error @ np.linalg.solve(found.covariance, error) / _MEDIAN_CHI_SQUARE_6 - 1.0
        return float(excess) / np.count_nonzero(found.inliers)
