"""Test folders of kapture, written by hand from its description."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import HEIGHT, WIDTH, assert_same_pose, picture, pose, write
from topoloc.errors import CalibrationError, RecordingError, TopolocError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.open import find_format, open_sequence

CAM_FROM_RIG = Rigid3(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([0.05, 0.0, -0.1]))
SENSORS = f"cam0, , camera, SIMPLE_PINHOLE, {WIDTH}, {HEIGHT}, 40, 16.5, 12.5\nwifi0, , wifi\n"
RECORDS = "10, cam0, seq/b.png\n2, cam0, seq/c.png\n1,cam0,seq/a.png\n"
Make = Callable[..., Path]


def row(transform: Rigid3) -> str:
    return ", ".join(f"{value:.12g}" for value in (*transform.quat_wxyz(), *transform.translation))


TRAJECTORIES = "".join(f"{k:04d}, cam0, {row(pose(k).inverse())}\n" for k in (1, 2, 10))
OF_RIG = "".join(
    f"{k}, rig, {row(CAM_FROM_RIG.inverse() @ pose(k).inverse())}\n" for k in (1, 2, 10)
)


@pytest.fixture
def folder(tmp_path: Path) -> Make:
    """Return a function that writes a folder of three images. `files` replace those of sensors/."""

    def make(**files: str) -> Path:
        for name in ("a", "b", "c"):
            write(tmp_path / "set" / "sensors" / "records_data" / "seq" / f"{name}.png", picture(1))
        texts = {"sensors": SENSORS, "records_camera": RECORDS, "trajectories": TRAJECTORIES}
        for name, text in (texts | files).items():
            path = tmp_path / "set" / "sensors" / f"{name}.txt"
            path.write_text(f"# kapture format: 1.1\n# a, comment\n\n{text}")
        return tmp_path / "set"

    return make


def test_images_poses_and_the_camera(folder: Make):
    path, notes = folder(), list[str]()
    assert find_format(path) == "kapture"
    sequence = open_sequence(path, warn=notes.append)
    assert sequence.names == ["seq/a.png", "seq/c.png", "seq/b.png"]
    assert sequence.t_ns == [10**9, 2 * 10**9, 10 * 10**9]
    for frame, index in zip(sequence, (1, 2, 10), strict=True):
        assert_same_pose(frame.world_from_cam, pose(index), 1e-6)
        assert frame.camera == Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, (40.0, 16.0, 12.0))
    assert [note for note in notes if "taken as metres" in note and "--scale" in note]


def test_poses_of_a_rig(folder: Make):
    rigs = f"rig, cam0, {row(CAM_FROM_RIG)}\nrig, wifi0, 1, 0, 0, 0, 0, 0, 0\n"
    sequence = open_sequence(folder(trajectories=OF_RIG, rigs=rigs))
    for world_from_cam, index in zip(sequence.poses, (1, 2, 10), strict=True):
        assert_same_pose(world_from_cam, pose(index), 1e-6)


def test_a_pose_of_the_camera_goes_before_that_of_its_rig(folder: Make):
    sequence = open_sequence(
        folder(trajectories=TRAJECTORIES + OF_RIG, rigs="rig, cam0, 1, 0, 0, 0, 9, 9, 9\n")
    )
    assert_same_pose(sequence.poses[0], pose(1), 1e-6)


def test_images_of_several_cameras_at_one_time(folder: Make):
    path = folder(
        sensors=SENSORS + f"cam1, , camera, PINHOLE, {WIDTH}, {HEIGHT}, 30, 31, 16, 12\n",
        records_camera="1, cam0, seq/a.png\n1, cam1, seq/b.png\n2, cam0, seq/c.png\n",
        trajectories=TRAJECTORIES + f"1, cam1, {row(pose(5).inverse())}\n",
    )
    sequence = open_sequence(path)
    assert [frame.camera.fx for frame in sequence] == [40.0, 30.0, 40.0]
    assert sequence.t_ns == [0, 10**9, 2 * 10**9]
    assert_same_pose(sequence.poses[1], pose(5), 1e-6)


def test_images_without_a_pose(folder: Make):
    partial = TRAJECTORIES.splitlines()[0] + "\n0002, cam0, , , , , 1, 2, 3\n"
    sequence = open_sequence(folder(trajectories=partial))
    assert [world_from_cam is None for world_from_cam in sequence.poses] == [False, True, True]
    path = folder()
    (path / "sensors" / "trajectories.txt").unlink()
    notes = list[str]()
    assert open_sequence(path, warn=notes.append).poses == [None] * 3
    assert not notes


def test_a_given_calibration_replaces_an_unknown_camera(folder: Make):
    path = folder(sensors=f"cam0, , camera, UNKNOWN_CAMERA, {WIDTH}, {HEIGHT}\n")
    with pytest.raises(CalibrationError, match=r"sensors\.txt, line 4: .* give --camera"):
        open_sequence(path)
    assert open_sequence(path, camera="40,41,16,12")[0].camera.fy == 41.0


@pytest.mark.parametrize(
    ("files", "error", "said"),
    [
        ({"records_camera": ""}, RecordingError, "records_camera.txt: nothing"),
        ({"records_camera": "1, cam0\n"}, RecordingError, "line 4: 2 columns, not 3"),
        ({"records_camera": "one, cam0, seq/a.png"}, RecordingError, "'one' is no time"),
        ({"records_camera": "9" * 5000 + ", cam0, seq/a.png"}, RecordingError, "is no time"),
        ({"records_camera": "1, cam0, ../../a.png"}, RecordingError, "below this folder"),
        ({"records_camera": "1, cam7, seq/a.png"}, CalibrationError, "no camera 'cam7'"),
        ({"sensors": "cam0, , lidar\n"}, CalibrationError, "no calibrated camera"),
        (
            {"sensors": "cam0, , camera, PINHOLE, 32, 24, f, 40, 16, 12"},
            CalibrationError,
            "are numbers",
        ),
        ({"sensors": "cam0, , camera, PINHOLE, 32, 24, 40"}, CalibrationError, "line 4"),
        ({"trajectories": "1, cam0, 1, 0, 0, 0, 0, 0"}, TrajectoryError, "8 columns, not 9"),
        ({"trajectories": "1, cam0, 0, 0, 0, 0, 0, 0, 0"}, TrajectoryError, "line 4"),
        ({"trajectories": "1, cam0, 1, 0, 0, x, 0, 0, 0"}, TrajectoryError, "'x' is not a number"),
        ({"rigs": "rig, cam0, 1, 0, 0, 0, nan, 0, 0"}, TrajectoryError, "rigs.txt, line 4"),
    ],
)
def test_faults_are_named(
    folder: Make, files: dict[str, str], error: type[TopolocError], said: str
):
    with pytest.raises(error, match="sensors") as caught:
        open_sequence(folder(**files))
    assert said in str(caught.value)
    assert len(str(caught.value)) < 400
