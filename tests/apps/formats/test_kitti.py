from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import CALIB, assert_same_pose, kitti_row, picture, pose, tum_line, write
from topoloc.apps.formats.kitti import open_kitti
from topoloc.errors import CalibrationError, RecordingError, TrajectoryError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence


def test_frames(kitti: Path):
    sequence = open_kitti(kitti)
    assert sequence.name == "07"
    assert sequence.names == [f"image_0/{index:06d}.png" for index in range(3)]
    assert sequence.t_ns == [0, 100_000_000, 200_000_000]
    frame = sequence[1]
    np.testing.assert_array_equal(frame.image, picture(1))
    np.testing.assert_array_equal(frame.right, picture(101))
    assert frame.camera == Camera.pinhole(32, 24, 50.0, 50.0, 16.0, 12.0)
    assert frame.rig.baseline == pytest.approx(0.2)
    assert frame.rig.is_rectified
    for index in range(3):
        assert_same_pose(sequence[index].world_from_cam, pose(index))
    with pytest.raises(IndexError):
        sequence[3]


def test_colour_pair_without_a_grey_one(kitti: Path):
    for old, new in (("image_0", "image_2"), ("image_1", "image_3")):
        (kitti / old).rename(kitti / new)
    frame = open_kitti(kitti)[0]
    assert frame.name == "image_2/000000.png"
    assert frame.camera == Camera.pinhole(32, 24, 60.0, 60.0, 15.0, 11.0)
    # P2 and P3 are K [I | t] with t_x = 3 / 60 and -27 / 60.
    assert frame.rig.baseline == pytest.approx(0.5)
    assert frame.rig.is_rectified
    # The rows are the poses of camera 0, and t is the translation of cam2_from_cam0.
    cam2_from_cam0 = Rigid3(np.eye(3), np.array([0.05, 0.0, 0.0]))
    assert_same_pose(frame.world_from_cam @ cam2_from_cam0, pose(0))


def test_truth_in_the_folder_goes_first(kitti: Path):
    (kitti / "poses.txt").write_text("\n".join(kitti_row(pose(10 + index)) for index in range(3)))
    assert_same_pose(open_kitti(kitti).poses[2], pose(12))
    (kitti / "truth.tum").write_text(f"{tum_line('0.1', pose(20))}\n{tum_line('0.2', pose(21))}\n")
    sequence = open_kitti(kitti)
    assert sequence.poses[0] is None
    assert_same_pose(sequence.poses[1], pose(20))


def test_no_truth_no_times(kitti: Path):
    (kitti / "times.txt").unlink()
    (kitti.parents[1] / "poses" / "07.txt").unlink()
    sequence = open_kitti(kitti)
    assert sequence.poses == [None] * 3
    assert sequence.t_ns == [0, 100_000_000, 200_000_000]


def test_left_pictures_alone(kitti: Path):
    for path in (kitti / "image_1").iterdir():
        path.unlink()
    (kitti / "image_1").rmdir()
    frame = open_sequence(kitti)[0]
    assert frame.right is None
    assert frame.rig is None
    assert frame.camera is not None


def test_most_pictures_without_a_partner(kitti: Path):
    for number in (1, 2):
        (kitti / "image_1" / f"00000{number}.png").unlink()
    with pytest.raises(RecordingError, match=r"3 pictures here but 1 in image_1"):
        open_kitti(kitti)


def test_partners_of_other_numbers(kitti: Path):
    (kitti / "image_1" / "000002.png").rename(kitti / "image_1" / "000003.png")
    right = open_kitti(kitti).right
    assert right is not None
    assert [path.name for path in right.paths] == ["000000.png", "000001.png", "000002.png"]


def test_no_pictures(kitti: Path):
    for path in (kitti / "image_0").iterdir():
        path.unlink()
    with pytest.raises(RecordingError, match="image_0: no pictures"):
        open_kitti(kitti)


def test_no_calibration(kitti: Path):
    (kitti / "calib.txt").unlink()
    with pytest.raises(CalibrationError, match=r"calib\.txt.*camera\.json"):
        open_sequence(kitti)


@pytest.mark.parametrize(
    ("calib", "says"),
    [
        ("P0: 1 2 3", "line 1.*12 numbers"),
        (CALIB.replace("P0: 50", "P0: x"), "line 1.*12 numbers"),
        (CALIB.replace("P1: 50", "P1: nan"), "line 2.*projection"),
        (CALIB.replace("P0: 50", "P0: 0"), "line 1.*projection"),
        (CALIB.replace("P1", "Q1"), "no line P1"),
        (CALIB.replace("-10", "10"), "left of the left"),
        (CALIB.replace("-10", "0"), "left of the left"),
    ],
)
def test_bad_calibrations(kitti: Path, calib: str, says: str):
    (kitti / "calib.txt").write_text(calib)
    with pytest.raises(CalibrationError, match=r"calib\.txt.*" + says):
        open_kitti(kitti)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        ("0\n0.1\n", "2 times for 3"),
        ("0\n0.2\n0.1\n", "line 3.*not after"),
        ("0\nx\n1\n", "line 2.*not a time"),
    ],
)
def test_bad_times(kitti: Path, times: str, says: str):
    (kitti / "times.txt").write_text(times)
    with pytest.raises(RecordingError, match=r"times\.txt.*" + says):
        open_kitti(kitti)


@pytest.mark.parametrize("name", ["times.txt", "calib.txt"])
def test_binary_files_are_refused(kitti: Path, name: str):
    (kitti / name).write_bytes(b"\xff\xfe\x00\x81" * 9)
    with pytest.raises(RecordingError, match=name):
        open_kitti(kitti)


def test_truth_of_another_length(kitti: Path):
    (kitti / "poses.txt").write_text(kitti_row(pose(0)))
    with pytest.raises(TrajectoryError, match=r"poses\.txt: 1 poses for 3"):
        open_kitti(kitti)


@pytest.mark.parametrize("folder", ["image_0", "image_1"])
def test_a_picture_of_another_size(kitti: Path, folder: str):
    write(kitti / folder / "000001.png", picture(0, 1, 16, 16))
    with pytest.raises(UnreadableImageError, match=folder + r"/000001\.png: 16x16"):
        open_kitti(kitti)[1]


def test_streets(shared: Path):
    for name, focal in (("street1", 707.0912), ("street2", 718.856)):
        sequence = open_sequence(shared / "data" / "kitti" / "sequences" / name)
        frame = sequence[50]
        assert len(sequence) == 51
        assert frame.camera.fx == focal
        assert frame.rig.baseline == pytest.approx(0.5371, abs=1e-4)
        assert frame.rig.is_rectified
        assert frame.image.ndim == frame.right.ndim == 2
        path = np.array([found.translation for found in sequence.poses])
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(
            {"street1": 60, "street2": 52}[name], abs=1.5
        )
        # Forward in the camera frame is z.
        assert (sequence.poses[0].inverse() @ sequence.poses[1]).translation[2] > 0.5


def test_zed_sessions(shared: Path):
    for name, count in (("session1", 88), ("session2", 105)):
        sequence = open_sequence(shared / "data" / "zed_lab" / name)
        frame = sequence[3]
        assert len(sequence) == count
        assert frame.image.shape == frame.right.shape == (376, 672, 3)
        assert frame.rig.baseline == pytest.approx(0.12, abs=1e-4)
        assert all(found is not None for found in sequence.poses)
    assert sequence.t_ns[0] == 1687709760547307000
