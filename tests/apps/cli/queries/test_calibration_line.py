"""Test the last line of a query run: all images of a camera together check its calibration."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_world import CAMERA, path_pose, render, room
from topoloc.apps.cli import main


def numbers(scale: float) -> str:
    return f"{scale * CAMERA.fx},{scale * CAMERA.fy},{CAMERA.cx},{CAMERA.cy}"


@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_a_wrong_focal_length_is_reported_once(
    room_map: Path, queries: Path, scale: float, capsys: pytest.CaptureFixture[str]
):
    assert main(["localize", str(room_map), str(queries), "--camera", numbers(scale)]) == 0
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "the pictures say" in line]
    measured = float(said.split("f = ")[1].split(" ")[0])
    assert measured == pytest.approx(CAMERA.fx, rel=0.015)
    assert f"the calibration {scale * CAMERA.fx:.1f}" in said


def test_images_scaled_in_one_direction_are_reported_once(
    room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    camera, height = CAMERA.rescaled(640, 480), 384
    for index in (2.5, 3.5, 4.5, 5.5, 7.5):
        picture = cv2.resize(render(room(), path_pose(index), camera)[0], (640, height))
        cv2.imwrite(str(tmp_path / f"{index}.png"), picture)
    cv2.imwrite(str(tmp_path / "nothing.png"), np.zeros((height, 640), np.uint8))
    stated = f"{camera.fx},{camera.fx},{camera.cx},{(height - 1) / 2}"
    assert main(["localize", str(room_map), str(tmp_path), "--camera", stated]) == 0
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "not scaled as" in line]
    measured = float(said.split("fy = ")[1].split(" ")[0])
    assert measured == pytest.approx(0.8 * camera.fx, rel=0.03)
    # the remedy that it names: the camera of these images
    given = f"{camera.fx},{0.8 * camera.fx},{camera.cx},{(height - 1) / 2}"
    assert main(["localize", str(room_map), str(tmp_path), "--camera", given]) == 0
    seen = capsys.readouterr()
    assert "not scaled as" not in seen.err
    assert seen.out.count("p 0.9") + seen.out.count("p 1.0") >= 4


def test_a_right_calibration_is_not_reported(
    room_map: Path, queries: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["localize", str(room_map), str(queries)]) == 0
    assert "the pictures say" not in capsys.readouterr().err


def test_evaluate_has_it_in_its_json(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "evaluation.json"
    assert main(["evaluate", str(room_map), str(queries), "--json", str(out)]) == 0
    (right,) = json.loads(out.read_text())["calibrations"]
    assert not right["contradicted"]
    assert right["recording"] == queries.name
    assert right["focal_length_px"] == pytest.approx(CAMERA.fx, rel=0.01)
    assert right["num_pictures"] >= 5
    assert (
        main(
            ["evaluate", str(room_map), str(queries), "--camera", numbers(1.05), "--json", str(out)]
        )
        == 0
    )
    (wrong,) = json.loads(out.read_text())["calibrations"]
    assert wrong["contradicted"]
    assert wrong["calibrated_focal_length_px"] == pytest.approx(1.05 * CAMERA.fx)
    assert wrong["detail"] in capsys.readouterr().out
