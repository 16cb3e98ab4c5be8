from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import CAMERA, assert_same_pose, kitti_row, picture, pose, tum_line, write
from topoloc.errors import CalibrationError, RecordingError, TrajectoryError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import open_sequence

Plain = Callable[..., Path]


def test_pictures_alone_in_natural_order(plain: Plain):
    sequence = open_sequence(plain(""))
    assert sequence.name == "plain"
    assert sequence.names == ["view1.png", "view2.png", "view10.png"]
    assert sequence.t_ns == [0, 100_000_000, 200_000_000]
    frame = sequence[2]
    np.testing.assert_array_equal(frame.image, picture(10))
    assert (frame.camera, frame.right, frame.rig, frame.depth, frame.world_from_cam) == (
        None,
        None,
        None,
        None,
        None,
    )


def test_one_picture(plain: Plain):
    folder = plain("")
    assert [frame.name for frame in open_sequence(folder / "view2.png")] == ["view2.png"]
    assert open_sequence(plain("", baseline=0.1) / "view2.png")[0].camera == Camera.from_json(
        CAMERA
    )


def test_pictures_one_folder_down_with_times_and_truth(plain: Plain):
    folder = plain("images", width=32)
    (folder / "times.txt").write_text("5.5\n6\n7.000000001\n")
    (folder / "poses.txt").write_text("\n".join(kitti_row(pose(index)) for index in range(3)))
    sequence = open_sequence(folder)
    assert sequence.names[2] == "images/view10.png"
    assert sequence.t_ns == [5_500_000_000, 6_000_000_000, 7_000_000_001]
    assert_same_pose(sequence.poses[2], pose(2))
    assert sequence[0].camera == Camera.from_json(CAMERA)
    (folder / "truth.tum").write_text(tum_line("6.0", pose(9)))
    assert [found is None for found in open_sequence(folder).poses] == [True, False, True]


@pytest.mark.parametrize("names", [("left", "right"), ("image_0", "image_1")])
def test_stereo(plain: Plain, names: tuple[str, str]):
    sequence = open_sequence(plain(*names, baseline=0.25))
    assert sequence.names[0] == f"{names[0]}/view1.png"
    frame = sequence[2]
    np.testing.assert_array_equal(frame.right, picture(110))
    assert frame.rig.left == frame.rig.right == frame.camera == Camera.from_json(CAMERA)
    assert frame.rig.baseline == 0.25
    assert frame.rig.is_rectified


@pytest.mark.parametrize("colour", ["rgb", "color"])
def test_rgbd(plain: Plain, colour: str):
    frame = open_sequence(plain(colour, "depth", depth_factor=1000))[1]
    assert frame.name == f"{colour}/view2.png"
    np.testing.assert_allclose(frame.depth.depth, np.full((24, 32), 0.2), rtol=1e-6)
    assert frame.depth.camera == frame.camera
    np.testing.assert_array_equal(frame.depth.cam_from_depth.matrix(), np.eye(4))


@pytest.mark.parametrize(
    ("names", "key"), [(("left", "right"), "baseline"), (("rgb", "depth"), "depth_factor")]
)
def test_required_keys_of_camera_json(plain: Plain, names: tuple[str, str], key: str):
    with pytest.raises(CalibrationError, match=r"camera\.json.*" + key):
        open_sequence(plain(*names))
    with pytest.raises(CalibrationError, match=r"camera\.json.*" + key):
        open_sequence(plain(*names, width=32))
    for value in (0, -1, "wide", float("nan")):
        with pytest.raises(CalibrationError, match=r"camera\.json: " + key):
            open_sequence(plain(*names, **{key: value}))


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"width": 3}', '{"model": "LENS", "width": 3, "height": 3}']
)
def test_bad_camera_json(plain: Plain, text: str):
    folder = plain("")
    (folder / "camera.json").write_text(text)
    with pytest.raises(CalibrationError, match=r"camera\.json"):
        open_sequence(folder)


def test_unequal_counts(plain: Plain):
    folder = plain("left", "right", baseline=0.25)
    for number in (2, 10):
        (folder / "left" / f"view{number}.png").unlink()
    with pytest.raises(RecordingError, match="1 pictures here but 3 in right"):
        open_sequence(folder)


def test_another_size_than_the_camera(plain: Plain):
    folder = plain("", width=64)
    with pytest.raises(
        UnreadableImageError, match=r"view1\.png: 32x24 pixels, but its camera is of 64x24"
    ):
        open_sequence(folder)[0]


def test_depth_of_another_size(plain: Plain):
    folder = plain("rgb", "depth", depth_factor=1000)
    (folder / "depth" / "view2.png").write_bytes((folder / "rgb" / "view1.png").read_bytes())
    sequence = open_sequence(folder)
    assert sequence[0].depth is not None
    with pytest.raises(UnreadableImageError, match=r"depth/view2\.png"):
        sequence[1]


def test_empty_folders_and_truth_of_another_length(plain: Plain, tmp_path: Path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="empty"):
        open_sequence(tmp_path / "empty")
    folder = plain("")
    (folder / "poses.txt").write_text(kitti_row(pose(0)))
    with pytest.raises(TrajectoryError, match="1 poses for 3"):
        open_sequence(folder)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_cameras_of_fewer_bits_in_16(tmp_path: Path, bits: int):
    image = np.linspace(0, 255, 24 * 32).astype(np.uint8).reshape(24, 32)
    full = image.astype(np.uint16) << (bits - 8)
    write(tmp_path / "0.png", full >> 3)
    write(tmp_path / "1.png", full)
    first, second = (open_sequence(tmp_path)[k].image for k in (0, 1))
    assert np.abs(second.astype(int) - image).max() <= 1
    assert np.abs(first.astype(int) - image // 8).max() <= 1  # stays darker


def test_a_broken_picture_does_not_break_the_others(tmp_path: Path):
    write(tmp_path / "0.png", np.full((24, 32), 4000, np.uint16))
    (tmp_path / "1.png").write_bytes(b"no picture")
    assert open_sequence(tmp_path)[0].image[0, 0] == 249
