"""Test COLMAP models, written by pycolmap, as recordings of single images."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

import topoloc
from tiny_recordings import (
    HEIGHT,
    WIDTH,
    assert_same_pose,
    kitti_row,
    picture,
    pose,
    tum_line,
    write,
)
from topoloc import align_to_trajectory
from topoloc.apps.formats.colmap import open_colmap
from topoloc.errors import (
    CalibrationError,
    MissingExtraError,
    RecordingError,
    TrajectoryError,
    UnreadableImageError,
)
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import sequence_subset
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import has_scale, scale_poses

pycolmap = pytest.importorskip("pycolmap", reason="the extra colmap is not installed")
Make = Callable[..., Path]
METRES = 2.5


def true_pose(index: int) -> Rigid3:
    """Return the true pose of an image along a bend."""
    return Rigid3(
        pose(index).rotation, pose(index).translation + np.array([0.0, 0.0, 0.3 * index**2])
    )


@pytest.fixture
def model(tmp_path: Path) -> Make:
    """Return a function that writes sparse/0 and images/ of three images, in a unit of 2.5 m.
    `changes` alter the camera."""

    def make(
        binary: bool = True,
        names: tuple[str, ...] = ("a1.png", "a2.png", "a10.png"),
        **changes: Any,
    ) -> Path:
        root = tmp_path / "scene"
        found = pycolmap.Reconstruction()
        lens = {
            "model": "OPENCV",
            "width": WIDTH,
            "height": HEIGHT,
            "params": [40.0, 41.0, 16.0, 12.0, 0.1, 0.0, 0.0, 0.0],
        }
        found.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, **(lens | changes)))
        for number, name in reversed(list(enumerate(names))):
            write(root / "images" / f"{Path(name).stem}.png", picture(number))
            true = true_pose(number)
            cam_from_model = Rigid3(true.rotation, true.translation / METRES).inverse()
            image = pycolmap.Image(name=name, camera_id=1, image_id=10 - number)
            found.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_model.matrix()[:3]))
        for k in range(4):
            found.add_point3D(np.array([k, 1.0, 5.0]), pycolmap.Track())
        folder = root / "sparse" / "0"
        folder.mkdir(parents=True)
        (found.write_binary if binary else found.write_text)(folder)
        return root

    return make


def test_the_largest_of_several_models_is_used_and_the_others_are_named(model: Make):
    root = model()
    small = root / "sparse" / "1"
    shutil.copytree(root / "sparse" / "0", small)
    (root / "sparse" / "0").rename(root / "sparse" / "2")
    pycolmap.Reconstruction().write_binary(small)
    notes = list[str]()
    assert len(open_sequence(root, warn=notes.append)) == 3
    assert "model 2 is the largest; not used: 1" in notes[0]
    notes.clear()
    assert len(open_sequence(root / "sparse" / "2", warn=notes.append)) == 3
    assert notes == []


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_pictures_cameras_and_poses(model: Make, binary: bool):
    root = model(binary)
    for path in (root, root / "sparse", root / "sparse" / "0"):
        assert find_format(path) == "colmap"
        sequence = open_sequence(path)
        assert sequence.names == ["a1.png", "a2.png", "a10.png"]
    assert sequence.t_ns == [0, 10**9, 2 * 10**9]
    # COLMAP counts pixels from the corner of the first one, here they count from its centre
    assert sequence[0].camera == Camera(
        "OPENCV", WIDTH, HEIGHT, (40.0, 41.0, 15.5, 11.5, 0.1, 0.0, 0.0, 0.0)
    )
    np.testing.assert_array_equal(sequence[2].image, picture(2))
    for index, found in enumerate(scale_poses(sequence, METRES).poses):
        assert_same_pose(found, true_pose(index))


@pytest.mark.parametrize("orientation", [3, 6])
@pytest.mark.parametrize("is_of_turned", [False, True])
def test_images_are_read_as_stored(model: Make, orientation: int, is_of_turned: bool):
    """COLMAP ignores the EXIF orientation. The image size shows if a model uses rotated images."""
    size = {"width": HEIGHT, "height": WIDTH} if is_of_turned and orientation == 6 else {}
    root, exif = model(**size), PIL.Image.Exif()
    exif[0x0112] = orientation
    PIL.Image.fromarray(picture(0)).save(root / "images" / "a1.png", exif=exif)
    expected = np.rot90(picture(0), -1) if size else picture(0)
    np.testing.assert_array_equal(open_sequence(root)[0].image, expected)


@pytest.mark.parametrize(
    ("name", "coefficients"),
    [
        ("SIMPLE_FISHEYE", []),
        ("FISHEYE", []),
        ("SIMPLE_RADIAL_FISHEYE", [0.03]),
        ("RADIAL_FISHEYE", [0.03, -0.01]),
    ],
)
def test_fisheye_models_project_as_in_colmap(model: Make, name: str, coefficients: list[float]):
    focal = [20.0, 21.0] if name == "FISHEYE" else [20.0]
    params = [*focal, 16.0, 12.0, *coefficients]
    found = open_sequence(model(model=name, params=params)).camera
    theirs = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=params)
    points = np.array([[0.3, -0.2, 1.0], [-1.0, 1.5, 1.0], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(
        found.img_from_cam(points) + 0.5, theirs.img_from_cam(points), atol=1e-9
    )
    turned = found.rescaled(2 * WIDTH, 3 * HEIGHT)
    np.testing.assert_allclose(
        turned.img_from_cam(points) + 0.5, [2, 3] * (found.img_from_cam(points) + 0.5), atol=1e-9
    )


def test_pictures_that_lie_elsewhere(model: Make, tmp_path: Path):
    root = model()
    (root / "images").rename(tmp_path / "photos")
    with pytest.raises(RecordingError, match="use --images FOLDER"):
        open_sequence(root)
    assert open_sequence(root, images=tmp_path / "photos")[0].image.shape == (HEIGHT, WIDTH)
    with pytest.raises(RecordingError, match="takes no images"):
        open_sequence(tmp_path / "photos", images=tmp_path / "photos")
    (tmp_path / "photos" / "a1.png").unlink()
    with pytest.raises(UnreadableImageError, match=r"a1\.png"):
        open_sequence(root, images=tmp_path / "photos")[0]


def test_a_model_has_no_scale_until_it_is_given_one(model: Make):
    sequence = open_sequence(model())
    for unscaled in (sequence, sequence_subset(sequence, [2, 0])):
        assert not has_scale(unscaled)
        with pytest.raises(
            TrajectoryError, match="a model of pictures alone has no scale; give --scale METRES"
        ):
            topoloc.build_map(unscaled)
        assert has_scale(scale_poses(unscaled, 2.0))
    assert has_scale(topoloc.MemorySequence([sequence[0]]))


@pytest.mark.parametrize("kind", ["rows", "times"])
def test_a_trajectory_gives_scale_and_world(model: Make, tmp_path: Path, kind: str):
    names = (
        ("a1.png", "a2.png", "a10.png", "a11.png")
        if kind == "rows"
        else ("12.5.png", "13.25.png", "14.png", "20.000000001.png")
    )
    sequence = open_sequence(model(names=names))
    metric_from_true = Rigid3(pose(5).rotation, np.array([10.0, 20.0, 30.0]))
    theirs = [metric_from_true @ true_pose(index) for index in range(4)]
    # a measured trajectory has positions, but no exact rotations
    measured = [Rigid3(np.eye(3), world_from_cam.translation) for world_from_cam in theirs]
    file = tmp_path / "gnss.txt"
    rows = [
        kitti_row(p) if kind == "rows" else tum_line(Path(name).stem, p)
        for name, p in zip(names, measured, strict=True)
    ]
    file.write_text("\n".join(rows))
    if kind == "times":
        assert sequence.t_ns == [12_500_000_000, 13_250_000_000, 14_000_000_000, 20_000_000_001]
    found = align_to_trajectory(sequence, file)
    assert has_scale(found)
    for ours, true in zip(found.poses, theirs, strict=True):
        assert_same_pose(ours, true, tolerance=1e-6)


def test_trajectories_that_fix_no_scale(model: Make, tmp_path: Path):
    sequence = open_sequence(model())
    file = tmp_path / "gnss.txt"
    file.write_text("\n".join(kitti_row(Rigid3.identity()) for _ in range(3)))
    with pytest.raises(TrajectoryError, match=r"gnss\.txt: 3 poses all in one place"):
        align_to_trajectory(sequence, file)
    file.write_text(tum_line("500.0", pose(0)))
    with pytest.raises(TrajectoryError, match="no frame has a pose"):
        align_to_trajectory(sequence, file)


@pytest.mark.parametrize("name", ["/etc/passwd", "../outside.png", "a/../../b.png"])
def test_names_that_lead_out_of_the_folder(model: Make, name: str):
    with pytest.raises(RecordingError, match="is no picture below this folder"):
        open_sequence(model(names=(name, "b.png")))


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_a_camera_of_another_model_is_fitted(model: Make, binary: bool):
    found = open_sequence(model(binary, model="FOV", params=[20.0, 21.0, 16.0, 12.0, 0.9])).camera
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.0]])
    radii = np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    bent = points[:, :2] * np.arctan(2.0 * radii * np.tan(0.45)) / (0.9 * radii)
    expected = bent * [20.0, 21.0] + [15.5, 11.5]
    np.testing.assert_allclose(found.img_from_cam(points), expected, atol=0.05)


EQUIRECTANGULAR = {"model": "EQUIRECTANGULAR", "params": [float(WIDTH), float(HEIGHT)]}


def test_an_unknown_camera_model_is_refused_if_an_image_uses_it(model: Make):
    with pytest.raises(CalibrationError, match="unknown camera model 'EQUIRECTANGULAR'; undistort"):
        open_sequence(model(**EQUIRECTANGULAR))


def test_an_unknown_camera_model_without_images_is_no_error(model: Make):
    root = model()
    found = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    other = pycolmap.Camera(camera_id=7, width=WIDTH, height=HEIGHT, **EQUIRECTANGULAR)
    found.add_camera_with_trivial_rig(other)
    found.write_binary(root / "sparse" / "0")
    assert len(open_sequence(root)) == 3


@pytest.mark.parametrize("file", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
def test_damaged_models(model: Make, file: str, binary: bool, capfd: pytest.CaptureFixture[str]):
    root = model(binary)
    path = root / "sparse" / "0" / f"{file}.{'bin' if binary else 'txt'}"
    whole = path.read_bytes()
    for data in (b"\xff" * 200, whole[: len(whole) // 2], whole[: len(whole) * 2 // 3], whole[:9]):
        path.write_bytes(data)
        with suppress(
            RecordingError, TrajectoryError
        ):  # a truncated file may be a valid model with fewer entries
            open_colmap(root)
    path.write_bytes(b"\xff" * 200)
    with pytest.raises(RecordingError, match="damaged, or no model of COLMAP"):
        open_colmap(root)
    assert capfd.readouterr().err == ""


def test_without_the_extra(model: Make, monkeypatch: pytest.MonkeyPatch):
    root = model()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingExtraError, match=r"topoloc\[colmap\]"):
        open_sequence(root)
