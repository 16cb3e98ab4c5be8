"""Read recordings of several cameras, and panoramas, as single images with poses."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc import CalibrationError, RecordingError, Rigid3, Trajectory, open_sequence
from topoloc.recordings.open import find_format

CAMERA = {"model": "PINHOLE", "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 32, "cy": 24}
LEFT = [[0, 0, -1, -0.1], [0, 1, 0, 0], [1, 0, 0, 0]]
AHEAD = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]


def _grey(value: int) -> np.ndarray:
    return np.full((48, 64), value, np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a rig of two cameras with three instants, the second without an image to the left."""
    mounted = {"ahead": {"rig_from_cam": AHEAD}, "left": {"rig_from_cam": LEFT, "camera": CAMERA}}
    (tmp_path / "rig.json").write_text(json.dumps({"cameras": mounted}))
    for name, brightness in (("ahead", 50), ("left", 100)):
        (tmp_path / name).mkdir()
        for k in range(3):
            if (name, k) != ("left", 1):
                cv2.imwrite(str(tmp_path / name / f"{k}.png"), _grey(brightness + k))
    (tmp_path / "ahead" / "camera.json").write_text(json.dumps(CAMERA))
    poses = [Rigid3(np.eye(3), np.array([0.0, 0.0, k])) for k in range(3)]
    names = {f"{k}.png": pose for k, pose in enumerate(poses)}
    rows = ["image x y z qx qy qz qw"]
    rows += [f"{name} 0 0 {pose.translation[2]} 0 0 0 1" for name, pose in names.items()]
    (tmp_path / "poses.txt").write_text("\n".join(rows[1:]) + "\n")
    return tmp_path


def test_each_image_is_a_frame_with_the_pose_of_its_camera(folder: Path):
    assert find_format(folder) == "rig"
    recording = open_sequence(folder)
    assert recording.names == [
        "ahead/0.png",
        "left/0.png",
        "ahead/1.png",
        "ahead/2.png",
        "left/2.png",
    ]
    assert all(
        after > before for before, after in zip(recording.t_ns, recording.t_ns[1:], strict=False)
    )
    frame = recording[4]
    assert frame.image[0, 0] == 102
    assert frame.world_from_cam is not None
    expected = Rigid3(np.eye(3), np.array([0.0, 0.0, 2.0])) @ Rigid3.from_json(LEFT)
    assert np.allclose(frame.world_from_cam.matrix(), expected.matrix())
    assert recording[0].camera == frame.camera  # one from its recording, one from rig.json
    assert [pose is not None for pose in recording.poses] == [True] * 5


def test_poses_of_the_cameras_serve_if_the_rig_has_none(folder: Path):
    (folder / "poses.txt").unlink()
    moved = Rigid3(np.eye(3), np.array([7.0, 0.0, 0.0]))
    Trajectory([moved] * 3, [10**9, 2 * 10**9, 3 * 10**9]).write_tum(folder / "ahead" / "truth.tum")
    (folder / "ahead" / "times.txt").write_text("1.0\n2.0\n3.0\n")
    recording = open_sequence(folder)
    known = [pose is not None for pose in recording.poses]
    assert known == [name.startswith("ahead") for name in recording.names]


def test_bad_folders_are_one_line(folder: Path):
    for path in (folder / "left").iterdir():
        path.rename(path.with_name(f"l{path.name}"))
    with pytest.raises(RecordingError, match="name the images of one instant alike"):
        open_sequence(folder)
    for name in ("left", "ahead"):
        (folder / name).rename(folder / f"cam_{name}")
    with pytest.raises(
        RecordingError, match=r"no folder is named as a camera of .* \(ahead, left\)"
    ):
        open_sequence(folder)
    (folder / "rig.json").write_text("{}")
    with pytest.raises(CalibrationError, match="missing required field `cameras`"):
        open_sequence(folder)


def test_views_of_panoramas_have_the_poses_of_their_directions(tmp_path: Path):
    for k in range(2):
        image = np.zeros((64, 128), np.uint8)
        image[:, 64 - 8 : 64 + 8] = 200  # the centre of the image is ahead
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    (tmp_path / "poses.txt").write_text("0.png 0 0 0 0 0 0 1\n1.png 0 0 5 0 0 0 1\n")
    recording = open_sequence(tmp_path, format="equirectangular")
    assert recording.names[:5] == [
        "ahead/0.png",
        "right/0.png",
        "behind/0.png",
        "left/0.png",
        "ahead/1.png",
    ]
    ahead, right = recording[4], recording[5]
    assert ahead.image[ahead.image.shape[0] // 2, ahead.image.shape[1] // 2] == 200
    assert right.image.max() == 0
    assert right.world_from_cam is not None
    assert np.allclose(right.world_from_cam.translation, [0, 0, 5])
    # the optical axis of the view to the right is the x axis of the panorama
    assert np.allclose(right.world_from_cam.rotation[:, 2], [1, 0, 0])
    assert recording.poses[5] is not None
    assert np.allclose(recording.poses[5].matrix(), right.world_from_cam.matrix())
