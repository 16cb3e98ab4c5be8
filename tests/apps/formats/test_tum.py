from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import assert_same_pose, picture, pose, write
from topoloc.apps.formats.tum import open_tum
from topoloc.errors import CalibrationError, RecordingError, TrajectoryError


def test_frames(tum: Path):
    sequence = open_tum(tum)
    assert sequence.t_ns == [1305031102175304000, 1305031102275326000]
    assert sequence.names == ["rgb/1305031102.175304.png", "rgb/1305031102.275326.png"]
    assert "1 of 3 pictures of rgb.txt have none of depth.txt" in sequence.notes[0]
    frame = sequence[1]
    np.testing.assert_array_equal(frame.image, picture(2, 3, 640, 480)[:, :, ::-1])
    np.testing.assert_array_equal(frame.depth.depth, np.full((480, 640), 3.0, np.float32))
    assert frame.depth.camera == frame.camera
    np.testing.assert_array_equal(frame.depth.cam_from_depth.matrix(), np.eye(4))
    assert_same_pose(sequence[0].world_from_cam, pose(0))
    assert_same_pose(frame.world_from_cam, pose(2))


@pytest.mark.parametrize(
    ("number", "fx", "k3"), [("1", 517.3, 1.1633), ("2", 520.9, 0.9172), ("3", 535.4, 0.0)]
)
def test_the_three_cameras(tum: Path, number: str, fx: float, k3: float):
    camera = open_tum(tum.rename(tum.with_name(f"rgbd_dataset_freiburg{number}_desk"))).camera
    assert camera.fx == fx
    assert camera.distortion()[4] == k3


def test_other_recordings_need_a_camera(tum: Path):
    other = tum.rename(tum.with_name("my_desk"))
    with pytest.raises(CalibrationError, match=r"camera\.json"):
        open_tum(other)
    intrinsics = '{"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 320, "cy": 240'
    (other / "camera.json").write_text(intrinsics + "}")
    with pytest.raises(CalibrationError, match='no "depth_factor" here'):
        open_tum(other)
    (other / "camera.json").write_text(intrinsics + ', "depth_factor": 1000}')
    frame = open_tum(other)[0]
    assert frame.camera.fx == 600
    assert frame.depth.depth[0, 0] == 5.0


def test_names_with_spaces_decimal_commas_and_more_columns(tum: Path):
    name = "colour image 1, #2.png"
    (tum / "rgb" / "1305031102.175304.png").rename(tum / "rgb" / name)
    (tum / "rgb.txt").write_text(
        f"# a list\n1305031102,175304 rgb/{name}\n1305031102,275326 rgb\\1305031102.275326.png 7\n"
    )
    (tum / "groundtruth.txt").write_text("1305031102,175304 1,5 0,5 -2 0,0 0,0 0,0 1\n")
    sequence = open_tum(tum)
    assert sequence.names == [f"rgb/{name}", "rgb/1305031102.275326.png"]
    assert sequence.t_ns == [1305031102175304000, 1305031102275326000]
    np.testing.assert_array_equal(sequence.poses[0].translation, [1.5, 0.5, -2.0])
    assert sequence[0].image.shape == (480, 640, 3)


@pytest.mark.parametrize(
    "name", ["../a.png", "C:\\a.png", "\\\\host\\a.png", "/a.png", "..\\a.png"]
)
def test_names_outside_of_the_folder(tum: Path, name: str):
    (tum / "rgb.txt").write_text(f"1 {name}\n")
    with pytest.raises(RecordingError, match=r"line 1: .* below this folder"):
        open_tum(tum)


def test_coarser_depth(tum: Path):
    for path in (tum / "depth").iterdir():
        write(path, np.full((120, 160), 5000, np.uint16))
    depth = open_tum(tum)[0].depth
    assert depth.camera == open_tum(tum).camera.rescaled(160, 120)
    np.testing.assert_array_equal(depth.depth, np.ones((120, 160), np.float32))


def test_no_truth(tum: Path):
    (tum / "groundtruth.txt").unlink()
    assert open_tum(tum).poses == [None, None]


def test_truth_of_another_day(tum: Path):
    (tum / "groundtruth.txt").write_text("5 0 0 0 0 0 0 1\n")
    with pytest.raises(TrajectoryError, match=r"groundtruth\.txt: no frame"):
        open_tum(tum)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("# none\n", "nothing in"),
        ("1.0\n", "line 1"),
        ("2 a.png\n1 b.png\n", "line 2.*not after"),
        ("1 a.png\n", ""),
    ],
)
def test_bad_lists(tum: Path, text: str, says: str):
    (tum / "depth.txt").write_text(text)
    with pytest.raises(
        RecordingError, match=says or r"3 of 3 pictures of rgb.txt have none of depth.txt \(1\)"
    ):
        open_tum(tum)
