"""Test transforms.json as Nerfstudio documents it: files as its converters and Polycam write them,
and hostile files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiny_recordings import HEIGHT, WIDTH, assert_same_pose, picture, pose, write
from topoloc.errors import CalibrationError, RecordingError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import find_format, open_sequence

# The columns of Nerfstudio's matrix are right, up and back. Ours are right, down and forward.
GL = np.diag([1.0, -1.0, -1.0, 1.0])
LENS: dict[str, Any] = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 41.0, "cx": 16.0, "cy": 12.0}
Make = Callable[..., Path]


@pytest.fixture
def capture(tmp_path: Path) -> Make:
    """Return a function that writes a folder of three frames. `change` may alter its
    transforms.json."""

    def make(
        change: Callable[[dict[str, Any]], None] | None = None, depth_scale: float | None = 0.001
    ) -> Path:
        folder = tmp_path / "capture"
        frames = []
        for index in (10, 2, 1):  # as converters list them: in no order that means anything
            write(folder / "images" / f"frame_{index}.png", picture(index, 3))
            frame = {
                "file_path": f"./images/frame_{index}.png",
                "transform_matrix": (pose(index).matrix() @ GL).tolist(),
            }
            if depth_scale is not None:
                units = np.full((HEIGHT // 2, WIDTH // 2), 1000 * index, np.uint16)
                units[0, 0] = 0
                write(folder / "depth" / f"frame_{index}.png", units)
                frame["depth_file_path"] = f"./depth/frame_{index}.png"
            frames.append(frame)
        data = {
            "camera_model": "OPENCV",
            **LENS,
            "k1": 0.1,
            "k2": -0.02,
            "p1": 0.001,
            "p2": 0.0,
            "frames": frames,
        }
        if change is not None:
            change(data)
        (folder / "transforms.json").write_text(json.dumps(data))
        return folder

    return make


def test_depth_of_nerfcapture(capture: Make):
    def change(data: dict[str, Any]) -> None:
        data["integer_depth_scale"] = 0.002
        for frame in data["frames"]:
            frame["depth_path"] = frame.pop("depth_file_path")

    frame = open_sequence(capture(change))[2]
    assert frame.name == "images/frame_10.png"
    assert frame.depth.depth[6, 6] == pytest.approx(20.0)


def test_axes_camera_order_and_depth(capture: Make):
    folder = capture()
    assert find_format(folder) == find_format(folder / "transforms.json") == "nerfstudio"
    sequence = open_sequence(folder)
    assert sequence.names == ["images/frame_1.png", "images/frame_2.png", "images/frame_10.png"]
    assert sequence.t_ns == [0, 100_000_000, 200_000_000]
    for found, index in zip(sequence.poses, (1, 2, 10), strict=True):
        assert_same_pose(found, pose(index))
    frame = sequence[2]
    # nerfstudio counts pixels as COLMAP does, from the corner of the first one; here they count
    # from its centre
    assert frame.camera == Camera(
        "OPENCV", WIDTH, HEIGHT, (40.0, 41.0, 15.5, 11.5, 0.1, -0.02, 0.001, 0.0)
    )
    assert frame.depth is not None
    assert frame.depth.camera == frame.camera.rescaled(WIDTH // 2, HEIGHT // 2)
    assert np.isnan(frame.depth.depth[0, 0])
    np.testing.assert_allclose(frame.depth.depth[1:], 10.0, rtol=1e-6)


def test_a_point_in_front_of_the_camera_agrees_with_the_matrix(capture: Make):
    folder = capture(
        lambda data: data["frames"].__setitem__(
            0, data["frames"][0] | {"transform_matrix": np.eye(4).tolist()}
        )
    )
    world_from_cam = open_sequence(folder).poses[2]
    assert world_from_cam is not None
    # OpenGL's camera in the origin looks along -z of the world, with y up
    np.testing.assert_allclose(
        world_from_cam.apply(np.array([[0.0, 0.0, 2.0], [0.0, 1.0, 0.0]])),
        [[0, 0, -2], [0, -1, 0]],
        atol=1e-12,
    )


def test_the_unit_of_depth_and_an_applied_scale(capture: Make):
    folder = capture(lambda data: data.update(depth_unit_scale_factor=0.0005, applied_scale=2.0))
    sequence = open_sequence(folder)
    depth = sequence[0].depth
    assert depth is not None
    np.testing.assert_allclose(depth.depth[5:, 5:], 0.5, rtol=1e-6)
    found = sequence.poses[0]
    assert found is not None
    np.testing.assert_allclose(found.translation, pose(1).translation / 2.0, atol=1e-12)


def test_cameras_of_each_frame_as_polycam_has_them(capture: Make):
    def per_frame(data: dict[str, Any]) -> None:
        for key in (*LENS, "k1", "k2", "p1", "p2"):
            data.pop(key)
        data["camera_model"] = "perspective"
        for number, frame in enumerate(data["frames"]):
            frame |= LENS | {"fl_x": 40.0 + number}

    sequence = open_sequence(capture(per_frame, depth_scale=None))
    cameras = [sequence[index].camera for index in range(3)]
    assert [camera and (camera.model, camera.fx) for camera in cameras] == [
        ("PINHOLE", 42.0),
        ("PINHOLE", 41.0),
        ("PINHOLE", 40.0),
    ]
    assert sequence[0].depth is None


def test_depth_of_numpy(capture: Make):
    folder = capture(
        lambda data: [
            frame.update(depth_file_path=f"depth/{k}.npy") for k, frame in enumerate(data["frames"])
        ]
    )
    for k in range(3):
        np.save(folder / "depth" / f"{k}.npy", np.full((HEIGHT, WIDTH, 1), 1500.0, np.float32))
    depth = open_sequence(folder)[0].depth
    assert depth is not None
    np.testing.assert_allclose(depth.depth, 1.5, rtol=1e-6)


def test_fisheye(capture: Make):
    camera = open_sequence(
        capture(lambda data: data.update(camera_model="OPENCV_FISHEYE", k3=0.01))
    )[0].camera
    assert camera == Camera(
        "OPENCV_FISHEYE", WIDTH, HEIGHT, (40.0, 41.0, 15.5, 11.5, 0.1, -0.02, 0.01, 0.0)
    )


@pytest.mark.parametrize(
    ("angles", "focal"),
    [
        ({"camera_angle_x": 0.8}, (37.844, 37.844)),
        ({"camera_angle_y": 0.6}, (38.793, 38.793)),
        ({"camera_angle_x": 0.8, "camera_angle_y": 0.6, "w": WIDTH, "h": HEIGHT}, (37.844, 38.793)),
    ],
)
@pytest.mark.parametrize("is_per_frame", [False, True])
def test_viewing_angles_of_blender(
    capture: Make, angles: dict[str, Any], focal: tuple[float, float], is_per_frame: bool
):
    """The file lies among others of its scene, and names images without a suffix."""

    def change(data: dict[str, Any]) -> None:
        frames = [
            {
                "file_path": frame["file_path"].removesuffix(".png"),
                "transform_matrix": frame["transform_matrix"],
                **(angles if is_per_frame else {}),
            }
            for frame in data["frames"]
        ]
        data.clear()
        data |= {"frames": frames} | ({} if is_per_frame else angles)

    folder = capture(change, depth_scale=None)
    (folder / "images" / "frame_2.png").rename(folder / "images" / "frame_2.jpg")
    (folder / "transforms.json").rename(folder / "transforms_train.json")
    sequence = open_sequence(folder)
    camera = sequence[0].camera
    assert camera is not None
    assert camera.params == pytest.approx((*focal, 15.5, 11.5), abs=1e-3)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert sequence[1].name == "images/frame_2.jpg"
    assert len(open_sequence(folder / "transforms_train.json")) == 3


@pytest.mark.parametrize(
    "base", ["./data/capture/images", "/home/me/scan/images", "C:\\scans\\images", "../../images"]
)
def test_images_beside_the_file_whatever_its_base_was(capture: Make, base: str):
    def change(data: dict[str, Any]) -> None:
        for frame in data["frames"]:
            frame["file_path"] = f"{base}/{frame['file_path'].rpartition('/')[2]}"

    said = list[str]()
    sequence = open_sequence(capture(change, depth_scale=None), warn=said.append)
    assert sequence.names == ["images/frame_1.png", "images/frame_2.png", "images/frame_10.png"]
    assert_same_pose(sequence[2].world_from_cam, pose(10))
    assert len(said) == 1
    assert "transforms.json: 3 images are elsewhere: images/frame_1.png, not" in said[0]


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_names_that_a_mac_has_decomposed(capture: Make, suffix: str):
    def change(data: dict[str, Any]) -> None:
        for number, frame in enumerate(data["frames"]):
            frame["file_path"] = f"./images/K\u00fcche_{number}{suffix}"

    folder = capture(change, depth_scale=None)
    for number, file in enumerate(sorted((folder / "images").iterdir())):
        file.rename(folder / "images" / f"Ku\u0308che_{number}.png")
    sequence = open_sequence(folder, whole_only=True)
    assert sequence[2].name == "images/K\u00fcche_2.png"


def test_a_given_camera_replaces_that_of_the_file(capture: Make):
    for keys in (("fl_x",), tuple(LENS)):
        folder = capture(lambda data, keys=keys: [data.pop(key) for key in keys])
        with pytest.raises(CalibrationError, match="neither fl_x nor camera_angle_x"):
            open_sequence(folder)
        frame = open_sequence(folder, camera="30,31,15.5,11.5")[0]
        assert frame.camera == Camera("PINHOLE", WIDTH, HEIGHT, (30.0, 31.0, 15.5, 11.5))
        assert frame.depth is not None


def _matrix(value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data["frames"][1].update(transform_matrix=value)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        (
            lambda data: data.update(frames=[]),
            RecordingError,
            "frames: Expected `array` of length >= 1",
        ),
        (
            lambda data: data.update(frames=[1]),
            RecordingError,
            r"frames\[0\]: Expected `object`, got `int`",
        ),
        (
            lambda data: data.update(camera_model="EQUIRECTANGULAR"),
            CalibrationError,
            "camera_model: Invalid enum value 'EQUIRECTANGULAR'",
        ),
        (lambda data: data.pop("cx"), CalibrationError, "missing required field `cx`"),
        (
            lambda data: [data.pop("fl_x"), data.update(camera_angle_x=40.0)],
            CalibrationError,
            "camera_angle_x: Expected `float` < 3.14",
        ),
        (
            lambda data: data.update(fl_x="wide"),
            CalibrationError,
            "fl_x: Expected `float`, got `str`",
        ),
        (
            lambda data: data.update(fl_x=float("inf")),
            CalibrationError,
            "fl_x: a finite number is expected",
        ),
        (
            lambda data: data.update(fl_x=10**400),
            CalibrationError,
            "fl_x: Number out of range",
        ),
        (lambda data: data.update(k4=0.1), CalibrationError, "fourth radial coefficient"),
        (
            lambda data: data.update(applied_scale=0),
            RecordingError,
            "applied_scale: Expected `float` > ",
        ),
        (
            lambda data: data.update(depth_unit_scale_factor=-1),
            RecordingError,
            "depth_unit_scale_factor: Expected `float` > ",
        ),
        (
            lambda data: data["frames"][1].pop("depth_file_path"),
            RecordingError,
            "only 2 of 3 frames have a depth_file_path",
        ),
        (
            lambda data: data["frames"][1].pop("transform_matrix"),
            RecordingError,
            "frame 1: Object missing required field `transform_matrix`",
        ),
        (
            _matrix([[float("nan")] * 4] * 4),
            RecordingError,
            "transform_matrix: not a pose: NaN or infinite entries",
        ),
        (_matrix([[1, 2], [3]]), RecordingError, "not a 3x4 or 4x4 matrix of numbers"),
        (_matrix("eye"), RecordingError, "transform_matrix: Expected `Rigid3`, got `str`"),
        (_matrix((2 * np.eye(4)).tolist()), RecordingError, "its last row is not 0 0 0 1"),
        (_matrix(np.diag([2, 2, 2, 1]).tolist()), RecordingError, "no rotation"),
        (_matrix((pose(1).matrix().T).tolist()), RecordingError, "is it transposed"),
        (
            lambda data: data["frames"][1].update(file_path="/etc/passwd"),
            RecordingError,
            "'/etc/passwd' is no picture below this folder",
        ),
        (
            lambda data: data["frames"][1].update(file_path="../other.png"),
            RecordingError,
            "is no picture below this folder",
        ),
        (
            lambda data: data["frames"][1].update(depth_file_path="a\0b"),
            RecordingError,
            "depth_file_path: .* is no picture below",
        ),
        (
            lambda data: data["frames"][1].update(file_path=7),
            RecordingError,
            "frame 1: file_path: Expected `str`, got `int`",
        ),
    ],
)
def test_invalid_files_are_refused(
    capture: Make, change: Callable[[dict[str, Any]], None], error: type[TopolocError], says: str
):
    with pytest.raises(error, match=says) as raised:
        open_sequence(capture(change))
    assert "transforms.json" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"frames": ' + "[" * 100_000, "{", '{"w": ' + "9" * 5000 + "}", "[]", "\0"],
)
def test_files_that_are_no_json(tmp_path: Path, text: str):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(RecordingError, match=r"transforms\.json"):
        open_sequence(tmp_path)


def test_an_image_with_an_impossible_name_is_missing(capture: Make):
    folder = capture(
        lambda data: data["frames"][1].update(file_path="images/" + "9" * 5000), depth_scale=None
    )
    sequence = open_sequence(folder)
    with pytest.raises(TopolocError, match="999"):
        sequence[next(k for k, name in enumerate(sequence.names) if "999" in name)]


def test_missing_pictures_and_depth_of_another_shape(capture: Make):
    folder = capture()
    (folder / "images" / "frame_1.png").unlink()
    write(folder / "depth" / "frame_2.png", np.full((HEIGHT, WIDTH // 2), 1000, np.uint16))
    sequence = open_sequence(folder)
    with pytest.raises(RecordingError, match=r"frame_1\.png"):
        sequence[0]
    with pytest.raises(RecordingError, match=r"frame_2\.png: depth of 16x24 .*; crop the one"):
        sequence[1]


def test_a_unit_of_depth_that_no_camera_has(capture: Make):
    with pytest.raises(
        RecordingError,
        match=r"a median depth of 1000 m is that of no camera; 1000 times the depth_factor",
    ):
        open_sequence(capture(lambda data: data.update(depth_unit_scale_factor=1.0)))[0]
