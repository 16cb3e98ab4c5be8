"""What training on wide pairs is rendered: views ahead and to both sides, with depth and poses."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc.geometry.camera import Camera
from topoloc_training.net.stored_depth import read_depth
from topoloc_worlds import wide_views
from topoloc_worlds.rendering.renderer import Rendering
from topoloc_worlds.rendering.variant import LLVM
from topoloc_worlds.wide_views import LIGHTS, draw_poses, main
from topoloc_worlds.worlds import find_world


class WallRenderer:
    """Show a wall four metres ahead, instead of the scene."""

    def __init__(self, *_: object):
        pass

    def render(self, camera: Camera, *_: object) -> Rendering:
        shape = (camera.height, camera.width)
        grey = np.linspace(0.01, 0.02, camera.width, dtype=np.float32)
        radiance = np.ascontiguousarray(np.broadcast_to(grey[None, :, None], (*shape, 3)))
        return Rendering(radiance, np.full(shape, 4.0, np.float32))


def test_each_position_is_seen_ahead_and_to_both_sides():
    poses = list(draw_poses(find_world("corridor"), 1, 0.05, 5, np.random.default_rng(0)))
    assert len(poses) == 15
    looks = np.rad2deg([route.config.look for route, _ in poses]).reshape(5, 3)
    assert np.abs(looks[:, 0]).max() < 12
    assert looks[:, 1].min() > 5
    assert looks[:, 2].max() < -5
    assert np.abs(looks).max() > 30
    centres = np.array([pose.translation for _, pose in poses])
    assert np.linalg.norm(np.ptp(centres, axis=0)) < 12.0


def test_a_folder_holds_photos_and_views_of_each_light(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    (photos / "LICENSE").write_text("no picture")
    for k in range(3):
        cv2.imwrite(str(photos / f"{k}.jpg"), np.full((720, 1280, 3), 40 * k, np.uint8))
    monkeypatch.setattr(wide_views, "Renderer", WallRenderer)
    monkeypatch.setattr(wide_views, "use_best_variant", lambda: LLVM)
    monkeypatch.setattr(type(find_world("street")), "build", lambda *_: None)
    words = ["wide_views", str(out), "--places", "street:1:0.1", "--positions", "2"]
    words += ["--conditions", "day", "rain", "--photos", str(photos)]
    monkeypatch.setattr(sys, "argv", words)
    main()
    records = json.loads((out / "views.json").read_text())
    assert [record["place"] for record in records] == [""] * 3 + ["street:1:0.1"] * 12
    assert {LIGHTS[record["light"]] for record in records[3:]} == {"day", "rain"}
    assert sum(record["share"] for record in records[3:]) == pytest.approx(0.6 * 3)
    assert cv2.imread(str(out / records[0]["file"]), cv2.IMREAD_GRAYSCALE).shape == (360, 640)
    for record in records[3:]:
        assert cv2.imread(str(out / record["file"]), cv2.IMREAD_GRAYSCALE).shape == (400, 640)
        np.testing.assert_allclose(read_depth(out / record["depth"]), 4.0, rtol=1e-3)
        assert np.linalg.det(np.array(record["world_from_cam"])) == pytest.approx(1.0)
