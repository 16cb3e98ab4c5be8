"""Check that pairs tell of a lens that their calibration leaves out, and that right ones tell of
none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from room_frames import FrameList
from topoloc.apps.cli import main
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.slam.input_checks import find_left_out_lens

BENDS = {
    "OPENCV_FISHEYE": (0.0, 0.0, 0.0, 0.0),
    "OPENCV": (-0.3, 0.08, 0.0, 0.0),
    "RADIAL": (-0.15, 0.0),
}


def lens_of(camera: Camera, model: str) -> Camera:
    fx, fy, cx, cy = camera.intrinsics
    focal = (fx, cx, cy) if model == "RADIAL" else (fx, fy, cx, cy)
    return Camera(model, camera.width, camera.height, (*focal, *BENDS[model]))


def bent(frame: StereoFrame, model: str) -> StereoFrame:
    """Return a rectified pair as another lens shows it, with its old calibration."""
    assert frame.right is not None
    assert frame.rig is not None
    camera = frame.rig.left
    pixels = np.indices((camera.height, camera.width), dtype=np.float64)[::-1].reshape(2, -1).T
    seen = lens_of(camera, model).normalized_from_img(pixels)
    at = np.nan_to_num(seen * [camera.fx, camera.fy] + [camera.cx, camera.cy], nan=-1.0)
    at = at.astype(np.float32).reshape(camera.height, camera.width, 2)
    left, right = (
        cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        for image in (frame.image, frame.right)
    )
    return replace(frame, image=left, right=right, world_from_cam=None)


def walk(num: int = 12) -> StereoSequence:
    return open_sequence(f"{SHIPPED / 'map_lap1'}@0:{num}")


@pytest.mark.parametrize("model", BENDS)
def test_a_lens_that_the_calibration_leaves_out_is_told(model: str):
    note = find_left_out_lens(FrameList([bent(one, model) for one in walk()]))
    assert note is not None
    assert "k1 of about -0." in note
    assert "\n" not in note


def test_the_named_remedy_is_right(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    sequence, root = walk(), tmp_path / "walk"
    for row, frame in enumerate(sequence):
        pair = bent(frame, "OPENCV_FISHEYE")
        for name, image in (("left", pair.image), ("right", pair.right)):
            (root / name).mkdir(parents=True, exist_ok=True)
            assert image is not None
            cv2.imwrite(str(root / name / f"{row:06d}.png"), image)
    rig = sequence[0].rig
    assert rig is not None
    plain = json.dumps(rig.left.to_json() | {"baseline": rig.baseline})
    lens = lens_of(rig.left, "OPENCV_FISHEYE").to_json()
    pose = rig.right_from_left.matrix().tolist()
    right = json.dumps({"left": lens, "right": lens, "right_from_left": pose})
    ways = []
    for calibration in (plain, right):
        (root / "camera.json").write_text(calibration)
        assert main(["slam", str(root), str(tmp_path / "walk.tum")]) == 0
        found = np.loadtxt(tmp_path / "walk.tum")
        ways.append(np.linalg.norm(found[-1, 1:4] - found[0, 1:4]))
        warned = "a lens bends the pictures" in capfd.readouterr().err
        assert warned == (calibration == plain)
    first, last = sequence.poses[0], sequence.poses[-1]
    assert first is not None
    assert last is not None
    true = np.linalg.norm(last.translation - first.translation)
    assert ways[1] == pytest.approx(true, rel=0.03)


@pytest.mark.parametrize(
    "name",
    [
        *("kitti/sequences/street1@0:16", "kitti/sequences/street2@8:24"),
        *("zed_lab/session1@0::10", "zed_lab/session2@0:12", "euroc/v1_01_part@0:16"),
    ],
)
def test_right_pairs_are_not_accused(shared: Path, name: str):
    assert find_left_out_lens(open_sequence(shared / "data" / name)) is None


def test_a_calibration_without_its_distortion_is_told(shared: Path):
    sequence = open_sequence(shared / "data/euroc/v1_01_part@0:16")
    rig = sequence[0].rig
    assert rig is not None
    plain = StereoRig(rig.left.undistorted(), rig.right.undistorted(), rig.right_from_left)
    frames = [replace(one, rig=plain, camera=plain.left) for one in sequence]
    assert find_left_out_lens(FrameList(frames)) is not None


def test_demo_and_images_alone_are_not_accused():
    assert find_left_out_lens(walk()) is None
    assert find_left_out_lens(open_sequence(SHIPPED / "day")) is None
