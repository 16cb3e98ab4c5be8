"""Photograph the rendered room of `tiny_world` as with a phone: single images on a loop, in an
order of their own, of a camera that nobody calibrated, with a printed tag before the back wall."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

import tiny_world
from topoloc.geometry.rigid import Rigid3, exp_so3

_TEXELS = 32  # of the tag's side; a texel is 1 / 90 m
TAG_SIDE = _TEXELS / 90.0
NAMES = [f"IMG_{number:04d}.jpg" for number in range(18)]


def tag_panel() -> tiny_world.Panel:
    """Return a board with a printed AprilTag, number 7 of 36h11."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    tag = cv2.aruco.generateImageMarker(known, 7, _TEXELS)
    texture = cv2.copyMakeBorder(tag, 10, 10, 10, 10, cv2.BORDER_CONSTANT, value=(235.0,))
    half = texture.shape[0] / 90.0 / 2.0
    axes = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    shade = np.clip(texture.astype(np.float32), 20.0, 235.0)
    return tiny_world.Panel(np.array([0.9, 2.3, 0.1]), *axes, (half, half), shade)


def photo_pose(number: int) -> Rigid3:
    """Return world_from_cam of a photo. Successive ones are not neighbours."""
    turn = 2.0 * np.pi * (7 * number % len(NAMES)) / len(NAMES)
    position = [0.9 + 0.9 * np.cos(turn), 0.5 * np.sin(2.0 * turn) - 0.2, 0.3 * np.sin(turn)]
    towards = np.array([0.9, 2.6, 0.0]) - position
    yaw = np.arctan2(-towards[0], towards[1]) + 0.1 * np.sin(3.0 * turn)
    tilt = exp_so3(np.array([0.1 * np.cos(2.0 * turn), 0.0, 0.0]))
    rotation = exp_so3(np.array([0.0, 0.0, yaw])) @ tilt @ tiny_world.LEVEL_FROM_CAM
    return Rigid3(rotation, np.array(position))


def photo(number: int) -> np.ndarray:
    """Return the grey image of a photo."""
    panels = [*tiny_world.room(), tag_panel()]
    return tiny_world.render(panels, photo_pose(number), noise_seed=number)[0]


def write_photos(folder: Path, numbers: range = range(len(NAMES))) -> Path:
    """Write photos to a new folder, and return it."""
    folder.mkdir()
    for number in numbers:
        assert cv2.imwrite(str(folder / NAMES[number]), photo(number))
    return folder


def distance(one: int, other: int) -> float:
    """Return the distance of two photos' cameras in metres."""
    step = photo_pose(one).translation - photo_pose(other).translation
    return float(np.linalg.norm(step))
