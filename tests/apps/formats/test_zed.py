"""Test side-by-side video with a Stereolabs calibration: halves, resolutions,
rectification and faults."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import assert_slices
from topoloc.apps.formats.zed import RESOLUTIONS, read_conf
from topoloc.errors import CalibrationError, RecordingError
from topoloc.geometry.rig import rectify
from topoloc.geometry.rigid import exp_so3
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import as_monocular
from topoloc.recordings.trajectory import Trajectory

VGA = (672, 376)
LEFT = "fx=350.1\nfy=350.2\ncx=331.0\ncy=189.7\nk1=-0.17\nk2=0.027\np1=0.0004\np2=-0.0003\nk3=0\n"
RIGHT = "fx=349.6\nfy=349.5\ncx=335.3\ncy=189.5\nk1=-0.175\nk2=0.0269\np1=0\np2=0.0002\nk3=0\n"
STEREO = "[STEREO]\nBaseline=119.97\nTY=9\nTY_VGA=0.31\nTZ_VGA=-0.42\nCV_VGA=0.0028\nRX_VGA=0.0032\nRZ_VGA=-0.0003\n"  # noqa: E501
CONF = f"[LEFT_CAM_VGA]\n{LEFT}\n[RIGHT_CAM_VGA]\n{RIGHT}\n[LEFT_CAM_HD]\n{LEFT}\n{STEREO}\n[MISC]\nSensor_ID=1\n"  # noqa: E501


def write_side_by_side(path: Path, pairs: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    """Write a lossless side-by-side video."""
    height, width = pairs[0][0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 15.0, (2 * width, height))
    assert writer.isOpened()
    for left, right in pairs:
        frame = np.hstack([left, right])
        writer.write(
            cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR if frame.ndim == 2 else cv2.COLOR_RGB2BGR)
        )
    writer.release()
    return path


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Return a video of three VGA pairs, with its calibration beside it."""
    rng = np.random.default_rng(5)
    pairs = [
        tuple(np.full((376, 672, 3), int(grey), np.uint8) for grey in rng.integers(0, 256, 2))
        for _ in range(3)
    ]
    (tmp_path / "SN10028.conf").write_text(CONF)
    return write_side_by_side(tmp_path / "walk.avi", pairs)  # pyright: ignore[reportArgumentType]


def test_halves_are_left_and_right(film: Path):
    assert find_format(film) == "zed"
    sequence = open_sequence(film)
    rng = np.random.default_rng(5)
    for index in range(3):
        frame, (left, right) = sequence[index], rng.integers(0, 256, 2)
        assert frame.image.shape == (376, 672, 3)
        assert frame.right is not None
        assert abs(int(frame.image[5, 5, 0]) - left) < 3
        assert abs(int(frame.right[5, 5, 0]) - right) < 3
        assert frame.rig is not None
        assert frame.camera == frame.rig.left
    np.testing.assert_allclose(np.array(sequence.t_ns) / 1e9, np.arange(3) / 15.0, atol=2e-3)
    assert as_monocular(sequence)[1].right is None
    assert_slices(sequence)


def test_a_real_recording_side_by_side(shared: Path, tmp_path: Path):
    """The pairs are rectified, and so is the calibration. Poses lie beside the video,
    with its times."""
    lab = open_sequence(shared / "data/zed_lab/session1@0:60:20")
    frames = [lab[index] for index in range(3)]
    path = write_side_by_side(
        tmp_path / "lab.avi",
        [(frame.image, frame.right) for frame in frames if frame.right is not None],
    )
    camera, rig = frames[0].camera, frames[0].rig
    assert camera is not None
    assert rig is not None
    numbers = f"fx={camera.fx!r}\nfy={camera.fy!r}\ncx={camera.cx!r}\ncy={camera.cy!r}\n"
    conf = f"[LEFT_CAM_VGA]\n{numbers}[RIGHT_CAM_VGA]\n{numbers}[STEREO]\nBaseline={1000 * rig.baseline!r}\n"  # noqa: E501
    (tmp_path / "SN7.conf").write_text(conf)
    t_ns = open_sequence(path).t_ns
    Trajectory([pose for pose in lab.poses if pose is not None], t_ns).write_tum(
        tmp_path / "lab.tum"
    )
    sequence = open_sequence(path)
    for index, frame in enumerate(frames):
        read = sequence[index]
        assert read.rig is not None
        assert read.rig.is_rectified
        assert read.rig.baseline == pytest.approx(rig.baseline)
        assert read.camera is not None
        np.testing.assert_allclose(read.camera.matrix(), camera.matrix())
        np.testing.assert_array_equal(
            read.image if frame.image.ndim == 3 else read.image[..., 0], frame.image
        )
        assert read.world_from_cam is not None
        assert frame.world_from_cam is not None
        np.testing.assert_allclose(
            read.world_from_cam.matrix(), frame.world_from_cam.matrix(), atol=1e-9
        )


def test_rectified_as_stereolabs_do(tmp_path: Path):
    """Stereolabs' samples call stereoRectify with rotation (RX, CV, RZ) and translation
    (Baseline, TY, TZ)."""
    (tmp_path / "SN1.conf").write_text(CONF)
    rig = read_conf(tmp_path / "SN1.conf", VGA)
    rotation, translation = (
        exp_so3(np.array([0.0032, 0.0028, -0.0003])),
        np.array([[119.97], [0.31], [-0.42]]),
    )
    left, right = rig.left, rig.right
    r_left, *_ = cv2.stereoRectify(
        left.matrix(),
        left.distortion(),
        right.matrix(),
        right.distortion(),
        VGA,
        rotation,
        translation,
    )
    np.testing.assert_allclose(rectify(rig).rectified_from_left.rotation, r_left, atol=1e-9)
    assert rig.baseline == pytest.approx(np.linalg.norm(translation) / 1000.0)
    np.testing.assert_allclose(left.distortion()[:4], [-0.17, 0.027, 0.0004, -0.0003])


@pytest.mark.parametrize("size", RESOLUTIONS)
def test_the_section_goes_by_the_size_of_the_picture(size: tuple[int, int], tmp_path: Path):
    path, name = tmp_path / "SN1.conf", RESOLUTIONS[size]
    path.write_text(
        "\n".join(
            f"[{side}_CAM_{name}]\nfx=400\nfy=400\ncx=300\ncy=200" for side in ("LEFT", "RIGHT")
        )
        + "\n[STEREO]\nBaseline=63\n"
    )
    assert read_conf(path, size).left.width == size[0]
    other = next(its for its in RESOLUTIONS if its != size)
    with pytest.raises(
        CalibrationError,
        match=rf"calibration of {RESOLUTIONS[other]} \({other[0]}x{other[1]}\).* only of {name}$",
    ):
        read_conf(path, other)
    with pytest.raises(CalibrationError, match="a ZED has no images of 640x480"):
        read_conf(path, (640, 480))


def test_a_rectified_video_with_a_camera_json(film: Path, tmp_path: Path):
    elsewhere = tmp_path / "half.json"
    elsewhere.write_text(
        '{"width": 672, "height": 376, "fx": 260, "fy": 260, "cx": 336, "cy": 188, "baseline":'
        " 0.12}"
    )
    rig = open_sequence(film, "zed", camera=elsewhere)[0].rig
    assert rig is not None
    assert rig.is_rectified
    elsewhere.write_text(
        '{"width": 640, "height": 376, "fx": 260, "fy": 260, "cx": 336, "cy": 188, "baseline":'
        " 0.12}"
    )
    with pytest.raises(CalibrationError, match=r"of 640x376, but each half is 672x376"):
        open_sequence(film, "zed", camera=elsewhere)


def test_a_calibration_that_is_named(film: Path, tmp_path: Path):
    named = tmp_path / "other" / "factory.conf"
    named.parent.mkdir()
    (tmp_path / "SN10028.conf").rename(named)
    assert find_format(film) == "video"
    assert open_sequence(film, "zed", camera=named)[0].right is not None
    with pytest.raises(CalibrationError, match=r"no SN\*\.conf beside it"):
        open_sequence(film, "zed")
    with pytest.raises(CalibrationError, match="no such calibration"):
        open_sequence(film, "zed", camera=tmp_path / "SN3.conf")


def test_several_calibrations(film: Path, tmp_path: Path, complaint: Callable[..., str]):
    (tmp_path / "sn2.conf").write_text(CONF)
    assert "several calibrations beside it (SN10028.conf, sn2.conf); use --camera" in complaint(
        "slam", film, tmp_path / "o.tum"
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("fx=350.1", "fx=abc", "LEFT_CAM_VGA: fx is 'abc', not a number"),
        ("fx=350.1", "fx=nan", "LEFT_CAM_VGA: fx is 'nan', not a number"),
        ("fx=349.6\n", "", "RIGHT_CAM_VGA: fx is missing"),
        ("fx=350.1", "fx=-1", "LEFT_CAM_VGA: camera needs a positive size and focal length"),
        ("Baseline=119.97", "Baseline=-4", "STEREO baseline of -4 mm"),
        ("Baseline=119.97\n", "", "STEREO: baseline is missing"),
        ("[STEREO]", "[REPEATED]", "STEREO: baseline is missing"),
        ("[LEFT_CAM_VGA]", "no section", "not a calibration of Stereolabs"),
        ("[RIGHT_CAM_VGA]", "[RIGHT_CAM_2K]", "no calibration of VGA"),
    ],
)
def test_calibrations_that_make_no_sense(old: str, new: str, said: str, tmp_path: Path):
    path = tmp_path / "SN1.conf"
    path.write_text(CONF.replace(old, new))
    with pytest.raises(CalibrationError) as failure:
        read_conf(path, VGA)
    assert said in str(failure.value)
    assert "\n" not in str(failure.value)


def test_a_video_of_one_picture_is_not_side_by_side(tmp_path: Path):
    (tmp_path / "SN1.conf").write_text(CONF)
    picture = np.zeros((360, 320), np.uint8)
    path = write_side_by_side(tmp_path / "plain.avi", [(picture, picture)])
    assert find_format(path) == "video"
    with pytest.raises(RecordingError, match="640x360 pixels are not two images side by side"):
        open_sequence(path, "zed")
