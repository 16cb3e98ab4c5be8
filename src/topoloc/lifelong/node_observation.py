"""Find the landmarks of a node in an image whose pose is known."""

from __future__ import annotations

import numpy as np

from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.landmarks import Observations, observe_points
from topoloc.mapping.topomap import TopoNode
from topoloc.points.metric_points import keypoint_sigmas


def observe_node(
    node: TopoNode,
    features: Features,
    camera: Camera,
    cam_from_node: Rigid3,
    session_id: int = 0,
) -> Observations:
    """Search an image for a node's landmarks near their projections. See `observe_points`.

    Args:
        node: the node of the map.
        features: the image's features, of the node's feature type.
        camera: the image's camera model.
        cam_from_node: the pose of the node in the image's camera frame.
        session_id: the id of the image's session.
    """
    roots = np.zeros((len(node.features), 3, 3))
    roots[:, *np.tril_indices(3)] = node.point_sqrt_covs
    known = (node.features, node.points_cam.astype(np.float64), roots @ roots.transpose(0, 2, 1))
    seen_by = (features, keypoint_sigmas(features), camera, cam_from_node)
    return observe_points(*known, *seen_by, session_id)
