"""Test poses as people have them: by the names of images, as matrices in a folder, with numbers
instead of times; and the map of few photos that they give."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import topoloc.demo
from topoloc import Localization, Localizer, TopoMetricMap, TrajectoryError, open_sequence
from topoloc.apps.cli import main
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.trajectory import Trajectory

LAB = Path(topoloc.demo.__file__).with_name("lab")
STEP = 3


def _photos(folder: Path, names: Callable[[int], str]) -> StereoSequence:
    """Write every third left image of a lap as `names(k)`, and return the lap's photos."""
    lap = open_sequence(f"{LAB / 'map_lap1'}@0::{STEP}")
    for k in range(len(lap)):
        path = folder / names(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), cv2.cvtColor(lap[k].image, cv2.COLOR_RGB2BGR))
    camera = lap[0].camera
    assert camera is not None
    (folder / "camera.json").write_text(json.dumps(camera.to_json()))
    return lap


def _row(pose: Rigid3 | None) -> np.ndarray:
    assert pose is not None
    return np.concatenate([pose.translation, np.roll(pose.quat_wxyz(), -1)])


def _named_row(photos: StereoSequence, name: str, k: int) -> str:
    return " ".join([name, *map(str, _row(photos.poses[k]))])


def _localized_cm(path: Path, every: int = 4) -> list[float]:
    day, errors = open_sequence(f"{LAB / 'day'}@0::{every}"), list[float]()
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        for frame in (day[k] for k in range(len(day))):
            result, true = localizer.localize(frame.image, frame.camera), frame.world_from_cam
            assert true is not None
            assert isinstance(result, Localization), result
            off = result.world_from_cam.translation - true.translation
            errors.append(100.0 * float(np.linalg.norm(off)))
    return errors


def test_photos_in_any_order_of_files_with_poses_by_name(tmp_path: Path):
    order = np.random.default_rng(5).permutation(100)
    photos = _photos(tmp_path / "photos", lambda k: f"images/IMG_{order[k]:04}.png")
    rows = [_named_row(photos, f"IMG_{order[k]:04}.png", k) for k in range(len(photos))]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    words = [str(tmp_path / "photos"), str(tmp_path / "lab.topo")]
    assert main(["build", *words, "--trajectory", str(tmp_path / "poses.txt")]) == 0
    assert np.median(_localized_cm(tmp_path / "lab.topo")) < 0.5


def _made(num: int = 6) -> list[Rigid3]:
    rng = np.random.default_rng(2)
    return [Rigid3(exp_so3(rng.normal(0, 0.5, 3)), rng.normal(0, 3, 3)) for _ in range(num)]


@pytest.mark.parametrize("form", ["tum", "benchmark", "matrix"])
def test_rows_with_names(tmp_path: Path, form: str):
    def row(pose: Rigid3) -> np.ndarray:
        if form == "benchmark":  # w x y z of cam_from_world, then its translation
            cam_from_world = pose.inverse()
            return np.concatenate([cam_from_world.quat_wxyz(), cam_from_world.translation])
        return _row(pose) if form == "tum" else pose.matrix()[:3].ravel()

    poses, path = _made(), tmp_path / "poses.txt"
    lines = [f"seq/{k}.jpg {' '.join(map(str, row(pose)))}" for k, pose in enumerate(poses)]
    path.write_text("\n".join(["# name pose", *lines]))
    names = ["3.jpg", "7.jpg", "0.jpg"]
    found = Trajectory.read(path).match_frames([0, 1, 2], path, names)
    assert found[1] is None
    for pose, k in ((found[0], 3), (found[2], 0)):
        assert pose is not None
        np.testing.assert_allclose(pose.matrix(), poses[k].matrix(), atol=1e-9)
    with pytest.raises(TrajectoryError, match=r"names no image of the recording.*'9\.jpg'"):
        Trajectory.read(path).match_frames([0], path, ["9.jpg"])


def test_rows_that_may_be_read_in_two_ways_are_refused(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text("a.jpg 1 0 0 0 0 0 1\nb.jpg 0 1 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match="may both be the quaternion; write"):
        Trajectory.read(path)


def test_a_name_with_two_poses_is_refused(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text("a.jpg 1 2 3 0 0 0 1\na.jpg 4 5 6 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match=r"'a\.jpg' has several poses"):
        Trajectory.read(path)


@pytest.mark.parametrize(("folder", "size"), [("pose", 4), ("poses", 3)])
def test_matrices_in_a_folder_beside_the_images(tmp_path: Path, folder: str, size: int):
    photos = _photos(tmp_path, lambda k: f"color/{k:04}.png")
    (tmp_path / folder).mkdir()
    for k, pose in enumerate(photos.poses):
        matrix = np.full((4, 4), np.inf) if k == 2 or pose is None else pose.matrix()
        rows = 4 if k == 2 else size
        np.savetxt(tmp_path / folder / f"{k:04}.txt", matrix[:rows])
    read = open_sequence(tmp_path)
    assert [k for k, pose in enumerate(read.poses) if pose is None] == [2]
    assert read.poses[5] is not None
    assert photos.poses[5] is not None
    np.testing.assert_allclose(read.poses[5].matrix(), photos.poses[5].matrix(), atol=1e-9)


@pytest.mark.parametrize("first", [0, 40])
def test_numbers_instead_of_times_are_said(tmp_path: Path, first: int):
    photos = _photos(tmp_path, lambda k: f"images/{first + 2 * k:06}.png")
    rows = [
        " ".join([f"{first + 2 * k:.1f}", *map(str, _row(pose))])
        for k, pose in enumerate(photos.poses)
    ]
    (tmp_path / "truth.tum").write_text("\n".join(rows))
    with pytest.warns(UserWarning, match="its times are the numbers of the pictures"):
        read = open_sequence(tmp_path)
    assert all(pose is not None for pose in read.poses)
    for one, other in zip(read.poses, photos.poses, strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-6)


def test_true_times_are_not_taken_as_numbers(tmp_path: Path):
    photos = _photos(tmp_path, lambda k: f"images/{k:06}.png")
    (tmp_path / "times.txt").write_text("\n".join(f"{k}.0" for k in range(len(photos))))
    rows = [" ".join([f"{k + 3}", *map(str, _row(pose))]) for k, pose in enumerate(photos.poses)]
    (tmp_path / "truth.tum").write_text("\n".join(rows))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read = open_sequence(tmp_path)
    assert [pose is None for pose in read.poses[:4]] == [True, True, True, False]


@pytest.mark.parametrize("names", [("Left", "Right"), ("left_images", "right_images")])
def test_other_names_of_stereo_folders(tmp_path: Path, names: tuple[str, str]):
    lap = open_sequence(f"{LAB / 'map_lap1'}@0:3")
    for k in range(3):
        for folder, image in zip(names, (lap[k].image, lap[k].right), strict=True):
            assert image is not None
            (tmp_path / folder).mkdir(exist_ok=True)
            assert cv2.imwrite(str(tmp_path / folder / f"{k}.png"), image)
    camera, rig = lap[0].camera, lap[0].rig
    assert camera is not None
    assert rig is not None
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_json() | {"baseline": rig.baseline}))
    read = open_sequence(tmp_path)
    assert len(read) == 3
    assert read[0].right is not None
