"""Find the mountings of a rig with the command, as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from made_rigs import lab_map
from topoloc import Rig, Rigid3, open_sequence
from topoloc.apps.cli import main
from topoloc.demo.recordings import SHIPPED

FIRST = (0, 4, 8, 12, 16, 20)
FRAMES_APART = 4


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a map and a rig of two cameras, which show nearly the same view."""
    folder = tmp_path_factory.mktemp("calibrate")
    lab_map(folder)
    frames = open_sequence(SHIPPED / "day")
    for name in ("a", "b"):
        (folder / "walk" / name).mkdir(parents=True)
        camera = frames[0].camera
        assert camera is not None
        (folder / "walk" / name / "camera.json").write_text(json.dumps(camera.to_json()))
        for first in FIRST:
            image = frames[first].image
            image = image if image.ndim == 2 else image[..., ::-1]
            # b is out of focus: other key points, the same pose
            image = image if name == "a" else cv2.GaussianBlur(image, (0, 0), 0.8)
            cv2.imwrite(str(folder / "walk" / name / f"{first:03d}.png"), image)
    return folder


def _write_rig(folder: Path, mounting: Rigid3) -> None:
    a = Rigid3.exp(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    cameras = {
        "a": {"rig_from_cam": a.to_json()},
        "b": {"rig_from_cam": (a @ mounting).to_json()},
    }
    (folder / "rig.json").write_text(json.dumps({"cameras": cameras}))


def test_a_wrong_mounting_is_found_and_written_with_its_sigmas(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    wrong = Rigid3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    _write_rig(place / "walk", wrong)
    out, details = tmp_path / "rig.json", tmp_path / "found.json"
    arguments = ["calibrate", str(place / "lab.topo"), "--rig", str(place / "walk")]
    assert main([*arguments, "--out", str(out), "--json", str(details)]) == 0
    printed = capsys.readouterr().out
    assert "a  the reference" in printed
    assert "moved by" in printed
    rig = Rig.read(out)
    a, b = rig.cameras["a"], rig.cameras["b"]
    assert np.allclose(a.rig_from_cam.translation, [0.0, 0.5, 0.0])
    assert a.rig_from_cam.is_same(b.rig_from_cam, 0.01, np.deg2rad(0.3))
    assert 0.0 < b.position_sigma_m < 0.01
    assert 0.0 < b.rotation_sigma_deg < 0.3
    assert b.camera is not None
    found = json.loads(details.read_text())["b"]
    assert found["num_instants"] >= found["num_agreeing"] >= 3
    assert np.array(found["covariance"]).shape == (6, 6)


def test_without_rig_json_the_folders_are_the_cameras(place: Path, tmp_path: Path):
    (place / "walk" / "rig.json").unlink(missing_ok=True)
    out = tmp_path / "rig.json"
    arguments = ["calibrate", str(place / "lab.topo"), "--rig", str(place / "walk")]
    assert main([*arguments, "--out", str(out)]) == 0
    cameras = Rig.read(out).cameras
    assert list(cameras) == ["a", "b"]
    assert np.allclose(cameras["a"].rig_from_cam.matrix(), np.eye(4))


def test_bad_input_is_one_line(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    lab = str(place / "lab.topo")
    few = tmp_path / "few"
    for name in ("a", "b"):
        (few / name).mkdir(parents=True)
        for file in ("camera.json", "000.png"):
            (few / name / file).write_bytes((place / "walk" / name / file).read_bytes())
    cases = [
        (["calibrate", lab], 2, "calibrate takes --rig FOLDER"),
        (["calibrate", lab, "--rig", str(tmp_path / "none")], 1, "a rig has a folder of images"),
        (["calibrate", lab, "--rig", str(few)], 1, "two cameras are localized at 1 of 1 instants"),
    ]
    for arguments, status, fault in cases:
        assert main(arguments) == status
        error = capsys.readouterr().err.strip()
        assert fault in error
        assert "\n" not in error
