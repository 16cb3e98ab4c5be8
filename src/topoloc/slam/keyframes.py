"""Key frames and the landmarks that they see: what SLAM remembers. Data, and the few questions
asked of it."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.disk_list import DiskList
from topoloc.features.features import Features
from topoloc.geometry.rigid import Rigid3
from topoloc.points.disparity import StereoCamera
from topoloc.points.metric_points import MetricPoints


@dataclass(eq=False)
class DisparityBias:
    """What a recording's measured disparities are too large by, pixels, and how well that is known
    (1 / px^2).

    Rectification is never perfect: an angle of one milliradian between the two cameras shifts all
    disparities by f / 1000, most of a pixel in a street camera, and makes all that is far too far
    or too near. Motion tells: see `bundle`.
    """

    value_px: float = 0.0
    information: float = np.inf


@dataclass(eq=False)
class Landmarks:
    """Positions of all landmarks by their id, each in the world of its sub-map (metres)."""

    positions: Float[np.ndarray, "capacity 3"] = field(
        default_factory=lambda: np.full((1024, 3), np.nan)
    )
    num: int = 0

    def add(self, points_world: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Their new ids."""
        ids = np.arange(self.num, self.num + len(points_world))
        self.num += len(points_world)
        if self.num > len(self.positions):
            # by a quarter: of a long walk's landmarks no more room stays empty than that
            more = max(self.num - len(self.positions), len(self.positions) // 4)
            self.positions = np.concatenate([self.positions, np.full((more, 3), np.nan)])
        self.positions[ids] = points_world
        return ids


@dataclass(eq=False)
class Observations:
    """What one key frame sees of landmarks: pixel and disparity (x, y, d) and the inverse of their
    standard deviations.

    An unknown disparity has weight 0. `active` is False for what has been found to be wrong. All of
    it is kept in single precision, which is that of the pictures' measurements: of a long walk
    nothing else takes as much memory.
    """

    landmark_ids: Int[np.ndarray, " n"]
    measured: Float[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n 3"]
    active: Bool[np.ndarray, " n"]

    def __post_init__(self) -> None:
        self.landmark_ids = np.asarray(self.landmark_ids, np.int32)
        self.measured, self.weights = (
            np.asarray(self.measured, np.float32),
            np.asarray(self.weights, np.float32),
        )

    def append(self, other: Observations) -> None:
        self.landmark_ids = np.concatenate([self.landmark_ids, other.landmark_ids])
        self.measured = np.concatenate([self.measured, other.measured])
        self.weights = np.concatenate([self.weights, other.weights])
        self.active = np.concatenate([self.active, other.active])


@dataclass(frozen=True, eq=False)
class PlaceFeatures:
    """How a key frame looks: local features, and their metric points in the key frame's camera."""

    features: Features
    points: MetricPoints


@dataclass(frozen=True, eq=False)
class Motion:
    """How a key frame follows from an earlier one, `source`: covariance of the left perturbation of
    cam_from_source (m, rad)."""

    source: KeyFrame
    covariance: Float[np.ndarray, "6 6"]


@dataclass(eq=False)
class KeyFrame:
    """A frame that SLAM keeps. `cam_from_world` is that of the rectified view and changes as the
    map is optimised.

    `motion` is None for the first of a sub-map. How it looks lies on a shelf that it shares with
    others (`places`), at `place_idx`.
    """

    recording: int
    frame_idx: int
    t_ns: int
    submap: int
    stereo: StereoCamera
    cam_from_world: Rigid3
    observations: Observations
    bias: DisparityBias
    motion: Motion | None = None
    places: DiskList[PlaceFeatures] = field(default_factory=lambda: DiskList[PlaceFeatures]())
    place_idx: int | None = None
    pending_place: Future[PlaceFeatures] | None = None

    @property
    def has_place(self) -> bool:
        """Whether it is known how it looks, or will be."""
        return self.place_idx is not None or self.pending_place is not None

    @property
    def place(self) -> PlaceFeatures | None:
        """How it looks, where that is known; waits for what a thread still looks at
        (`pending_place`)."""
        if self.pending_place is not None:
            self.place, self.pending_place = self.pending_place.result(), None
        return None if self.place_idx is None else self.places[self.place_idx]

    @place.setter
    def place(self, view: PlaceFeatures) -> None:
        self.place_idx = len(self.places)
        self.places.append(view)


@dataclass(frozen=True, eq=False)
class FramePose:
    """Where a frame is: relative to a key frame, so that it moves with it."""

    frame_idx: int
    keyframe: KeyFrame
    cam_from_keyframe: Rigid3
    view_from_cam: Rigid3

    def world_from_cam(self) -> Rigid3:
        """The pose of the frame's own camera, which rectification may have turned."""
        return (
            self.cam_from_keyframe @ self.keyframe.cam_from_world
        ).inverse() @ self.view_from_cam
