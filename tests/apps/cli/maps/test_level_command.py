"""Test `topoloc level`: z points up, the floor is at z = 0, and all distances stay."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from topoloc.apps.cli import main
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence

Complaint = Callable[..., str]
UP = ("--up", "z", "--camera-height", "1.2")


@pytest.fixture
def own_map(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


def level(path: Path, *options: str) -> Rigid3:
    """Run the command and return new_from_old."""
    out = path.with_suffix(".json")
    assert main(["level", str(path), *options, "--json", str(out)]) == 0
    return Rigid3.from_matrix(json.loads(out.read_text())["new_from_old"])


def poses(path: Path) -> list[Rigid3]:
    with TopoMetricMap.load(path) as topomap:
        return [one.world_from_cam for one in topomap.summaries]


def answers(path: Path, queries: Path, out: Path) -> list[dict]:
    assert main(["localize", str(path), str(queries), "--json", str(out)]) == 0
    return [json.loads(line) for line in out.read_text().splitlines()]


def test_answers_move_with_the_map_and_undo_brings_it_back(
    own_map: Path, queries: Path, tmp_path: Path
):
    bytes_before, first = own_map.read_bytes(), poses(own_map)[0]
    before = answers(own_map, queries, tmp_path / "before.jsonl")
    new_from_old = level(own_map, *UP, "--pose", "4,-2,90")
    assert find_map_damage(own_map) == []
    moved = poses(own_map)
    np.testing.assert_allclose(moved[0].translation[:2], [4.0, -2.0], atol=1e-9)
    assert abs(np.median(positions_of(moved)[:, 2]) - 1.2) < 1e-9
    assert moved[0].rotation[1, 2] > 0.9 * abs(first.rotation[:2, 2]).max()  # it looks along y
    after = answers(own_map, queries, tmp_path / "after.jsonl")
    assert sum(line["localized"] for line in before) >= 6
    for one, other in zip(before, after, strict=True):
        assert one["localized"] == other["localized"]
        if one["localized"]:
            expected = new_from_old @ Rigid3.from_json(one["world_from_cam"])
            off = expected.inverse() @ Rigid3.from_json(other["world_from_cam"])
            assert np.linalg.norm(off.translation) < 1e-6
    assert main(["undo", str(own_map)]) == 0
    assert own_map.read_bytes() == bytes_before


def test_place_on_earth_stays(own_map: Path):
    assert main(["georeference", str(own_map), "--origin", "-33.9,151.2,40,90"]) == 0
    with TopoMetricMap.load(own_map) as topomap:
        known, place = topomap.georeference, topomap.summaries[2].world_from_cam
    level(own_map, *UP)
    with TopoMetricMap.load(own_map) as topomap:
        now, new_place = topomap.georeference, topomap.summaries[2].world_from_cam
    assert known is not None
    assert now is not None
    off = now.geopose(new_place).position.ecef() - known.geopose(place).position.ecef()
    assert np.linalg.norm(off) < 1e-6


@pytest.mark.parametrize("are_named", [True, False])
def test_points_of_a_robots_plan(own_map: Path, tmp_path: Path, are_named: bool):
    """Align a map with a plan that is rotated by 30 degrees and shifted."""
    cosine, sine = np.cos(np.pi / 6), np.sin(np.pi / 6)
    plan = np.array([[cosine, -sine], [sine, cosine]])
    with TopoMetricMap.load(own_map) as topomap:
        summaries = [topomap.summaries[row] for row in (0, 3, 6)]
    rows = []
    for one in summaries:
        x, y = plan @ one.world_from_cam.translation[:2] + [7.0, 1.0]
        key = one.name if are_named else ",".join(map(str, one.world_from_cam.translation))
        rows.append(f"{key},{x},{y}\n")
    (tmp_path / "plan.csv").write_text("".join(rows))
    new_from_old = level(own_map, *UP, "--points", str(tmp_path / "plan.csv"))
    np.testing.assert_allclose(new_from_old.rotation[:2, :2], plan, atol=1e-6)
    np.testing.assert_allclose(new_from_old.translation[:2], [7.0, 1.0], atol=1e-6)


def test_points_with_heights_need_no_floor(own_map: Path, tmp_path: Path):
    old = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1.5]])
    true = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.4, -0.2, 1.0]))
    rows = [",".join(map(str, [*one, *true.apply(one)])) for one in old]
    (tmp_path / "plan.csv").write_text("\n".join(rows))
    assert level(own_map, "--points", str(tmp_path / "plan.csv")).is_same(true, 1e-6, 1e-6)


def test_a_map_is_level_at_once(tiny_recording: Path, tmp_path: Path):
    """Level a map during the build. The recording's floor is at z = -1.3, and its z points up."""
    out = tmp_path / "room.topo"
    assert main(["build", str(tiny_recording), str(out), "--level"]) == 0
    sequence = open_sequence(tiny_recording)
    truth = dict(zip(sequence.names, sequence.poses, strict=True))
    with TopoMetricMap.load(out) as topomap:
        for one in topomap.summaries:
            true_pose, pose = truth[one.name], one.world_from_cam
            assert true_pose is not None
            assert abs(pose.translation[2] - true_pose.translation[2] - 1.3) < 0.04
            assert np.degrees(np.arccos(pose.rotation[2] @ true_pose.rotation[2])) < 0.6


def test_faults_have_one_line(own_map: Path, tmp_path: Path, complaint: Complaint):
    plan = tmp_path / "plan.csv"
    text = {
        "0,0,0,0,0\n": "1 of at least 2 points",
        "0,0,0,0,0\n0.1,0,0,0.1,0\n": "0.10 m apart",
        "0,0,0,0,0\n3,0,0,3,0\n0,2,0,0,-2\n": "contradict each other",
        "nobody.png,1,2\n": "no mapping picture is named 'nobody.png'",
        "0,0,0,0,0,0,0\n": "is needed",
        "0,0,0,0,0,0\n1,0,0,1,0,0\n2,0,0,2,0,0\n": "lie on one line",
        "0,0,0,0,0\n1,0,0,1,0,1\n": "all points have a new z, or none",
    }
    for rows, fault in text.items():
        plan.write_text(rows)
        assert fault in complaint("level", own_map, *UP, "--points", plan)
    assert "three numbers" in complaint("level", own_map, "--pose", "1,2", status=2)
    assert "metres above" in complaint("level", own_map, "--camera-height", "-1", status=2)
    assert "one of --pose" in complaint(
        "level", own_map, "--pose", "1,2,3", "--points", plan, status=2
    )
    assert "no floor is seen" in complaint("level", own_map, "--up=-z")
