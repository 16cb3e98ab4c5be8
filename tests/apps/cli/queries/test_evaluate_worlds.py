"""Test `topoloc evaluate` if ground truth and map use different world frames."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc.apps.cli import main
from topoloc.recordings.open import open_sequence
from topoloc.recordings.trajectory import Trajectory

Complaint = Callable[..., str]


def test_a_rigid_fit_is_offered_written_and_read(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = tmp_path / "asked"
    folder.mkdir()
    for path in queries.iterdir():
        if path.name != "truth.tum":
            (folder / path.name).symlink_to(path)
    rows = [line.split() for line in (queries / "truth.tum").read_text().splitlines()]
    # the same poses in a world that is turned by half a turn about z, and 5 m away
    turned = [
        [t, str(5.0 - float(x)), str(-float(y)), z, *(str(v) for v in turned_half(*map(float, q)))]
        for t, x, y, z, *q in rows
    ]
    (folder / "truth.tum").write_text("".join(" ".join(row) + "\n" for row in turned))
    fit = tmp_path / "fit.json"
    assert (
        main(
            [
                "evaluate",
                str(room_map),
                str(folder),
                "--fit-map-from-truth",
                str(fit),
                "--json",
                str(tmp_path / "a.json"),
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert "its truth is in another world than the map: one rigid transform" in printed
    assert f"--map-from-truth {fit}" in printed
    before = json.loads((tmp_path / "a.json").read_text())
    assert before["median_translation_m"] > 1.0
    assert before["world_fits"][0]["median_translation_m"] < 0.05
    assert (
        main(["evaluate", str(room_map), str(folder), "--map-from-truth", str(fit), "--json", "-"])
        == 0
    )
    after = json.loads(capsys.readouterr().out)
    assert after["median_translation_m"] < 0.05
    assert after["world_fits"] == []


def turned_half(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) after half a turn about z: (0, 0, 1, 0) times it."""
    return (-y, x, w, -z)


def test_no_transform_is_written_without_errors_to_explain(
    room_map: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    fit = tmp_path / "fit.json"
    assert "no rigid transform" in complaint(
        "evaluate", room_map, queries, "--fit-map-from-truth", fit
    )
    assert "needs one recording" in complaint(
        "evaluate", room_map, queries, queries, "--fit-map-from-truth", fit, status=2
    )


def test_the_lab_of_the_zed_minutes_later(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The world frames of the two sessions are 20 degrees apart."""
    lab, path = shared / "data" / "zed_lab", tmp_path / "lab.topo"
    assert main(["build", f"{lab}/session1@0::4", str(path), "--features", "surf"]) == 0
    assert (
        main(["evaluate", str(path), f"{lab}/session2@0:99:9", "--json", str(tmp_path / "a.json")])
        == 0
    )
    assert "another world" in capsys.readouterr().out
    (fit,) = json.loads((tmp_path / "a.json").read_text())["world_fits"]
    known = json.loads((lab / "session1_from_session2.json").read_text())["session1_from_session2"]
    assert fit["median_translation_m"] < 0.02
    for row, other in zip(fit["map_from_truth"][:3], known, strict=False):
        assert row == pytest.approx(other, abs=0.02)


def test_truth_in_another_convention_is_converted(
    room_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    inverse, out = tmp_path / "inverse", tmp_path / "a.json"
    shutil.copytree(queries, inverse)
    sequence = open_sequence(queries)
    poses = [pose.inverse() for pose in sequence.poses if pose is not None]
    Trajectory(poses, sequence.t_ns).write_tum(inverse / "truth.tum")
    assert (
        main(
            ["evaluate", str(room_map), f"{inverse}@0:3", "--poses", "inverse", "--json", str(out)]
        )
        == 0
    )
    evaluation = json.loads(out.read_text())
    assert evaluation["num_localized"] == 3
    assert evaluation["median_translation_m"] < 0.05
    assert main(["evaluate", str(room_map), str(inverse), "--poses", "upside-down"]) == 1
    assert "known are" in capsys.readouterr().err
