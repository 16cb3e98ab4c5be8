"""Track map points from image to image, between two full localizations.

The inliers of a full localization are tracked with the Lucas-Kanade method and aligned with their
patches in that image (`points/point_tracking.py`). The pose is that of the localized image, moved
by the motion of the points. For this, each point is placed on the ray of its pixel in that image,
at the depth from the map. Errors of the map are then the same before and after the motion. Only
wrong depths affect the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from topoloc.geometry.absolute_pose import AbsolutePose, AbsolutePoseConfig, estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import ray_covariances
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.pose_fit import PointObservations
from topoloc.points.point_tracking import follow_points

# Position noise across the ray. The pixel defines the ray, so this only regularises the covariance.
_RAY_SIGMA_PX = 0.1


@dataclass(frozen=True, eq=False)
class TrackedMotion:
    """Hold the motion of an image relative to the localized one.

    `covariance` is that of the left perturbation of `cam_from_ref` (m, rad).
    """

    cam_from_ref: Rigid3
    covariance: Float[np.ndarray, "6 6"]
    num_tracked: int
    num_inliers: int
    tracked_ratio: float
    """Share of the initial points that agree on the pose."""
    shift_px: float
    """Median displacement of the points in the image since then, pixels."""


class PointTracker:
    """Hold the localized image, its points and their last pixels."""

    def __init__(
        self,
        grey: UInt8[np.ndarray, "h w"],
        inlier_points: PointObservations,
        cam_from_world: Rigid3,
        camera: Camera,
    ):
        # Maximum number of tracked points, spread over the image. More cost time and add
        # little.
        max_points = 320
        self._camera, self._cam_from_world = camera, cam_from_world
        inlier_points = _move_onto_rays(
            _select_spread_points(inlier_points, camera, max_points), cam_from_world, camera
        )
        self._inlier_points = inlier_points
        self._reference = grey.astype(np.float32)
        self._last_grey = grey
        self._last_points_img = inlier_points.points_img
        self._rows = np.arange(len(inlier_points))
        self._last_from_world = cam_from_world

    @property
    def camera(self) -> Camera:
        """Return the camera of the tracked images."""
        return self._camera

    def track_points(
        self, grey: UInt8[np.ndarray, "h w"], predicted_pose: Rigid3
    ) -> TrackedMotion | None:
        """Track the points into an image taken near `predicted_pose` (cam_from_world).

        Return the motion since the localized image, None if the points are lost.
        """
        for initial_pose in (predicted_pose, self._last_from_world):
            rows, points_img = self._find_points(grey, initial_pose)
            pose = self._estimate_pose(points_img, rows)
            if pose is not None:
                break
        else:
            return None
        agreeing = rows[pose.inliers]
        self._last_grey = grey
        self._last_points_img = points_img[pose.inliers]
        self._rows = agreeing
        self._last_from_world = pose.cam_from_world
        return TrackedMotion(
            cam_from_ref=pose.cam_from_world @ self._cam_from_world.inverse(),
            covariance=pose.covariance,
            num_tracked=len(rows),
            num_inliers=len(agreeing),
            tracked_ratio=len(agreeing) / len(self._inlier_points),
            shift_px=float(
                np.median(
                    np.linalg.norm(
                        self._last_points_img - self._inlier_points.points_img[agreeing], axis=1
                    )
                )
            ),
        )

    def _find_points(
        self, grey: UInt8[np.ndarray, "h w"], initial_pose: Rigid3
    ) -> tuple[np.ndarray, Float32[np.ndarray, "n 2"]]:
        """Return the rows of the points found again, and their pixels."""
        points_world = self._inlier_points.points_world[self._rows]
        before, after = (
            self._camera.img_from_cam(pose.apply(points_world))
            for pose in (self._last_from_world, initial_pose)
        )
        in_reference, now = (
            pose.apply(points_world)[:, 2] for pose in (self._cam_from_world, initial_pose)
        )
        rows, aligned = follow_points(
            self._last_grey,
            grey,
            self._last_points_img,
            after - before,
            self._reference,
            self._inlier_points.points_img[self._rows],
            (in_reference, now),
            max_shift_px=4.0,
        )
        return self._rows[rows], aligned.points_img

    def _estimate_pose(
        self, points_img: Float32[np.ndarray, "n 2"], rows: np.ndarray
    ) -> AbsolutePose | None:
        """Estimate the pose that enough points agree on, by RANSAC without a start.

        A refinement may not converge from an inaccurate prediction.
        """
        min_points = 20  # minimum number of points that agree on a pose
        min_agreeing = 0.6  # minimum share of the tracked points that agree on a pose
        if len(rows) < min_points:
            return None
        pose = estimate_absolute_pose(
            points_img.astype(np.float64), self._inlier_points.points_world[rows],
            self._camera,
            AbsolutePoseConfig(
                max_reprojection_error_px=2.0, sigma_px=0.5, max_iterations=300, min_iterations=20
            ),
            point_covariances=self._inlier_points.covariances[rows],
        )  # fmt: skip
        enough = max(min_points, min_agreeing * len(rows))
        return pose if pose is not None and np.count_nonzero(pose.inliers) >= enough else None


def _move_onto_rays(
    inlier_points: PointObservations, cam_from_world: Rigid3, camera: Camera
) -> PointObservations:
    """Move the points onto the rays of their pixels. Their covariance is that of the depth."""
    depths = cam_from_world.apply(inlier_points.points_world)[:, 2]
    rays = np.column_stack(
        [
            camera.normalized_from_img(inlier_points.points_img.astype(np.float64)),
            np.ones(len(inlier_points)),
        ]
    )
    points_cam, axis = rays * depths[:, None], cam_from_world.rotation[2]
    sigma_z = np.sqrt(
        np.maximum(np.einsum("i,nij,j->n", axis, inlier_points.covariances, axis), 0.0)
    )
    covariances = ray_covariances(
        points_cam, sigma_z, camera, np.full(len(inlier_points), _RAY_SIGMA_PX)
    )
    rotation = cam_from_world.rotation
    return PointObservations(
        inlier_points.points_img,
        cam_from_world.inverse().apply(points_cam),
        rotation.T @ covariances @ rotation,
    )


def _select_spread_points(
    inlier_points: PointObservations, camera: Camera, max_points: int
) -> PointObservations:
    """Select at most `max_points` points, in turn from the cells of a grid."""
    if len(inlier_points) <= max_points:
        return inlier_points
    cells = np.floor(inlier_points.points_img / [camera.width / 8.0, camera.height / 6.0]).astype(
        np.int64
    ) @ [1, 8]
    order = np.argsort(cells, kind="stable")
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    turns = np.arange(len(order)) - np.repeat(starts, np.diff(np.append(starts, len(order))))
    return inlier_points.select(np.sort(order[np.argsort(turns, kind="stable")[:max_points]]))
