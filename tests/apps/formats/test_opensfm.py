"""Test reconstruction.json of OpenSfM, written by hand from its documentation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from tiny_recordings import HEIGHT, WIDTH, assert_same_pose, picture, pose, write
from topoloc.errors import CalibrationError, RecordingError, TopolocError, TrajectoryError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import has_scale

LENS = {"projection_type": "perspective", "width": WIDTH, "height": HEIGHT, "focal": 1.25}
LONGER = max(WIDTH, HEIGHT)
Change = Callable[[list[dict[str, Any]]], object]
Make = Callable[..., Path]


def shot(index: int) -> dict[str, Any]:
    """Return the pose of an image as OpenSfM stores it."""
    cam_from_world = pose(index).inverse()
    rotation = cam_from_world.log()[3:]
    translation = cam_from_world.translation
    return {"rotation": [*rotation], "translation": [*translation], "camera": "v2 phone"}


@pytest.fixture
def project(tmp_path: Path) -> Make:
    """Return a function that writes a project of three images. `change` alters its file."""

    def make(change: Change = lambda models: None, inside: str = ".") -> Path:
        folder = tmp_path / "project"
        for index in (10, 2, 1):
            write(folder / "images" / f"{index}.png", picture(index, 3))
        shots = {f"{index}.png": shot(index) for index in (10, 2, 1)}
        models = [{"cameras": {"v2 phone": dict(LENS)}, "shots": shots, "points": {}}]
        change(models)
        (folder / inside).mkdir(exist_ok=True)
        (folder / inside / "reconstruction.json").write_text(json.dumps(models))
        return folder

    return make


@pytest.mark.parametrize("inside", [".", "opensfm"])
def test_images_poses_and_the_camera(project: Make, inside: str):
    folder = project(inside=inside)
    file = folder / inside / "reconstruction.json"
    assert find_format(folder) == find_format(file) == "opensfm"
    for path in (folder, file):
        sequence = open_sequence(path)
        assert sequence.names == ["1.png", "2.png", "10.png"]
        frame = sequence[2]
        assert_same_pose(frame.world_from_cam, pose(10))
        assert frame.image[0, 0, 0] == picture(10, 3)[0, 0, 2]  # RGB
        assert frame.camera == Camera(
            "OPENCV",
            WIDTH,
            HEIGHT,
            (1.25 * LONGER, 1.25 * LONGER, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, 0.0, 0.0, 0.0, 0.0),
        )
        assert not has_scale(sequence)


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (
            {"projection_type": "perspective", "focal": 0.9, "k1": -0.1, "k2": 0.01},
            ("OPENCV", (0.9, 0.9, 0.0, 0.0), (-0.1, 0.01, 0.0, 0.0)),
        ),
        (
            {"projection_type": "radial", "focal_x": 0.9, "focal_y": 0.8, "c_y": 0.02, "k2": 0.01},
            ("OPENCV", (0.9, 0.8, 0.0, 0.02), (0.0, 0.01, 0.0, 0.0)),
        ),
        (
            {
                "projection_type": "brown",
                "focal_x": 0.9,
                "focal_y": 0.8,
                "c_x": 0.01,
                "c_y": -0.02,
                "k1": -0.1,
                "k2": 0.01,
                "p1": 0.001,
                "p2": 0.002,
                "k3": 0.003,
            },
            (
                "FULL_OPENCV",
                (0.9, 0.8, 0.01, -0.02),
                (-0.1, 0.01, 0.001, 0.002, 0.003, 0.0, 0.0, 0.0),
            ),
        ),
        (
            {"projection_type": "fisheye", "focal": 0.5, "k1": -0.02, "k2": 0.01},
            ("OPENCV_FISHEYE", (0.5, 0.5, 0.0, 0.0), (-0.02, 0.01, 0.0, 0.0)),
        ),
        (
            {"projection_type": "fisheye_opencv", "focal_x": 0.5, "focal_y": 0.5, "k4": 0.01},
            ("OPENCV_FISHEYE", (0.5, 0.5, 0.0, 0.0), (0.0, 0.0, 0.0, 0.01)),
        ),
    ],
)
def test_camera_models(project: Make, lens: dict[str, Any], expected: tuple[Any, ...]):
    def change(models: list[dict[str, Any]]) -> None:
        models[0]["cameras"]["v2 phone"] = {"width": WIDTH, "height": HEIGHT} | lens

    model, (fx, fy, cx, cy), distortion = expected
    camera = open_sequence(project(change))[0].camera
    middle = (WIDTH - 1) / 2 + LONGER * cx, (HEIGHT - 1) / 2 + LONGER * cy
    assert camera.model == model
    assert camera.params == pytest.approx((LONGER * fx, LONGER * fy, *middle, *distortion))


def test_an_image_keeps_the_camera_of_its_stored_pixels(project: Make):
    folder = project()
    path = folder / "images" / "2.png"
    stored = PIL.Image.open(path)
    exif = stored.getexif()
    exif[0x0112] = 6  # a phone held upright
    stored.save(path, exif=exif)
    frame = open_sequence(folder)[1]
    assert frame.image.shape[:2] == (HEIGHT, WIDTH)
    assert frame.camera.width == WIDTH


def test_images_of_several_phones(project: Make):
    def change(models: list[dict[str, Any]]) -> None:
        models[0]["cameras"]["other"] = LENS | {"focal": 0.7}
        models[0]["shots"]["2.png"]["camera"] = "other"

    sequence = open_sequence(project(change))
    assert [sequence[k].camera.fx for k in range(3)] == [
        1.25 * LONGER,
        pytest.approx(0.7 * LONGER),
        1.25 * LONGER,
    ]


def test_positions_by_satellites_give_metres(project: Make):
    assert has_scale(
        open_sequence(project(lambda models: models[0]["shots"]["1.png"].update(gps_dop=5.0)))
    )


def test_the_largest_reconstruction_is_read(project: Make):
    def change(models: list[dict[str, Any]]) -> None:
        models.insert(0, {"cameras": {"c": LENS}, "shots": {"2.png": shot(2) | {"camera": "c"}}})

    notes: list[str] = []
    assert len(open_sequence(project(change), warn=notes.append)) == 3
    assert "the largest of 2 reconstructions, 3 pictures" in notes[0]


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda models: models.clear(), RecordingError, "no picture"),
        (lambda models: models[0]["shots"].clear(), RecordingError, "no picture"),
        (lambda models: models[0]["cameras"].clear(), CalibrationError, "no camera 'v2 phone'"),
        (
            lambda models: models[0]["cameras"]["v2 phone"].update(projection_type="spherical"),
            CalibrationError,
            "spherical are not read; there are perspective",
        ),
        (
            lambda models: models[0]["cameras"]["v2 phone"].pop("focal"),
            CalibrationError,
            "neither focal nor focal_x",
        ),
        (
            lambda models: models[0]["cameras"]["v2 phone"].update(focal=-1.0),
            CalibrationError,
            "v2 phone",
        ),
        (
            lambda models: models[0]["shots"]["1.png"].update(rotation=[1e300, 0.0, 1e300]),
            TrajectoryError,
            "1.png",
        ),
        (
            lambda models: models[0]["shots"]["1.png"].update(rotation=[0.0]),
            RecordingError,
            "rotation",
        ),
        (
            lambda models: models[0]["shots"].update({"../../secret.png": shot(1)}),
            RecordingError,
            "below this folder",
        ),
    ],
)
def test_faults_are_named(project: Make, change: Change, error: type[TopolocError], said: str):
    with np.errstate(all="ignore"), pytest.raises(error, match=r"reconstruction\.json") as caught:
        open_sequence(project(change))
    assert said in str(caught.value)


def test_missing_images_are_asked_for(project: Make, tmp_path: Path):
    folder = project()
    (folder / "images").rename(tmp_path / "photos")
    with pytest.raises(RecordingError, match="--images"):
        open_sequence(folder)
    assert open_sequence(folder, images=tmp_path / "photos")[0].image.shape == (HEIGHT, WIDTH, 3)
