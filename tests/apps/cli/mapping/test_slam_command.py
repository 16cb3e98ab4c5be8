"""Test `topoloc slam`, and `topoloc build` of a recording without poses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc.apps.cli import main
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.trajectory import Trajectory


def test_slam_writes_a_trajectory_and_prints_its_quality(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out, told = tmp_path / "room.tum", tmp_path / "room.json"
    assert main(["slam", str(tiny_recording), str(out), "--json", str(told)]) == 0
    printed = capsys.readouterr().out
    facts = json.loads(told.read_text())
    assert facts["num_frames"] == facts["num_tracked"] == len(Trajectory.read(out)) == 14
    assert facts["ate_m"] < 0.01
    assert facts["num_submaps"] == facts["num_joined"] == 1
    for word in ("key frames", "loops", "sub-maps", "frames a second", "error (ATE)"):
        assert word in printed


def test_a_recording_without_truth_is_mapped_on_slams_poses_and_localizes(
    recording: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (recording / "truth.tum").unlink()
    target, results = tmp_path / "room.topo", tmp_path / "results.jsonl"
    assert main(["build", str(recording), str(target)]) == 0
    assert "poses from slam" in capsys.readouterr().out
    assert main(["localize", str(target), str(queries), "--json", str(results)]) == 0
    localized = [json.loads(line)["localized"] for line in results.read_text().splitlines()]
    assert sum(localized) >= len(localized) - 1


def test_slam_poses_and_others_do_not_mix(
    tiny_recording: Path, tmp_path: Path, complaint: Callable[..., str]
):
    mixed = ["--trajectory", "slam", "--trajectory", "truth"]
    assert "to all recordings or to none" in complaint(
        "build", *mixed, tiny_recording, tiny_recording, tmp_path / "x.topo", status=2
    )


def test_single_pictures_are_refused(queries: Path, tmp_path: Path, complaint: Callable[..., str]):
    assert "single pictures only" in complaint("slam", queries, tmp_path / "x.tum")


def test_photos_alone_are_refused_and_the_remedy_of_the_error_works(
    tiny_recording: Path, tmp_path: Path, complaint: Callable[..., str]
):
    photos, target = tmp_path / "photos", tmp_path / "x.topo"
    shutil.copytree(tiny_recording / "image_0", photos)
    shutil.copy(tiny_recording / "truth.tum", tmp_path)
    needed = complaint("build", photos, target)
    assert "--trajectory FILE" in needed
    posed = ["build", photos, target, "--trajectory", tmp_path / "truth.tum", "--features", "surf"]
    assert "no calibration; put a camera.json into" in complaint(*posed)
    shutil.copy(tiny_recording / "camera.json", photos)
    assert main([str(one) for one in posed]) == 0
    assert len(TopoMetricMap.load(target).summaries) > 1
