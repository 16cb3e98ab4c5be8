"""Pictures without a calibration: localized all the same, with the focal length that was found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.apps.cli import main


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


def test_a_calibrated_picture_has_no_such_entry(room_map: Path, queries: Path, tmp_path: Path):
    assert main(["localize", str(room_map), str(queries), "--json", str(tmp_path / "a.json")]) == 0
    assert all("focal_length_px" not in line for line in _lines(tmp_path / "a.json"))
