"""Test --camera, --scale and --images, and lists of images of several sizes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.mapping.topomap import TopoMetricMap

Complaint = Callable[..., str]
NUMBERS = "260,260,159.5,119.5"


def test_build_and_evaluate_by_four_numbers(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    target = tmp_path / "room.topo"
    assert (
        main(
            [
                "build",
                f"{tiny_recording}@0::2",
                str(target),
                "--camera",
                NUMBERS,
                "--features",
                "surf",
            ]
        )
        == 0
    )
    assert TopoMetricMap.load(target).nodes[0].camera == CAMERA
    capsys.readouterr()
    assert (
        main(
            ["evaluate", str(target), f"{tiny_recording}@1:6:2", "--camera", NUMBERS, "--json", "-"]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["median_translation_m"] < 0.02


def test_slam_by_a_file(tiny_recording: Path, tmp_path: Path):
    """A calibration file is used as it is: twice the baseline makes the trajectory
    twice as long."""
    (tmp_path / "mine.json").write_text(json.dumps(CAMERA.to_json() | {"baseline": 0.24}))
    lengths = []
    for name, options in (("own", []), ("mine", ["--camera", str(tmp_path / "mine.json")])):
        out = tmp_path / f"{name}.json"
        assert (
            main(
                [
                    "slam",
                    f"{tiny_recording}@0:6",
                    str(tmp_path / f"{name}.tum"),
                    "--json",
                    str(out),
                    *options,
                ]
            )
            == 0
        )
        lengths.append(json.loads(out.read_text())["length_m"])
    assert lengths[1] == pytest.approx(2.0 * lengths[0], rel=0.1)


def test_numbers_of_another_size(
    tiny_recording: Path, room_map: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    numbers = "520,520,319.5,239.5"
    said = "are those of a picture of about 640x480 pixels; this one has 320x240"
    assert said in complaint("build", tiny_recording, tmp_path / "room.topo", "--camera", numbers)
    assert said in complaint("slam", tiny_recording, tmp_path / "room.tum", "--camera", numbers)
    assert said in complaint("evaluate", room_map, queries, "--camera", numbers)
    assert said in complaint("localize", room_map, queries / "view00.png", "--camera", numbers)


def test_one_picture_of_another_shape_in_a_list(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "photos"
    shutil.copytree(
        queries, folder, ignore=shutil.ignore_patterns("camera.json", "truth.tum", "times.txt")
    )
    assert cv2.imwrite(str(folder / "view01.png"), np.zeros((320, 240), np.uint8))
    assert main(["localize", str(room_map), str(folder), "--camera", NUMBERS, "--json", "-"]) == 0
    printed = capsys.readouterr()
    results = [json.loads(line) for line in printed.out.splitlines()]
    assert results[1]["reason"] == "unreadable"
    assert "turned by 90 degrees" in results[1]["detail"]
    assert [result["localized"] for result in results].count(True) >= len(results) - 2
    assert "1 of" in printed.err


@pytest.mark.parametrize(
    ("options", "status", "says"),
    [
        (["--scale", "0"], 2, "--scale must be a positive number, or IMAGE_A,IMAGE_B=3.2m, not 0"),
        (
            ["--scale", "nan"],
            2,
            "--scale must be a positive number, or IMAGE_A,IMAGE_B=3.2m, not nan",
        ),
        (["--scale", "2", "--trajectory", "slam"], 2, "slam computes its own"),
        (["--images", "."], 1, "takes no images"),
        (["--camera", "nowhere.yaml"], 1, "nowhere.yaml: no calibration here"),
    ],
)
def test_invalid_cameras_are_refused(
    options: list[str],
    status: int,
    says: str,
    tiny_recording: Path,
    tmp_path: Path,
    complaint: Complaint,
):
    assert says in complaint(
        "build", tiny_recording, tmp_path / "room.topo", *options, status=status
    )


def test_a_scale_is_that_of_the_poses(tiny_recording: Path, tmp_path: Path):
    """A map of single images has the scale of its poses."""
    own = tmp_path / "single"
    (own / "images").mkdir(parents=True)
    for file in sorted((tiny_recording / "image_0").iterdir()):
        shutil.copy(file, own / "images" / file.name)
    shutil.copy(tiny_recording / "truth.tum", own / "truth.tum")
    shutil.copy(tiny_recording / "times.txt", own / "times.txt")
    (own / "camera.json").write_text(json.dumps(CAMERA.to_json()))
    medians = []
    for scale in ("1", "3"):
        assert (
            main(
                [
                    "build",
                    str(own),
                    str(tmp_path / f"{scale}.topo"),
                    "--features",
                    "surf",
                    "--scale",
                    scale,
                ]
            )
            == 0
        )
        nodes = TopoMetricMap.load(tmp_path / f"{scale}.topo").nodes
        medians.append(float(np.median(np.concatenate([node.points_cam[:, 2] for node in nodes]))))
    assert medians[1] == pytest.approx(3.0 * medians[0], rel=0.02)


def test_map_is_the_camera_of_the_recording_before_rectification(shared: Path, tmp_path: Path):
    recording, target = shared / "data/euroc/v1_01_part", tmp_path / "hall.topo"
    words = ["build", f"{recording}@0:10", str(target), "--features", "surf"]
    assert main([*words, "--trajectory", "slam"]) == 0
    photo = sorted((recording / "mav0/cam0/data").iterdir())[4]
    shutil.copy(photo, tmp_path / "raw.png")
    out = tmp_path / "a.json"
    words = ["localize", str(target), str(tmp_path / "raw.png"), "--json", str(out)]
    assert main([*words, "--camera", "map"]) == 0
    answer = json.loads(out.read_text())
    assert answer["localized"]
    assert np.linalg.norm(answer["world_from_cam"]["translation"]) < 0.05
