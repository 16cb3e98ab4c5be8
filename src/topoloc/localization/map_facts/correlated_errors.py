"""What the errors of a map's points have in common, and what that does to a pose's covariance.

PnP's covariance takes the errors of n matches for independent, and shrinks with n. But points of
one node move together when the node's pose is wrong, when its depth is, or its calibration: a
thousand matches share that error. With rho the share of a match's variance that is common to all of
them, the variance of what n matches say together is not v / n but v / n (1 + (n - 1) rho): the
design effect of samples taken in clusters (Kish, *Survey Sampling*, 1965). So PnP's covariance is
multiplied by 1 + n rho.

rho is the map's own, and the map knows it: a node is localized by nodes a few steps away, as if it
were a query, and its recorded pose is compared with the pose found. That takes a second; a map's
file keeps what came out, with a digest of what it was measured of and with, and where that is not
what is asked for, it is measured anew.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from topoloc.bounds import AtLeast, Between
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.localization.fitted_weights import CorrelatedErrorWeights
from topoloc.localization.guided import GuidedConfig, match_guided
from topoloc.localization.local_map import LocalMap
from topoloc.mapping.nodes import NodePoses, compute_nodes_digest, node_distances
from topoloc.mapping.topomap import CorrelatedErrors, TopoMetricMap, TopoNode

_MEDIAN_CHI_SQUARE_6 = 5.348
_METHOD = 1  # part of the digest: one more whenever the same settings come to give another rho


@dataclass(frozen=True)
class CorrelatedErrorsConfig:
    """How rho is measured."""

    num_nodes: Annotated[int, Between(0, 1000)] = 20
    """Nodes that are localized by others, evenly along the map."""
    min_distances: Annotated[tuple[float, ...], AtLeast(0)] = (3.0, 1.0)
    """Neighbours nearer than so many D_thresh (Eq. 1) do not help to localize a node, for their
    points were refined with its picture. The second number counts where the first leaves too few
    nodes to compare."""
    num_helpers: Annotated[int, Between(1, 100)] = 3
    """The nearest of the others, whose points do."""
    min_inliers: Annotated[int, AtLeast(4)] = 20
    """Nodes localized with fewer inliers are not compared."""
    min_nodes: Annotated[int, AtLeast(1)] = 5
    """With fewer nodes compared, rho is taken to be unknown."""
    percentile: Annotated[float, Between(0, 100)] = 75.0
    """Of the nodes' rho; above the median, since some parts of a map are worse than others."""


def covariance_inflation(num_inliers: int, rho: float) -> float:
    """What PnP's covariance from so many inliers is multiplied by."""
    return 1.0 + num_inliers * rho


def find_correlated_error_share(
    topomap: TopoMetricMap,
    guided: GuidedConfig,
    pose: AbsolutePoseConfig,
    config: CorrelatedErrorsConfig,
    weights: CorrelatedErrorWeights,
) -> float:
    """rho as the map tells it, where it was measured of these nodes and with these settings; else
    measured now.

    Args:
        guided, pose: as queries are matched and localized.
    """
    known = topomap.shared_errors
    if known is not None and known.digest == _digest(topomap, guided, pose, config, weights):
        return known.rho
    return measure_correlated_error_share(topomap, guided, pose, config, weights)


def measure_stored_error_share(
    topomap: TopoMetricMap,
    guided: GuidedConfig,
    pose: AbsolutePoseConfig,
    config: CorrelatedErrorsConfig,
    weights: CorrelatedErrorWeights,
) -> CorrelatedErrors:
    """rho measured, for the map to keep."""
    rho = measure_correlated_error_share(topomap, guided, pose, config, weights)
    return CorrelatedErrors(rho, _digest(topomap, guided, pose, config, weights))


def measure_correlated_error_share(
    topomap: TopoMetricMap,
    guided: GuidedConfig,
    pose: AbsolutePoseConfig,
    config: CorrelatedErrorsConfig,
    weights: CorrelatedErrorWeights,
) -> float:
    """rho of the map: see above."""
    poses = NodePoses.of([summary.world_from_cam for summary in topomap.summaries])
    lambda_rot, d_thresh = topomap.config.lambda_rot, topomap.config.d_thresh
    node_ids = np.unique(
        np.linspace(0, len(topomap.summaries) - 1, config.num_nodes).round().astype(int)
    )
    for min_distance in config.min_distances:
        rhos = []
        for node_id in node_ids:
            node = topomap.nodes[int(node_id)]
            distances = node_distances(node.summary.world_from_cam, poses, lambda_rot)
            order = np.argsort(distances, kind="stable")
            helpers = order[distances[order] > min_distance * d_thresh][: config.num_helpers]
            rho = _error_share_of_node(
                node, [topomap.nodes[int(k)] for k in helpers], guided, pose, config.min_inliers
            )
            if rho is not None:
                rhos.append(rho)
        if len(rhos) >= config.min_nodes:
            return max(
                weights.factor * float(np.percentile(rhos, config.percentile)), weights.least
            )
    return weights.unknown


def _digest(
    topomap: TopoMetricMap,
    guided: GuidedConfig,
    pose: AbsolutePoseConfig,
    config: CorrelatedErrorsConfig,
    weights: CorrelatedErrorWeights,
) -> str:
    """A short name for all that rho follows from."""
    settings = {
        "guided": asdict(guided),
        "pose": asdict(pose),
        "config": asdict(config) | asdict(weights),
        "nodes": asdict(topomap.config.nodes),
    }
    return compute_nodes_digest(
        topomap.summaries, json.dumps([_METHOD, settings], sort_keys=True).encode()
    )


def _error_share_of_node(
    node: TopoNode,
    helpers: list[TopoNode],
    guided: GuidedConfig,
    config: AbsolutePoseConfig,
    min_inliers: int,
) -> float | None:
    """rho by which the node's pose differs from what its neighbours (`helpers`) say; None where
    they do not see what it sees."""
    if not helpers:
        return None
    cam_from_world = node.summary.world_from_cam.inverse()
    local_map = LocalMap.concatenate([LocalMap.of_node(helper) for helper in helpers])
    matches = match_guided(node.features, local_map, cam_from_world, node.camera, guided)
    if len(matches) < min_inliers:
        return None
    found: AbsolutePose | None = estimate_absolute_pose(
        node.features.points_img[matches.query_idx].astype(np.float64),
        local_map.points_world[matches.train_idx],
        node.camera,
        config,
        point_covariances=local_map.covariances[matches.train_idx],
        start=cam_from_world,
    )
    if found is None or np.count_nonzero(found.inliers) < min_inliers:
        return None
    error: Float[np.ndarray, " 6"] = (found.cam_from_world @ cam_from_world.inverse()).log()
    square = float(error @ np.linalg.solve(found.covariance, error))
    return (square / _MEDIAN_CHI_SQUARE_6 - 1.0) / np.count_nonzero(found.inliers)
