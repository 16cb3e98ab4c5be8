"""Match a query image's features with map points and fit a pose to the matches."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int

from topoloc.features.features import Features, Matches
from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.camera import Camera, UncalibratedCamera, nominal_camera
from topoloc.geometry.pose_matches import MIN_POINTS
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.squeezed_image import estimate_pose_and_camera
from topoloc.mapping.topomap import TopoNode
from topoloc.node_ids import NodeId


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Hold map points. Row k: descriptor, world position (metres), covariance (m^2), radius and
    node.

    `radii` (metres) bounds the position error of a point. `sizes` is the diameter (metres) of the
    described patch, and `directions` the unit vector (world) of its orientation. The size and angle
    of its key point in another camera follow from these.
    """

    descriptors: Float32[np.ndarray, "n d"]
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]
    radii: Float[np.ndarray, " n"]
    node_ids: Int[np.ndarray, " n"]
    sizes: Float[np.ndarray, " n"]
    directions: Float[np.ndarray, "n 3"]

    @staticmethod
    def of_node(node: TopoNode) -> LocalMap:
        """Return a node's points in the world frame."""
        world_from_cam = node.summary.world_from_cam
        rows, columns = np.tril_indices(3)
        turn = np.zeros((6, 3, 3))  # from the six numbers of L to R @ L
        turn[np.arange(6), :, columns] = world_from_cam.rotation[:, rows].T
        root = (node.point_sqrt_covs.astype(np.float64) @ turn.reshape(6, 9)).reshape(-1, 3, 3)
        covariances = root @ root.transpose(0, 2, 1)
        # three sigmas over all directions, plus 1 cm for errors outside the covariance
        radii = 0.01 + 3.0 * np.sqrt(np.einsum("nii->n", covariances))
        points_world = world_from_cam.apply(node.points_cam.astype(np.float64))
        node_ids, f = np.full(len(radii), node.summary.node_id), node.features
        sizes = f.sizes_px.astype(np.float64) / node.camera.fx * node.points_cam[:, 2]
        angles = f.angles.astype(np.float64)
        directions = (
            np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
            @ world_from_cam.rotation.T
        )
        return LocalMap(
            f.descriptors, points_world, covariances, radii, node_ids, sizes, directions
        )

    @staticmethod
    def concatenate(parts: list[LocalMap]) -> LocalMap:
        """Return the points of several nodes."""
        return LocalMap(
            *(
                np.concatenate([getattr(part, field.name) for part in parts])
                for field in fields(LocalMap)
            )
        )


@dataclass(frozen=True, eq=False)
class PointObservations:
    """Hold matched map points. Row k: pixel, world position (metres) and its covariance (m^2)."""

    points_img: Float32[np.ndarray, "n 2"]
    points_world: Float[np.ndarray, "n 3"]
    covariances: Float[np.ndarray, "n 3 3"]

    def __len__(self) -> int:
        return len(self.points_img)

    def select(self, rows: np.ndarray) -> PointObservations:
        """Return the given rows."""
        return PointObservations(
            self.points_img[rows], self.points_world[rows], self.covariances[rows]
        )

    def errors_px(self, camera: Camera, cam_from_world: Rigid3) -> Float[np.ndarray, " n"]:
        """Return the distances of the pixels from the projections of their points."""
        with np.errstate(invalid="ignore"):
            projected = camera.img_from_cam(cam_from_world.apply(self.points_world))
            return np.linalg.norm(projected - self.points_img, axis=1)

    def to_image_scale(self, scale: float) -> PointObservations:
        """Return the same points in an image that is `scale` times as wide."""
        points_img = (
            (self.points_img + np.float32(0.5)) * np.float32(scale) - np.float32(0.5)
        ).astype(np.float32)
        return PointObservations(points_img, self.points_world, self.covariances)


@dataclass(frozen=True, eq=False)
class PointMatches:
    """Hold matches of an image with map points, on which no pose agrees.

    `input_camera` is the given camera. `camera` is the same, or has the estimated focal length if
    the given camera is approximate.
    """

    features: Features
    input_camera: Camera | UncalibratedCamera
    camera: Camera
    local_map: LocalMap
    matches: Matches

    @property
    def inlier_query_idx(self) -> Int[np.ndarray, " n"]:
        """Return the feature of each inlier. Without a pose there are none."""
        return self.matches.query_idx[:0]

    @property
    def inlier_point_idx(self) -> Int[np.ndarray, " n"]:
        """Return the map point of each inlier."""
        return self.matches.train_idx[:0]

    @cached_property
    def num_inliers(self) -> int:
        """Return the number of inliers."""
        return len(self.inlier_query_idx)

    @cached_property
    def node_id(self) -> NodeId:
        """Return the node with the most inliers, -1 if there are no inliers."""
        node_ids, counts = np.unique(
            self.local_map.node_ids[self.inlier_point_idx], return_counts=True
        )
        return NodeId(int(node_ids[counts.argmax()]) if len(counts) else -1)


@dataclass(frozen=True, eq=False)
class PoseFit(PointMatches):
    """Hold matches and the pose fitted to them."""

    pose: AbsolutePose

    @property
    def inlier_query_idx(self) -> Int[np.ndarray, " n"]:
        """Return the feature of each inlier."""
        return self.matches.query_idx[self.pose.inliers]

    @property
    def inlier_point_idx(self) -> Int[np.ndarray, " n"]:
        """Return the map point of each inlier."""
        return self.matches.train_idx[self.pose.inliers]

    @cached_property
    def world_from_cam(self) -> Rigid3:
        """Return the pose."""
        return self.pose.cam_from_world.inverse()

    @cached_property
    def median_depth(self) -> float:
        """Return the median depth of the inliers, metres."""
        points_world = self.local_map.points_world[self.inlier_point_idx]
        return float(np.median(self.pose.cam_from_world.apply(points_world)[:, 2]))

    @cached_property
    def _bounding_box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Return the lower and upper corner (metres, world) of the box around the inliers'
        points."""
        columns = self.inlier_point_idx
        points, radii = self.local_map.points_world[columns], self.local_map.radii[columns][:, None]
        return (points - radii).min(axis=0), (points + radii).max(axis=0)

    def may_share_points(self, other: PoseFit) -> bool:
        """Return whether inliers of both may be the same map points. If the boxes are disjoint,
        they are not."""
        (low, high), (other_low, other_high) = self._bounding_box, other._bounding_box
        return bool(np.all(low <= other_high) and np.all(other_low <= high))

    @property
    def match_observations(self) -> PointObservations:
        """Return all matches, in the image of the features."""
        rows, points = self.matches.query_idx, self.local_map
        return PointObservations(
            self.features.points_img[rows],
            points.points_world[self.matches.train_idx],
            points.covariances[self.matches.train_idx],
        )

    def inlier_observations(self, scale: float) -> PointObservations:
        """Return the inliers, in an image `scale` times as wide as that of the features."""
        rows = np.flatnonzero(self.pose.inliers)
        return self.match_observations.select(rows).to_image_scale(scale)


def fit_pose(
    features: Features,
    input_camera: Camera | UncalibratedCamera,
    local_map: LocalMap,
    matches: Matches,
    config: AbsolutePoseConfig,
    start: tuple[Rigid3, Camera] | None = None,
    min_matches: float = float(MIN_POINTS),
    correlated_error_share: float = 0.0,
) -> PointMatches:
    """Fit a pose by robust PnP, or refine `start` (cam_from_world, camera).

    The focal length is estimated too if the camera is approximate. The result is a `PoseFit` if
    there are `min_matches` matches and enough of them agree on a pose.
    """
    camera = start[1] if start else nominal_camera(input_camera)
    if len(matches) < max(min_matches, MIN_POINTS):
        return PointMatches(features, input_camera, camera, local_map, matches)
    points_img = features.points_img[matches.query_idx].astype(np.float64)
    points_world = local_map.points_world[matches.train_idx]
    covariances = local_map.covariances[matches.train_idx]
    if isinstance(input_camera, UncalibratedCamera):
        found = estimate_pose_and_camera(
            points_img,
            points_world,
            input_camera,
            config,
            point_covariances=covariances,
            start=start,
            correlated_error_share=correlated_error_share,
        )
        pose, camera = found or (None, camera)
    else:
        pose = estimate_absolute_pose(
            points_img,
            points_world,
            input_camera,
            config,
            point_covariances=covariances,
            start=start[0] if start else None,
        )
    if pose is None:
        return PointMatches(features, input_camera, camera, local_map, matches)
    return PoseFit(features, input_camera, camera, local_map, matches, pose)
