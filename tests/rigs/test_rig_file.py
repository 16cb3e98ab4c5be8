"""Check files of rigs, and panoramas cut into pinholes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from topoloc import CalibrationError, Camera, QueryError, Rig, RigCamera, Rigid3, cut_panorama

CAMERA = {"model": "PINHOLE", "width": 640, "height": 400, "fx": 380, "fy": 380, "cx": 320, "cy": 2}
TO_LEFT = [[0, 0, -1, -0.1], [0, 1, 0, 0], [1, 0, 0, 0]]


def _write(folder: Path, content: Any) -> Path:
    path = folder / "rig.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_mountings_are_read_in_each_form_and_cameras_from_files(tmp_path: Path):
    (tmp_path / "left.json").write_text(json.dumps(CAMERA))
    inverse = Rigid3.from_json(TO_LEFT).inverse()
    cameras = {
        "rows": {"rig_from_cam": TO_LEFT, "camera": CAMERA},
        "quat": {"rig_from_cam": Rigid3.from_json(TO_LEFT).to_json(), "camera": "left.json"},
        "inverse": {"cam_from_rig": inverse.to_json()},
    }
    rig = Rig.read(_write(tmp_path, {"cameras": cameras}))
    for mounted in rig.cameras.values():
        assert np.allclose(mounted.rig_from_cam.matrix()[:3], TO_LEFT)
    assert rig.cameras["rows"].camera == rig.cameras["quat"].camera == Camera.from_json(CAMERA)
    assert rig.cameras["inverse"].camera is None
    again = Rig.read(_write(tmp_path, rig.to_json()))
    assert list(again.cameras) == list(cameras)
    assert again.cameras["rows"].camera == rig.cameras["rows"].camera


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        ("{", "not JSON"),
        ({}, "missing required field `cameras`"),
        ({"cameras": {}}, "a rig needs at least one camera"),
        ({"cameras": {"a": {}}}, "a: a camera has either rig_from_cam or cam_from_rig"),
        ({"cameras": {"a": {"rig_from_cam": [[1, 0], [0, 1]]}}}, "not a pose"),
        (
            {"cameras": {"a": {"rig_from_cam": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]}}},
            "its 3x3 part is no rotation",  # mirrored: of another handedness
        ),
        ({"cameras": {"a": {"rig_from_cam": TO_LEFT, "camera": "no.json"}}}, "no such camera file"),
        ({"cameras": {"a": {"rig_from_cam": TO_LEFT, "camera": {"fx": 1}}}}, "a: "),
        ({"cameras": {"a": {"rig_from_cma": TO_LEFT}}}, "rig_from_cma"),
    ],
)
def test_bad_files_are_one_line_with_their_name(tmp_path: Path, content: Any, fault: str):
    path = _write(tmp_path, content)
    with pytest.raises(CalibrationError) as caught:
        Rig.read(path)
    assert str(path) in str(caught.value)
    assert fault in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(CalibrationError, match="no such rig file"):
        Rig.read(tmp_path / "rig.json")


def test_a_rig_needs_a_camera():
    with pytest.raises(CalibrationError, match="at least one camera"):
        Rig({})
    assert Rig({"a": RigCamera(Rigid3.identity())}).to_json()["cameras"]["a"].keys() == {
        "rig_from_cam"
    }


def test_views_of_a_panorama_show_the_rays_of_their_cameras():
    """Each pixel of the panorama holds its ray (x, y, z of the rig) as a colour."""
    height, width = 256, 512
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    longitude = ((column + 0.5) / width - 0.5) * 2 * np.pi
    latitude = ((row + 0.5) / height - 0.5) * np.pi
    rays = np.stack(
        [
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
            np.cos(latitude) * np.cos(longitude),
        ],
        axis=-1,
    )
    rig, images = cut_panorama(np.round(127.5 + 127.5 * rays).astype(np.uint8))
    assert list(images) == ["ahead", "right", "behind", "left"]
    for name, image in images.items():
        mounted = rig.cameras[name]
        assert mounted.camera is not None
        assert image.shape[:2] == (mounted.camera.height, mounted.camera.width)
        rows, columns = np.indices(image.shape[:2])
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        rays_rig = mounted.camera.rays_from_img(pixels) @ mounted.rig_from_cam.rotation.T
        rays_rig /= np.linalg.norm(rays_rig, axis=1, keepdims=True)
        shown = image.reshape(-1, 3).astype(np.float64) / 127.5 - 1.0
        assert np.abs(shown - rays_rig).max() < 0.03


def test_an_image_of_another_shape_is_no_panorama():
    with pytest.raises(QueryError, match="twice as wide as high, not 640x400"):
        cut_panorama(np.zeros((400, 640), np.uint8))


def test_sigmas_of_mountings_are_kept_and_are_root_mean_squares(tmp_path: Path):
    mounted = RigCamera(Rigid3.identity(), None, 0.03, 0.6)
    again = Rig.read(_write(tmp_path, Rig({"a": mounted, "b": mounted}).to_json())).cameras["b"]
    assert (again.position_sigma_m, again.rotation_sigma_deg) == (0.03, 0.6)
    assert np.sqrt(np.trace(again.covariance[:3, :3])) == pytest.approx(0.03)
    assert np.rad2deg(np.sqrt(np.trace(again.covariance[3:, 3:]))) == pytest.approx(0.6)
    with pytest.raises(CalibrationError, match="position_sigma_m"):
        Rig.read(_write(tmp_path, {"cameras": {"a": {"position_sigma_m": -1}}}))
