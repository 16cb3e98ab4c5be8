"""Check that commands print how they interpret a recording and never use results as
its ground truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from topoloc.apps.cli import main


def test_answers_beside_a_recording_are_no_ground_truth(
    room_map: Path,
    tiny_recording: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    walk = Path(shutil.copytree(tiny_recording, tmp_path / "walk"))
    truth = walk / "truth.tum"
    truth.unlink()
    assert main(["localize", str(room_map), str(walk), "--tum", str(truth)]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(room_map), str(walk)]) == 1
    warning, error = capsys.readouterr().err.splitlines()
    assert f"{truth}: answers of a map, no ground truth; delete its first line" in warning
    assert "no frame has a known pose" in error
    truth.write_text("".join(truth.read_text().splitlines(keepends=True)[1:]))
    assert main(["evaluate", str(room_map), str(walk)]) == 0
    assert " cm" in capsys.readouterr().out


def test_build_warns_of_nodes_that_contradict_the_rest(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    walk, target = Path(shutil.copytree(tiny_recording, tmp_path / "walk")), tmp_path / "a.topo"
    rows = [line.split() for line in (walk / "truth.tum").read_text().splitlines()]
    for row in rows[4:7]:  # the tracker was a metre off for a while
        row[1] = str(float(row[1]) + 1.0)
    (walk / "truth.tum").write_text("".join(" ".join(row) + "\n" for row in rows))
    command = ["build", str(walk), str(target), "--features", "surf", "--poses", "unchecked"]
    assert main(command) == 0
    (warning,) = capsys.readouterr().err.splitlines()
    assert "nodes contradict the rest (node " in warning
    assert "topoloc info --check" in warning
    assert main(["info", str(target), "--check"]) == 1
    capsys.readouterr()
    assert main(["build", str(tiny_recording), str(target), "--features", "surf"]) == 0
    assert "contradict" not in capsys.readouterr().err


def test_build_prints_how_it_understood_a_recording_and_warns_of_a_still_camera(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source = f"{tiny_recording}@0:2"
    command = ["build", source, str(tmp_path / "a.topo"), "--features", "surf", "--d-thresh", "9"]
    assert main(command) == 0
    printed = capsys.readouterr()
    understood = "kitti, 2 stereo pairs of 320 x 240 in 0.1 s, f 260 px, poses of 2 frames"
    assert printed.out.splitlines()[0] == f"{source}: {understood}"
    assert "one node, the camera moved less than --d-thresh" in printed.err
    assert main([*command, "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["num_nodes"] == 1


def test_a_folder_of_recordings_lists_them(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    for name in ("walk1", "walk2"):
        shutil.copytree(tiny_recording, tmp_path / "day" / name)
    assert main(["build", str(tmp_path / "day"), str(tmp_path / "a.topo")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no recording, but a folder of 2: walk1 (kitti), walk2 (kitti)" in line
    assert line.endswith(f"such as {tmp_path / 'day' / 'walk1'}")


def test_a_map_that_build_replaces_comes_back(
    tiny_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = tmp_path / "a.topo"
    assert main(["build", str(tiny_recording), str(path), "--features", "surf"]) == 0
    before = path.read_bytes()
    assert "was there" not in capsys.readouterr().err
    assert main(["build", f"{tiny_recording}@0:2", str(path), "--features", "surf"]) == 0
    assert f"`topoloc undo {path}` brings it back" in capsys.readouterr().err
    assert path.read_bytes() != before
    assert main(["undo", str(path)]) == 0
    assert path.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == [path]
