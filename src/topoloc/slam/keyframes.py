"""Data structures of SLAM: key frames, landmarks and observations, and their triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.disk_list import DiskList
from topoloc.features.features import Features
from topoloc.geometry.rigid import Rigid3
from topoloc.points.metric_points import MetricPoints, StereoCamera


@dataclass(eq=False)
class DisparityBias:
    """Hold the common bias of a recording's disparities (pixels) and its information (1 / px^2).

    Rectification is never exact. An angle of one milliradian between the two cameras shifts all
    disparities by f / 1000. For a street camera this is most of a pixel, and distant points get
    wrong depths. Bundle adjustment estimates the bias from the motion (`bundle_adjustment.py`).
    """

    value_px: float = 0.0
    information: float = np.inf


@dataclass(eq=False)
class Landmarks:
    """Hold the positions of all landmarks by id, each in the world of its sub-map (metres)."""

    positions: Float[np.ndarray, "capacity 3"] = field(
        default_factory=lambda: np.full((1024, 3), np.nan)
    )
    num: int = 0

    def add(self, points_world: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Add landmarks and return their ids."""
        ids = np.arange(self.num, self.num + len(points_world))
        self.num += len(points_world)
        if self.num > len(self.positions):
            # grows by a quarter, so at most that much stays unused
            more = max(self.num - len(self.positions), len(self.positions) // 4)
            self.positions = np.concatenate([self.positions, np.full((more, 3), np.nan)])
        self.positions[ids] = points_world
        return ids


@dataclass(eq=False)
class KeyFrameObservations:
    """Hold the landmark observations of one key frame.

    `measured` is pixel and disparity (x, y, d), `weights` the inverse standard deviations. An
    unknown disparity has weight 0. `active` is False for outliers. The values have single
    precision, which suffices for image measurements, because they take most of the memory of a long
    trajectory.
    """

    landmark_ids: Int[np.ndarray, " n"]
    measured: Float[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n 3"]
    active: Bool[np.ndarray, " n"]

    def __post_init__(self) -> None:
        self.landmark_ids = np.asarray(self.landmark_ids, np.int32)
        self.measured = np.asarray(self.measured, np.float32)
        self.weights = np.asarray(self.weights, np.float32)

    @property
    def active_ids(self) -> Int[np.ndarray, " k"]:
        """Return the landmarks that are no outliers."""
        return self.landmark_ids[self.active]

    def append(self, other: KeyFrameObservations) -> None:
        """Append the rows of other observations."""
        for name, rows in vars(other).items():
            setattr(self, name, np.concatenate([getattr(self, name), rows]))


@dataclass(frozen=True, eq=False)
class PlaceFeatures:
    """Hold the local features of a key frame, and their metric points in its camera frame."""

    features: Features
    points: MetricPoints


@dataclass(frozen=True, eq=False)
class Motion:
    """Link a key frame to the earlier key frame `source`.

    `covariance` is that of the left perturbation of cam_from_source (m, rad).
    """

    source: KeyFrame
    covariance: Float[np.ndarray, "6 6"]


@dataclass(eq=False)
class KeyFrame:
    """Hold a frame that SLAM keeps.

    `cam_from_world` is that of the rectified view and changes with the optimisation. `motion` is
    None for the first key frame of a sub-map. The place features are stored in the shared on-disk
    list `places`, at `place_idx`.
    """

    recording: int
    frame_idx: int
    t_ns: int
    submap: int
    stereo: StereoCamera
    cam_from_world: Rigid3
    observations: KeyFrameObservations
    bias: DisparityBias
    motion: Motion | None = None
    places: DiskList[PlaceFeatures] = field(default_factory=lambda: DiskList[PlaceFeatures]())
    place_idx: int | None = None
    pending_place: Future[PlaceFeatures] | None = None

    @property
    def has_place(self) -> bool:
        """Return whether place features exist or are being extracted."""
        return self.place_idx is not None or self.pending_place is not None

    @property
    def place(self) -> PlaceFeatures:
        """Return the place features, which must exist.

        It waits for the extraction if that is still running (`pending_place`).
        """
        if self.pending_place is not None:
            self.place, self.pending_place = self.pending_place.result(), None
        if self.place_idx is None:
            raise ValueError("a key frame without place features")
        return self.places[self.place_idx]

    @place.setter
    def place(self, view: PlaceFeatures) -> None:
        self.place_idx = len(self.places)
        self.places.append(view)


@dataclass(frozen=True, eq=False)
class FramePose:
    """Hold the pose of a frame relative to a key frame, so that it moves with it."""

    frame_idx: int
    keyframe: KeyFrame
    cam_from_keyframe: Rigid3
    view_from_cam: Rigid3

    def world_from_cam(self) -> Rigid3:
        """Return the pose of the frame's original camera, which rectification may have rotated."""
        return (
            self.cam_from_keyframe @ self.keyframe.cam_from_world
        ).inverse() @ self.view_from_cam


def triangulate_points(
    keyframes: Sequence[KeyFrame], ids: Int[np.ndarray, " n"]
) -> tuple[
    Float[np.ndarray, "n 3"],
    Int[np.ndarray, " n"],
    Float[np.ndarray, " n"],
    Float[np.ndarray, " n"],
]:
    """Triangulate the points with these ids (ascending) from all observations, active or not.

    Return the points nearest to all rays (world), the number of rays, the largest angle between the
    first ray and another (radians), and the largest reprojection error (pixels), infinite behind a
    camera. Point and error are NaN if the point cannot be triangulated.
    """
    num = len(ids)
    rows_of_each, rays, pixels_of_each = [], [], []
    for keyframe in keyframes:
        observed = keyframe.observations
        chosen = np.flatnonzero(np.isin(observed.landmark_ids, ids))
        points_img = observed.measured[chosen, :2].astype(np.float64)
        world_from_cam = keyframe.cam_from_world.inverse()
        directions = keyframe.stereo.camera.rays_from_img(points_img) @ world_from_cam.rotation.T
        rays.append((np.tile(world_from_cam.translation, (len(chosen), 1)), directions))
        rows_of_each.append(np.searchsorted(ids, observed.landmark_ids[chosen]))
        pixels_of_each.append(points_img)
    rows = np.concatenate(rows_of_each)
    centres, directions = map(np.concatenate, zip(*rays, strict=True))
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal, right = np.zeros((num, 3, 3)), np.zeros((num, 3))
    np.add.at(normal, rows, across)
    np.add.at(right, rows, np.einsum("mij,mj->mi", across, centres))
    num_rays = np.bincount(rows, minlength=num)
    solvable = (num_rays > 1) & (np.abs(np.linalg.det(normal)) > 1e-12)
    points = np.full((num, 3), np.nan)
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable, :, None])[:, :, 0]
    first = np.zeros((num, 3))
    first[rows[::-1]] = directions[::-1]
    parallax, worst = np.zeros(num), np.where(solvable, 0.0, np.nan)
    cosines = np.clip(np.sum(first[rows] * directions, axis=1), -1.0, 1.0)
    np.maximum.at(parallax, rows, np.arccos(cosines))
    for keyframe, of_it, points_img in zip(keyframes, rows_of_each, pixels_of_each, strict=True):
        projected = keyframe.stereo.project(keyframe.cam_from_world.apply(points[of_it]))[:, :2]
        distances = np.linalg.norm(projected - points_img, axis=1)
        with np.errstate(invalid="ignore"):  # points that cannot be triangulated stay NaN
            np.maximum.at(worst, of_it, np.nan_to_num(distances, nan=np.inf))
    return points, num_rays, parallax, worst


def compute_steps(keyframes: Sequence[KeyFrame]) -> Float[np.ndarray, "2 n"]:
    """Return the steps between successive key frames of a sub-map, metres and radians."""
    rotations = np.array([k.cam_from_world.rotation for k in keyframes])
    translations = np.array([k.cam_from_world.translation for k in keyframes])
    turned = rotations[1:] @ rotations[:-1].transpose(0, 2, 1)
    moved = translations[1:] - np.einsum("nij,nj->ni", turned, translations[:-1])
    cosines = 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0)
    return np.stack([np.linalg.norm(moved, axis=1), np.arccos(np.clip(cosines, -1.0, 1.0))])
