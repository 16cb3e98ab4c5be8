"""Test images without a calibration: the result has a pose and the estimated focal length."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.geometry.camera import Camera


def _lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize(
    "options", [[], ["--camera", "unknown"]], ids=["no camera.json", "--camera unknown"]
)
def test_the_focal_length_is_found_with_the_pose(
    options: list[str], room_map: Path, queries: Path, tmp_path: Path
):
    folder = tmp_path / "photos"
    folder.mkdir()
    for picture in queries.glob("*.png"):
        (folder / picture.name).write_bytes(picture.read_bytes())
    if options:
        (folder / "camera.json").write_bytes((queries / "camera.json").read_bytes())
    assert (
        main(["localize", str(room_map), str(folder), "--json", str(tmp_path / "a.json"), *options])
        == 0
    )
    lines = _lines(tmp_path / "a.json")
    found = [
        (line, truth)
        for line, (_, truth) in zip(lines, unseen_views(), strict=True)
        if line["localized"]
    ]
    assert len(found) >= 0.8 * len(lines)
    focals = np.array([line["focal_length_px"] for line, _ in found])
    assert abs(np.median(focals) / CAMERA.fx - 1.0) < 0.03
    errors = [
        np.linalg.norm(np.array(line["world_from_cam"]["translation"]) - truth.translation)
        for line, truth in found
    ]
    assert np.median(errors) < 0.05


def test_photos_of_one_camera_share_it(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder, camera = tmp_path / "photos", tmp_path / "camera.json"
    folder.mkdir()
    for picture in queries.glob("*.png"):  # a fifth of the width cut off at the left
        cut = cv2.imread(str(picture))[:, CAMERA.width // 5 :]
        cv2.imwrite(str(folder / picture.name), cut)
    words = [str(room_map), str(folder), "--json", str(tmp_path / "a.json")]
    trajectory = tmp_path / "photos.tum"
    assert main(["localize", *words, "--save-camera", str(camera), "--tum", str(trajectory)]) == 0
    said = "".join(capsys.readouterr())
    (num_images,) = re.findall(r"from (\d+) images", said)
    assert int(num_images) <= len(list(folder.iterdir())), "each counts once"
    rows = [row.split() for row in trajectory.read_text().splitlines() if not row.startswith("#")]
    assert all(float(row[0]).is_integer() for row in rows), "photos have no times"
    found, width = Camera.from_json(camera.read_text()), CAMERA.width
    assert found.fx == pytest.approx(CAMERA.fx, rel=0.02)
    assert found.cx == pytest.approx(CAMERA.cx - width // 5, abs=0.01 * width)
    by_estimate = _lines(tmp_path / "a.json")
    assert main(["localize", *words, "--camera", str(camera)]) == 0
    for line, again, (_, truth) in zip(
        by_estimate, _lines(tmp_path / "a.json"), unseen_views(), strict=True
    ):
        if again["localized"]:
            assert line["localized"]
            for one in (line, again):
                moved = np.array(one["world_from_cam"]["translation"]) - truth.translation
                assert np.linalg.norm(moved) < 0.1


def test_a_stream_learns_its_camera(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "photos"
    folder.mkdir()
    for picture in queries.glob("*.png"):
        (folder / picture.name).write_bytes(picture.read_bytes())
    assert main(["follow", str(room_map), str(folder), "--camera", "unknown"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    found = [line for line in lines if line["state"] in ("localized", "tracked")]
    assert len(found) >= 0.8 * len(lines)
    assert "focal_length_px" in found[0], "the first image is localized alone"
    assert "focal_length_px" not in found[-1], "the last one by the camera of the stream"


def test_a_calibrated_picture_has_no_such_entry(room_map: Path, queries: Path, tmp_path: Path):
    assert main(["localize", str(room_map), str(queries), "--json", str(tmp_path / "a.json")]) == 0
    assert all("focal_length_px" not in line for line in _lines(tmp_path / "a.json"))
