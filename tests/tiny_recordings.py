"""Make images and poses of the tiny recordings, and their text forms."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoFrame, StereoSequence

WIDTH, HEIGHT = 32, 24


def picture(seed: int, channels: int = 1, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return a different image for each seed: grey, or OpenCV's BGR."""
    shape = (height, width) if channels == 1 else (height, width, channels)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def write(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def pose(index: int) -> Rigid3:
    return Rigid3(
        exp_so3(np.array([0.01, 0.1, -0.05]) * (index + 1)),
        np.array([1.0 + index, -0.5 * index, 2.0]),
    )


def kitti_row(rigid: Rigid3) -> str:
    return " ".join(f"{value:.15e}" for value in rigid.matrix()[:3].ravel())


def tum_line(seconds: str, rigid: Rigid3) -> str:
    w, x, y, z = rigid.quat_wxyz()
    return " ".join([seconds, *(f"{value:.15g}" for value in (*rigid.translation, x, y, z, w))])


def assert_same_pose(one: Rigid3 | None, other: Rigid3 | None, tolerance: float = 1e-9) -> None:
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.matrix(), other.matrix(), atol=tolerance)


def assert_same_frame(one: StereoFrame, other: StereoFrame) -> None:
    assert (one.name, one.t_ns, one.camera) == (other.name, other.t_ns, other.camera)
    np.testing.assert_array_equal(one.image, other.image)
    assert (one.right is None, one.rig is None) == (other.right is None, other.rig is None)
    assert (one.depth is None) == (other.depth is None)
    assert one.world_from_cam is other.world_from_cam


def assert_slices(sequence: StereoSequence) -> None:
    """Check that a slice has the same frames and poses, and that all Python indices work."""
    num_frames = len(sequence)
    assert re.fullmatch(r"\w+\(.*, [0-9]+ frames( of stereo| with depth)?\)", repr(sequence))
    assert len(repr(sequence[:][:][:])) < 200
    for cut in (slice(1, num_frames), slice(None, None, -2), slice(-2, 99, np.int64(1))):
        part, rows = sequence[cut], range(num_frames)[cut]
        assert isinstance(part, StereoSequence)
        assert (part.name, len(part)) == (sequence.name, len(rows))
        assert part.t_ns == [sequence.t_ns[row] for row in rows]
        assert part.names == [sequence.names[row] for row in rows]
        for frame, row in zip(part, rows, strict=True):
            assert_same_frame(frame, sequence[row])
        assert_same_frame(part[-1:][0], sequence[np.int32(rows[-1])])
    assert_same_frame(sequence[-num_frames], sequence[np.uint8(0)])
    assert len(sequence[3:3]) == 0
    for index in (num_frames, -num_frames - 1, np.int64(99)):
        with pytest.raises(IndexError, match=f": no frame {index}; it has {num_frames}$") as raised:
            sequence[index]
        assert str(raised.value).startswith(f"{sequence.name}: ")


CALIB = "\n".join(
    [
        "P0: 50 0 16 0 0 50 12 0 0 0 1 0",
        "P1: 50 0 16 -10 0 50 12 0 0 0 1 0",
        "P2: 60 0 15 3 0 60 11 0 0 0 1 0",
        "P3: 60 0 15 -27 0 60 11 0.06 0 0 1 0",
        "Tr: 1 0 0 0 0 1 0 0 0 0 1 0",
    ]
)


EUROC_TIMES = [1403715273262142976 + 50_000_000 * index for index in range(4)]
BODY_FROM_CAM = (
    Rigid3(exp_so3(np.array([0.0, 0.0, 1.5])), np.array([0.1, 0.2, 0.3])),
    Rigid3(np.eye(3), np.array([0.2, 0.2, 0.3])),
)


def sensor_yaml(body_from_cam: Rigid3, distortion: str = "radial-tangential") -> str:
    data = ", ".join(f"{value:.15g}" for value in body_from_cam.matrix().ravel())
    return (
        "%YAML:1.0\n# a sensor\nsensor_type: camera\ncomment: VI-Sensor cam0 (MT9M034)\n\nT_BS:\n "
        f" cols: 4\n  rows: 4\n  data: [{data}]\n\nrate_hz: 20\nresolution: [{WIDTH},"
        f" {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [45.5, 45.25, 16.5, 12.5] #fu, fv, cu,"
        f" cv\ndistortion_model: {distortion}\ndistortion_coefficients: [-0.28, 0.07,\n   0.0002,"
        " 1.7e-05]\n"
    )


CAMERA = {
    "model": "PINHOLE",
    "width": WIDTH,
    "height": HEIGHT,
    "fx": 40.0,
    "fy": 41.0,
    "cx": 15.5,
    "cy": 11.5,
}
