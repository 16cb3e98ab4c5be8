"""Test Record3D's export in its published format. The format's own library writes the EXR files."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiny_recordings import HEIGHT, WIDTH, assert_same_pose, picture, pose, write
from topoloc.errors import (
    CalibrationError,
    MissingExtraError,
    RecordingError,
    TopolocError,
    TrajectoryError,
    UnreadableImageError,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import find_format, open_sequence

Make = Callable[..., Path]
needs_exr = pytest.mark.skipif(
    importlib.util.find_spec("OpenEXR") is None, reason="OpenEXR is not installed"
)


def _arkit_row(world_from_cam: Rigid3) -> list[float]:
    """Return qx qy qz qw tx ty tz with ARKit's camera axes: y up, z back."""
    arkit = Rigid3(world_from_cam.rotation @ np.diag([1.0, -1.0, -1.0]), world_from_cam.translation)
    w, x, y, z = arkit.quat_wxyz()
    return [x, y, z, w, *arkit.translation]


@pytest.fixture
def export(tmp_path: Path) -> Make:
    def make(**changes: Any) -> Path:
        root = tmp_path / "walk" / "EXR_RGBD"
        for index in range(3):
            write(root / "rgb" / f"{index}.jpg", picture(index, 3))
        data = {
            "w": WIDTH,
            "h": HEIGHT,
            "dw": WIDTH // 2,
            "dh": HEIGHT // 2,
            "fps": 30,
            "K": [40.0, 0, 0, 0, 41.0, 0, 15.0, 11.0, 1],  # column by column
            "poses": [_arkit_row(pose(index)) for index in range(3)],
            "frameTimestamps": [0.5, 0.533, 0.6],
        }
        kept = {key: value for key, value in (data | changes).items() if value is not None}
        (root / "metadata.json").write_text(json.dumps(kept))
        return tmp_path / "walk"

    return make


def _with_depth(folder: Path) -> Path:
    import OpenEXR

    root = folder / "EXR_RGBD"
    (root / "depth").mkdir()
    for index in range(3):
        depth = np.full((HEIGHT // 2, WIDTH // 2), 1.0 + index, np.float32)
        depth[0, 0] = np.nan
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"R": depth}).write(str(root / "depth" / f"{index}.exr"))
    return folder


def test_poses_times_and_camera(export: Make):
    folder = export()
    assert find_format(folder) == find_format(folder / "EXR_RGBD") == "record3d"
    sequence = open_sequence(folder)
    assert sequence.names == ["rgb/0.jpg", "rgb/1.jpg", "rgb/2.jpg"]
    assert sequence.t_ns == [500_000_000, 533_000_000, 600_000_000]
    for index, found in enumerate(sequence.poses):
        assert_same_pose(found, pose(index))
    assert sequence[1].camera == Camera.pinhole(WIDTH, HEIGHT, 40.0, 41.0, 15.0, 11.0)
    assert sequence[1].depth is None


def test_intrinsics_of_each_frame_and_finer_pictures(export: Make):
    per_frame = [[20.0 + index, 20.0, 7.5, 5.5] for index in range(3)]
    sequence = open_sequence(
        export(w=WIDTH // 2, h=HEIGHT // 2, perFrameIntrinsicCoeffs=per_frame, frameTimestamps=None)
    )
    camera = sequence[2].camera
    assert camera == Camera.pinhole(WIDTH, HEIGHT, 44.0, 40.0, 15.5, 11.5)
    assert sequence.t_ns[1] == 33_333_333


@needs_exr
def test_depth(export: Make):
    depth = open_sequence(_with_depth(export()))[2].depth
    assert depth is not None
    assert (depth.camera.width, depth.camera.height) == (WIDTH // 2, HEIGHT // 2)
    assert np.isnan(depth.depth[0, 0])
    np.testing.assert_allclose(depth.depth[1:], 3.0, rtol=1e-6)


@needs_exr
def test_damaged_depth(export: Make):
    folder = _with_depth(export())
    file = folder / "EXR_RGBD" / "depth" / "0.exr"
    whole = file.read_bytes()
    for data in (
        b"",
        b"v/1\x01",
        whole[:100],
        whole[: len(whole) // 2],
        b"\xff" * 500,
        picture(0).tobytes(),
    ):
        file.write_bytes(data)
        with pytest.raises(UnreadableImageError, match=r"0\.exr"):
            open_sequence(folder)[0]


@needs_exr
def test_without_the_extra(export: Make, monkeypatch: pytest.MonkeyPatch):
    sequence = open_sequence(_with_depth(export()))
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingExtraError, match=r"topoloc\[exr\]"):
        sequence[0]


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"poses": []}, RecordingError, "0 poses for 3 images"),
        (
            {"poses": [[0, 0, 0, 0, 1, 2, 3]] * 3},
            TrajectoryError,
            "pose 0: qx qy qz qw is no rotation",
        ),
        (
            {"poses": [[0, 0, 0, 1, 1, 2]] * 3},
            RecordingError,
            r"poses\[0\]: Expected `array` of length 7",
        ),
        (
            {"poses": [[0, 0, 0, 1, 1, 2, float("nan")]] * 3},
            RecordingError,
            r"poses\[0\]\[6\]: a finite number",
        ),
        ({"K": None}, CalibrationError, "neither K nor"),
        ({"K": [0] * 9}, CalibrationError, "focal length"),
        (
            {"perFrameIntrinsicCoeffs": [[1, 2, 3, 4]]},
            CalibrationError,
            "1 perFrameIntrinsicCoeffs for 3 images",
        ),
        ({"w": 100}, CalibrationError, "of 100x24, but 0.jpg is 32x24"),
        ({"frameTimestamps": [1.0, 0.5, 2.0]}, RecordingError, "do not increase"),
        ({"frameTimestamps": [1.0]}, RecordingError, "1 frameTimestamps for 3 images"),
    ],
)
def test_invalid_exports_are_refused(
    export: Make, changes: dict[str, Any], error: type[TopolocError], says: str
):
    with pytest.raises(error, match=says):
        open_sequence(export(**changes))
