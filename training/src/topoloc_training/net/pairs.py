"""Find the same points by day and in other light: pixels of a stereo recording, and of single
images of the same rendered place.

Depth comes from the day's stereo pair, poses from ground truth. Points that are occluded in the
other image are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from topoloc.apps.formats.kitti import open_kitti
from topoloc.errors import RecordingError
from topoloc.geometry.camera import Camera
from topoloc.recordings.folder import open_folder
from topoloc.recordings.frame import StereoFrame, to_grey

_NEAREST = 3  # day's pictures for one of the others
_REACH = 2.0  # metres
_TURN = np.cos(np.deg2rad(25))
_CELL = 8  # pixels of a cell of the depth test
_SLACK = 1.05
_FEWEST = 200


@dataclass(frozen=True, eq=False)
class Pair:
    """Pixels of the day's picture and the same points' pixels in the other, both by path of the
    picture."""

    day: str
    other: str
    day_px: Float[np.ndarray, "n 2"]
    other_px: Float[np.ndarray, "n 2"]


def find_pairs(day_folder: str, other_folder: str) -> list[Pair]:
    """Pairs of pictures that see the same, for each picture of the other recording up to three of
    the day's.

    Raises:
        RecordingError: a frame has no pose, no calibration or, of the day's, no right picture.
    """
    days, others = open_kitti(Path(day_folder)), open_folder(Path(other_folder))
    day_poses = np.array([pose.matrix() for pose in days.poses if pose is not None])
    if len(day_poses) < len(days):
        raise RecordingError(f"{day_folder}: every frame needs a pose")
    clouds: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    pairs = []
    for j in range(len(others)):
        frame = others[j]
        if frame.world_from_cam is None or frame.camera is None:
            raise RecordingError(f"{other_folder}: {frame.name} needs a pose and a calibration")
        pose = frame.world_from_cam.matrix()
        distance = np.linalg.norm(day_poses[:, :3, 3] - pose[:3, 3], axis=1)
        distance[day_poses[:, :3, 2] @ pose[:3, 2] < _TURN] = np.inf
        for i in np.argsort(distance)[:_NEAREST]:
            if distance[i] > _REACH:
                break
            if i not in clouds:
                clouds[i] = located_pixels(days[int(i)])
            pixels, points = clouds[i]
            seen, at = seen_by(points, np.linalg.inv(pose) @ day_poses[i], frame.camera)
            if len(seen) >= _FEWEST:
                pairs.append(
                    Pair(
                        str(days.root / days.names[i]),
                        str(others.root / others.names[j]),
                        pixels[seen],
                        at,
                    )
                )
    return pairs


def located_pixels(frame: StereoFrame) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of the left picture, every other row and column, and their points in the left
    camera."""
    if frame.right is None or frame.rig is None:
        raise RecordingError(f"{frame.name}: no stereo pair")
    left, right = to_grey(frame.image), to_grey(frame.right)
    matcher = cv2.StereoSGBM.create(
        0,
        64,
        5,
        200,
        800,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=80,
        speckleRange=2,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    y, x = np.nonzero(disparity > 1.0)
    chosen = (x % 2 == 0) & (y % 2 == 0)
    x, y = x[chosen], y[chosen]
    camera = frame.rig.left
    z = camera.fx * frame.rig.baseline / disparity[y, x]
    points = np.column_stack([(x - camera.cx) / camera.fx * z, (y - camera.cy) / camera.fy * z, z])
    return np.column_stack([x, y]).astype(np.float32), points


def seen_by(
    points: np.ndarray, other_from_day: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the points that the other image sees, and their pixels. The nearest
    point of a cell occludes the others."""
    local = points @ other_from_day[:3, :3].T + other_from_day[:3, 3]
    front = np.flatnonzero(local[:, 2] > 0.3)
    local = local[front]
    at = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = (
        (at[:, 0] > 2)
        & (at[:, 1] > 2)
        & (at[:, 0] < camera.width - 3)
        & (at[:, 1] < camera.height - 3)
    )
    front, at, z = front[inside], at[inside], local[inside, 2]
    cell = (at[:, 1] // _CELL).astype(int) * (camera.width // _CELL + 1) + (
        at[:, 0] // _CELL
    ).astype(int)
    nearest = np.full(cell.max() + 1 if len(cell) else 1, np.inf)
    np.minimum.at(nearest, cell, z)
    visible = z < nearest[cell] * _SLACK
    return front[visible], at[visible].astype(np.float32)
