"""Localize the images of rigs with the command, as a user types it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from made_rigs import NAMES, instant, lab_map
from topoloc import Trajectory
from topoloc.apps.cli import main

INSTANTS = (0, 8)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a map and recordings of two instants by each camera of a rig."""
    folder = tmp_path_factory.mktemp("rig")
    lab_map(folder)
    rig, _, _ = instant(0)
    for name in NAMES:
        (folder / "walk" / name).mkdir(parents=True)
        camera = rig.cameras[name].camera
        assert camera is not None
        (folder / "walk" / name / "camera.json").write_text(json.dumps(camera.to_json()))
    for first in INSTANTS:
        _, images, _ = instant(first)
        for name, image in images.items():
            colours = image if image.ndim == 2 else image[..., ::-1]
            cv2.imwrite(str(folder / "walk" / name / f"{first:03d}.png"), colours)
    return folder


def _write_rig(folder: Path, names: tuple[str, ...] = NAMES) -> Path:
    """Write the mountings of the first instant, without camera models."""
    rig, _, _ = instant(INSTANTS[0])
    cameras = {
        other: {"rig_from_cam": rig.cameras[name].rig_from_cam.to_json()}
        for name, other in zip(NAMES, names, strict=True)
    }
    path = folder / "rig.json"
    path.write_text(json.dumps({"cameras": cameras}))
    return path


def test_one_pose_for_all_cameras_of_an_instant(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rig = _write_rig(tmp_path)
    results, poses = tmp_path / "out.jsonl", tmp_path / "out.tum"
    arguments = ["localize", str(place / "lab.topo"), str(place / "walk"), "--rig", str(rig)]
    assert main([*arguments, "--json", str(results), "--tum", str(poses)]) == 0
    printed = capsys.readouterr().out.splitlines()
    lines: list[dict[str, Any]] = [json.loads(line) for line in results.read_text().splitlines()]
    _, _, truth = instant(INSTANTS[0])
    right, other = lines
    assert right["localized"] is True
    assert sorted(right["used"]) == list(NAMES)
    assert set(right["cameras"]) == set(NAMES)
    assert right["cameras"]["b"]["query"] == "b"
    position = right["world_from_rig"]["translation"]
    assert np.linalg.norm(np.array(position) - truth.translation) < 0.03
    assert "rig at" in printed[0]
    assert len(Trajectory.read(poses)) >= 1
    # the mountings are those of the first instant: at the second they are wrong, and it is said
    assert other["left_out"] or other["reason"] == "ambiguous"


def test_a_camera_without_images_is_not_needed(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    rig = _write_rig(tmp_path, ("a", "b", "behind"))
    arguments = ["localize", str(place / "lab.topo"), str(place / "walk"), "--rig", str(rig)]
    assert main([*arguments, "--json", "-"]) == 0
    first = json.loads(capsys.readouterr().out.splitlines()[0])
    assert sorted(first["used"]) == ["a", "b"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["walk", "--rig", "none.json"], "no such rig file"),
        (["walk", "--rig", "rig.json", "--camera", "map"], "--rig takes no --camera"),
        (["walk/a", "--rig", "rig.json"], "no folder is named as a camera of"),
        (["walk/a", "--rig", "equirectangular"], "twice as wide as high"),
        (["--rig", "rig.json"], "at least one image, folder or recording"),
    ],
)
def test_bad_input_is_one_line(
    place: Path,
    tmp_path: Path,
    arguments: list[str],
    fault: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.chdir(place)
    _write_rig(place)
    assert main(["localize", "lab.topo", *arguments]) != 0
    error = capsys.readouterr().err.strip()
    assert fault in error
    assert "\n" not in error


def test_images_of_one_instant_have_one_name(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    walk = tmp_path / "walk"
    for name in NAMES:
        (walk / name).mkdir(parents=True)
        (walk / name / f"{name}_000.png").write_bytes((place / "walk/a/000.png").read_bytes())
    rig = _write_rig(tmp_path)
    assert main(["localize", str(place / "lab.topo"), str(walk), "--rig", str(rig)]) == 1
    assert "name the images of one instant alike" in capsys.readouterr().err


def _write_truth(walk: Path) -> None:
    lines = list[str]()
    for row, first in enumerate(INSTANTS):
        _, _, pose = instant(first)
        w, x, y, z = pose.quat_wxyz()
        lines.append(" ".join(map(str, [row / 10, *pose.translation, x, y, z, w])))
    (walk / "truth.tum").write_text("\n".join(lines) + "\n")


def test_the_poses_of_a_rig_are_evaluated(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    walk = tmp_path / "walk"
    shutil.copytree(place / "walk", walk)
    _write_rig(walk)
    _write_truth(walk)
    results = tmp_path / "out.json"
    arguments = ["evaluate", str(place / "lab.topo"), str(walk), "--json", str(results)]
    assert main(arguments) == 0
    table = capsys.readouterr().out
    found = json.loads(results.read_text())
    assert found["num_queries"] == len(INSTANTS)
    right, other = found["answers"]
    assert right["localized"] is True
    assert sorted(right["used"]) == list(NAMES)
    truth = right["true_world_from_rig"]["translation"]
    assert np.allclose(right["world_from_rig"]["translation"], truth, atol=0.03)
    assert "false accepts" in table
    # the mountings are those of the first instant, and wrong at the second
    assert found["left_out"] if other["localized"] else found["not_localized"]["ambiguous"] == 1
    assert main([*arguments[:2], f"{walk}@0"]) == 0
    assert "1 of 1 (100.0 %)" in capsys.readouterr().out
    assert main([*arguments[:3], "--camera", "map"]) == 2
    assert "the calibrations of rigs are in rig.json" in capsys.readouterr().err
