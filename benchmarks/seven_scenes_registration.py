"""Compare transforms between the Kinect's cameras of 7-Scenes by the strength of colour edges at
depth edges.

    python benchmarks/seven_scenes_registration.py PATH_OF_A_RUN

A row is the mean gradient of the colour image, over that of the whole image, at the near side of
every depth jump.
"""

from __future__ import annotations

import sys

import cv2
import numpy as np

from topoloc.apps.formats.seven_scenes import COLOUR_CAMERA, COLOUR_FROM_DEPTH, DEPTH_CAMERA
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoFrame, to_grey
from topoloc.recordings.open import open_sequence

EVERY = 7
BORDER_PX = 4


def edges(frame: StereoFrame) -> tuple[np.ndarray, np.ndarray]:
    """Gradient strength of the colour picture, and the points (depth camera, metres) on the near
    side of depth jumps."""
    grey = cv2.GaussianBlur(to_grey(frame.image), (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    depth = frame.depth.depth
    near = np.zeros(depth.shape, bool)
    for shift in ((0, 2), (0, -2), (2, 0), (-2, 0)):
        near |= np.roll(depth, shift, (0, 1)) - depth > 0.1 * depth
    inner = np.zeros_like(near)
    inner[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    v, u = np.nonzero(near & inner)
    rays = DEPTH_CAMERA.normalized_from_img(np.column_stack([u, v]).astype(np.float64))
    return strength / strength.mean(), np.column_stack([rays, np.ones(len(rays))]) * depth[
        v, u, None
    ].astype(np.float64)


def score(
    found: list[tuple[np.ndarray, np.ndarray]],
    cam_from_depth: Rigid3,
    focal: float,
    cx: float,
    cy: float,
) -> float:
    values = []
    for strength, points_depth in found:
        points_cam = cam_from_depth.apply(points_depth)
        pixels = (points_cam[:, :2] / points_cam[:, 2:] * focal + [cx, cy]).astype(np.float32)
        values.append(
            cv2.remap(
                strength,
                pixels[None, :, 0],
                pixels[None, :, 1],
                cv2.INTER_LINEAR,
                borderValue=np.nan,
            )[0]
        )
    return float(np.nanmean(np.concatenate(values)))


def main(path: str) -> None:
    sequence = open_sequence(path, format="seven_scenes")
    found = [edges(sequence[index]) for index in range(0, len(sequence), EVERY)]
    focal, _, cx, cy = COLOUR_CAMERA.params
    shift_only = Rigid3(np.eye(3), COLOUR_FROM_DEPTH.translation)
    rows = [
        ("as used", COLOUR_FROM_DEPTH, focal, cx, cy),
        ("its inverse", COLOUR_FROM_DEPTH.inverse(), focal, cx, cy),
        ("its shift alone", shift_only, focal, cx, cy),
        ("its rotation alone", Rigid3(COLOUR_FROM_DEPTH.rotation, np.zeros(3)), focal, cx, cy),
        ("none, f of colour", Rigid3.identity(), focal, cx, cy),
        ("none, f of depth (as registered)", Rigid3.identity(), DEPTH_CAMERA.fx, cx, cy),
        *(
            (f"as used, f {other:g}", COLOUR_FROM_DEPTH, other, cx, cy)
            for other in (515.0, 520.0, 530.0, 535.0)
        ),
        ("as used, centre +4, +4", COLOUR_FROM_DEPTH, focal, cx + 4.0, cy + 4.0),
        ("as used, centre -4, -4", COLOUR_FROM_DEPTH, focal, cx - 4.0, cy - 4.0),
    ]
    for name, *calibration in rows:
        print(f"{name:34s} {score(found, *calibration):.3f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
