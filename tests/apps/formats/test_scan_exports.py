"""Test exports of ScanNet and ARKitScenes, and folders whose images are named by their times, as
the commands read them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import tiny_world
from tiny_recordings import assert_same_pose, assert_slices
from topoloc.apps.cli import main
from topoloc.errors import CalibrationError, RecordingError, TopolocError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import recording_notes

COLOUR = tiny_world.CAMERA
DEPTH = Camera.pinhole(160, 120, 118.0, 117.0, 78.0, 61.0)
LOST = 5
Change = Callable[[Path], object]


def matrix_text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in matrix) + "\n"


def views(camera: Camera, depth_camera: Camera) -> list[tuple[np.ndarray, np.ndarray, Rigid3]]:
    """Return grey images of the room, depth in millimetres from the same places, and the poses."""
    panels, found = tiny_world.room(), []
    for number in range(tiny_world.NUM_FRAMES):
        pose = tiny_world.path_pose(number)
        picture, _ = tiny_world.render(panels, pose, camera, noise_seed=number)
        _, metres = tiny_world.render(panels, pose, depth_camera)
        units = np.nan_to_num(np.rint(1000.0 * metres)).astype(np.uint16)
        found.append((picture, units, pose))
    return found


@pytest.fixture(scope="module")
def scannet_export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write every third frame as SensReader does. The pose of one is lost."""
    root = tmp_path_factory.mktemp("scans") / "scene0000_00"
    for name in ("color", "depth", "pose", "intrinsic"):
        (root / name).mkdir(parents=True)
    for number, (picture, units, pose) in enumerate(views(COLOUR, DEPTH)):
        matrix = pose.matrix() if number != LOST else np.full((4, 4), -np.inf)
        cv2.imwrite(str(root / "color" / f"{3 * number}.jpg"), picture)
        cv2.imwrite(str(root / "depth" / f"{3 * number}.png"), units)
        (root / "pose" / f"{3 * number}.txt").write_text(matrix_text(matrix))
    for name, camera in (("color", COLOUR), ("depth", DEPTH)):
        matrix = np.eye(4)
        matrix[:3, :3] = camera.matrix()
        (root / "intrinsic" / f"intrinsic_{name}.txt").write_text(matrix_text(matrix))
        (root / "intrinsic" / f"extrinsic_{name}.txt").write_text(matrix_text(np.eye(4)))
    return root


@pytest.fixture(scope="module")
def arkit_export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the frames as in the set for 3-D detection: depth of half the size, and a trajectory
    between whose lines the images lie."""
    scan = tmp_path_factory.mktemp("scans") / "47333462"
    root = scan / "47333462_frames"
    for name in ("lowres_wide", "lowres_depth", "lowres_wide_intrinsics"):
        (root / name).mkdir(parents=True)
    lens = " ".join(map(str, (COLOUR.width, COLOUR.height, *COLOUR.params)))
    for number, (picture, units, _) in enumerate(views(COLOUR, COLOUR.rescaled(160, 120))):
        stem = f"47333462_{3517.25 + number / 10:.3f}"
        cv2.imwrite(str(root / "lowres_wide" / f"{stem}.png"), picture)
        cv2.imwrite(str(root / "lowres_depth" / f"{stem}.png"), units)
        (root / "lowres_wide_intrinsics" / f"{stem}.pincam").write_text(lens)
    lines = []
    for number in np.arange(0.0, 12.1, 0.25):
        cam_from_world = tiny_world.path_pose(number).inverse()
        axis_angle = cv2.Rodrigues(cam_from_world.rotation)[0].ravel()
        row = (3517.25 + number / 10, *axis_angle, *cam_from_world.translation)
        lines.append(" ".join(f"{value:.9f}" for value in row))
    (root / "lowres_wide.traj").write_text("\n".join(lines))
    return scan


@pytest.fixture(scope="module")
def timed_folder(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write single images named by their times, as Python prints them, and a truth.tum."""
    root = tmp_path_factory.mktemp("scans") / "walk"
    root.mkdir()
    shutil.copy(tiny_recording / "camera.json", root)
    start, lines = 1305031452.79, []
    for number, line in enumerate((tiny_recording / "truth.tum").read_text().splitlines()):
        seconds = f"{start + number / 10:.2f}".rstrip("0")
        shutil.copy(tiny_recording / "image_0" / f"{number:06d}.png", root / f"{seconds}.png")
        lines.append(" ".join([f"{start + number / 10:.6f}", *line.split()[1:]]))
    (root / "truth.tum").write_text("\n".join(lines))
    return root


@pytest.mark.parametrize("name", ["scannet_export", "arkit_export", "timed_folder"])
def test_a_map_of_some_frames_localizes_others(
    request: pytest.FixtureRequest, name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    path = request.getfixturevalue(name)
    assert main(["build", f"{path}@0::2", str(tmp_path / "room.topo"), "--features", "surf"]) == 0
    assert "warning" not in capfd.readouterr().err
    poses = tmp_path / "found.tum"
    queries = f"{path}@1:11:2"
    assert main(["localize", str(tmp_path / "room.topo"), queries, "--tum", str(poses)]) == 0
    found = np.loadtxt(poses)
    assert len(found) == 5
    for row, number in zip(found, range(1, 11, 2), strict=True):
        w_last = np.array([row[7], *row[4:7]])
        off = Rigid3.from_quat_wxyz(w_last, row[1:4]).inverse() @ tiny_world.path_pose(number)
        assert np.linalg.norm(off.translation) < 0.02
        assert np.linalg.norm(off.log()[:3]) < 0.01


def test_frames_of_scannet(scannet_export: Path):
    assert find_format(scannet_export) == "scannet"
    sequence = open_sequence(scannet_export)
    assert sequence.names[:2] == ["color/0.jpg", "color/3.jpg"]
    assert sequence.t_ns[:2] == [0, 100_000_000]
    assert [pose is None for pose in sequence.poses] == [number == LOST for number in range(14)]
    assert_same_pose(sequence.poses[2], tiny_world.path_pose(2), 1e-6)
    frame = sequence[2]
    assert frame.camera == COLOUR
    assert frame.depth is not None
    assert frame.depth.camera == DEPTH
    assert_slices(sequence)
    assert recording_notes(sequence) == []
    other = Camera.pinhole(320, 240, 250.0, 250.0, 159.5, 119.5)
    (camera := scannet_export.parent / "camera.json").write_text(json.dumps(other.to_json()))
    assert open_sequence(scannet_export, camera=camera)[0].camera == other


def test_frames_of_arkitscenes(arkit_export: Path):
    assert find_format(arkit_export) == "arkitscenes"
    assert find_format(arkit_export / "47333462_frames") == "arkitscenes"
    sequence = open_sequence(arkit_export)
    assert sequence.t_ns[:2] == [3517_250_000_000, 3517_350_000_000]
    assert sequence.names[0] == "lowres_wide/47333462_3517.250.png"
    assert [pose is None for pose in sequence.poses] == [False] * 13 + [True]
    assert_same_pose(sequence.poses[3], tiny_world.path_pose(3), 1e-6)
    frame = sequence[3]
    assert frame.camera == COLOUR
    assert frame.depth is not None
    assert frame.depth.camera == COLOUR.rescaled(160, 120)


def rewrite(name: str, text: str) -> Change:
    return lambda root: (root / name).write_text(text)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (rewrite("pose/0.txt", "1 0 0"), TrajectoryError, r"0\.txt: not a matrix of 4x4"),
        (
            rewrite("intrinsic/intrinsic_color.txt", "1170 0 647 0 0 1170 483 0 0 0 1 0 0 0 0 1"),
            CalibrationError,
            r"intrinsic_color\.txt: .* picture of about 1295x967 .*; this one has 320x240",
        ),
        (
            lambda root: (root / "intrinsic" / "intrinsic_depth.txt").unlink(),
            CalibrationError,
            r"intrinsic_depth\.txt: missing",
        ),
    ],
)
def test_malformed_exports_of_scannet(
    scannet_export: Path, tmp_path: Path, change: Change, error: type[TopolocError], says: str
):
    root = Path(shutil.copytree(scannet_export, tmp_path / "scan"))
    change(root)
    with pytest.raises(error, match=says) as caught:
        open_sequence(root)
    assert "\n" not in str(caught.value)


def test_a_moved_depth_camera_of_scannet_is_named(scannet_export: Path, tmp_path: Path):
    root = Path(shutil.copytree(scannet_export, tmp_path / "scan"))
    moved = np.eye(4)
    moved[0, 3] = 0.04
    (root / "intrinsic" / "extrinsic_color.txt").write_text(matrix_text(moved))
    notes = list[str]()
    open_sequence(root, warn=notes.append)
    assert len(notes) == 1
    assert "extrinsic_color.txt: no identity; it is not used" in notes[0]


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (rewrite("lowres_wide.traj", "3517.2 0 0 0 0 0"), TrajectoryError, "line 1: a line has"),
        (rewrite("lowres_wide.traj", "99.2 0 0 0 0 0 0"), TrajectoryError, "no frame has a pose"),
        (
            rewrite("lowres_wide_intrinsics/47333462_3517.250.pincam", "320 240 260"),
            CalibrationError,
            r"3517\.250\.pincam: not width, height, fx",
        ),
        (
            lambda root: shutil.rmtree(root / "lowres_wide_intrinsics"),
            RecordingError,
            "lowres_wide_intrinsics: No such file",
        ),
    ],
)
def test_malformed_exports_of_arkitscenes(
    arkit_export: Path, tmp_path: Path, change: Change, error: type[TopolocError], says: str
):
    root = Path(shutil.copytree(arkit_export, tmp_path / "scan"))
    change(root / "47333462_frames")
    with pytest.raises(error, match=says) as caught:
        open_sequence(root)
    assert "\n" not in str(caught.value)


def test_an_image_without_depth_is_left_out(arkit_export: Path, tmp_path: Path):
    root = Path(shutil.copytree(arkit_export, tmp_path / "scan"))
    (root / "47333462_frames" / "lowres_depth" / "47333462_3517.450.png").unlink()
    notes = list[str]()
    sequence = open_sequence(root, warn=notes.append)
    assert len(sequence) == 13
    assert_same_pose(sequence.poses[2], tiny_world.path_pose(3), 1e-6)
    assert "1 of 14 pictures of lowres_wide have none of lowres_depth" in notes[0]


@pytest.mark.parametrize(
    ("names", "t_ns"),
    [
        (("9.50", "10.25", "10.75"), [9_500_000_000, 10_250_000_000, 10_750_000_000]),
        (
            ("1305031452.5", "1305031452.75", "1305031453"),
            [1305031452_500_000_000, 1305031452_750_000_000, 1305031453_000_000_000],
        ),
        (
            ("1403636579763555584", "1403636579813555456", "1403636579863555584"),
            [1403636579763555584, 1403636579813555456, 1403636579863555584],
        ),
        (("000007", "000008", "000009"), [0, 100_000_000, 200_000_000]),
        (("1.9", "1.10", "1.11"), [0, 100_000_000, 200_000_000]),
        (("20240115120000", "20240115120001", "20240115120002"), [0, 100_000_000, 200_000_000]),
    ],
)
def test_names_that_are_times(tmp_path: Path, names: tuple[str, ...], t_ns: list[int]):
    for name in names:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((8, 8), np.uint8))
    sequence = open_sequence(tmp_path)
    assert sequence.names == [f"{name}.png" for name in names]
    assert sequence.t_ns == t_ns


def test_names_that_do_not_fit_the_truth_are_no_times(timed_folder: Path, tmp_path: Path):
    root = Path(shutil.copytree(timed_folder, tmp_path / "walk"))
    lines = (root / "truth.tum").read_text().splitlines()
    moved = [" ".join([f"{k / 10}", *line.split()[1:]]) for k, line in enumerate(lines)]
    (root / "truth.tum").write_text("\n".join(moved))
    sequence = open_sequence(root)
    assert sequence.t_ns[1] == 100_000_000
    assert_same_pose(sequence.poses[3], tiny_world.path_pose(3), 1e-6)
    (root / "truth.tum").write_text("50.0 0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match=r"the frames 1305031452\.790 to"):
        open_sequence(root)
