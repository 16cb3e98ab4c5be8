"""Test `topoloc georeference`: it stores the place of a map on earth, and results get a GeoPose."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from schemas import check_result
from topoloc.apps.cli import main
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap

Complaint = Callable[..., str]
TRUE = Georeference(
    GeoPoint(-33.9, 151.2, 40.0),
    Rigid3(exp_so3(np.array([0.0, 0.0, 2.0])), np.array([5.0, 6.0, 1.0])),
    "truth",
)


@pytest.fixture
def own_map(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


def row(key: str, place: GeoPoint) -> str:
    return f"{key},{place.lat:.10f},{place.lon:.10f},{place.h:.4f}\n"


def placed(path: Path) -> Georeference:
    with TopoMetricMap.load(path) as topomap:
        assert topomap.georeference is not None
        return topomap.georeference


def off(path: Path) -> float:
    """Return the error in metres of one point of the room on earth."""
    point = np.array([1.0, 3.0, 0.5])
    return float(np.linalg.norm(placed(path).geopoint(point).ecef() - TRUE.geopoint(point).ecef()))


def test_results_of_such_a_map_carry_a_geopose(
    own_map: Path, queries: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with TopoMetricMap.load(own_map) as topomap:
        before = (topomap.id, topomap.version)
    assert main(["georeference", str(own_map), "--origin", "-33.9,151.2,40,90"]) == 0
    assert "first picture looks to  90.0 degrees" in capsys.readouterr().out
    assert find_map_damage(own_map) == []
    assert main(["localize", str(own_map), str(queries), "--json", str(tmp_path / "r.jsonl")]) == 0
    lines = [json.loads(line) for line in (tmp_path / "r.jsonl").read_text().splitlines()]
    for line in lines:
        check_result(line)
        assert (line["map"], line["version"]) == (before[0], before[1] + 1)
        assert line["t_ns"] is not None
        assert ("geopose" in line) == line["localized"]
        if line["localized"]:
            assert line["geopose"]["position"]["lat"] == pytest.approx(-33.9, abs=1e-4)
    capsys.readouterr()
    assert main(["info", str(own_map)]) == 0
    assert "-33.9000000, 151.2000000, 40.00 m (from origin)" in capsys.readouterr().out


def test_a_single_photo_has_no_time(
    own_map: Path, queries: Path, capsys: pytest.CaptureFixture[str]
):
    photo = next(queries.glob("*.png"))
    assert main(["localize", str(own_map), str(photo), "--json", "-"]) == 0
    line = json.loads(capsys.readouterr().out)
    check_result(line)
    assert line["t_ns"] is None


def test_gnss_by_time_and_by_name(own_map: Path, tmp_path: Path):
    file = tmp_path / "gnss.csv"
    with TopoMetricMap.load(own_map) as topomap:
        images, summaries = list(topomap.place_images), list(topomap.summaries)
    poses = [(image.name, image.world_from_cam.translation) for image in images]
    file.write_text(
        "name,lat,lon,h\n" + "".join(row(name, TRUE.geopoint(position)) for name, position in poses)
    )
    assert main(["georeference", str(own_map), "--gnss", str(file)]) == 0
    assert off(own_map) < 0.05
    by_time = [(s.t_ns, s.world_from_cam.translation) for s in summaries]
    file.write_text(
        "".join(row(f"{t_ns / 1e9:.9f}", TRUE.geopoint(position)) for t_ns, position in by_time)
    )
    assert (
        main(
            ["georeference", str(own_map), "--gnss", str(file), "--json", str(tmp_path / "g.json")]
        )
        == 0
    )
    assert off(own_map) < 0.05
    facts = json.loads((tmp_path / "g.json").read_text())
    assert facts["num_used"] == facts["num_points"] == len(summaries)
    assert facts["source"] == "gnss"


def test_three_known_points(own_map: Path, tmp_path: Path):
    points = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.5], [1.0, 4.0, 0.0]])
    lines = [
        f"{x},{y},{z},{row('', TRUE.geopoint(np.array([x, y, z]))).lstrip(',')}"
        for x, y, z in points
    ]
    (tmp_path / "points.csv").write_text("".join(lines))
    assert main(["georeference", str(own_map), "--points", str(tmp_path / "points.csv")]) == 0
    assert off(own_map) < 0.001
    placed_before = own_map.read_bytes()
    with TopoMetricMap.load(own_map) as topomap:
        topomap.save(own_map)
    assert own_map.read_bytes() == placed_before


def test_invalid_inputs_are_refused(own_map: Path, tmp_path: Path, complaint: Complaint):
    file = tmp_path / "bad.csv"
    assert "one of --origin" in complaint("georeference", own_map, status=2)
    assert "four numbers" in complaint("georeference", own_map, "--origin", "1,2,3")
    assert "latitude 95" in complaint("georeference", own_map, "--origin", "95,2,3,4")
    assert "a height of 1e+06 m" in complaint("georeference", own_map, "--origin", "5,2,1e6,4")
    assert "a heading of nan" in complaint("georeference", own_map, "--origin", "5,2,3,nan")
    assert "up is one of" in complaint("georeference", own_map, "--origin", "5,2,3,4", "--up", "w")
    for text, words in (
        ("", "nothing in this file"),
        ("x,y,z,lat,lon,h\n", "nothing in this file but titles"),
        ("1,2,3,4,5,6\n1,2,3,4,5\n", "line 2: 5 columns"),
        ("1,2,3,4,5,6\n1,2,3,4,5,1e99999999\n", "is not a number"),
        ("1,2,3,94,5,6\n", "line 1: latitude 94"),
        ("0,0,0,48,16,0\n1,0,0,48.00001,16,0\n", "at least 3"),
        ("0,0,0,48,16,0\n1,0,0,48.000009,16,0\n2,0,0,48.000018,16,0\n", "leave the rotation open"),
    ):
        file.write_text(text)
        assert words in complaint("georeference", own_map, "--points", file)
    file.write_text("nowhere.png,48,16,0\n")
    assert "name of a mapping picture, such as" in complaint(
        "georeference", own_map, "--gnss", file
    )
    file.write_text("99999,48,16,0\n99999.1,48,16,0\n")
    assert "no fix is of a time of the map" in complaint("georeference", own_map, "--gnss", file)
    file.write_bytes(b"\x00\xff\xfe")
    assert "not a text file" in complaint("georeference", own_map, "--gnss", file)
    assert "no such file" in complaint("georeference", own_map, "--gnss", tmp_path / "gone.csv")
    assert ": no file" in complaint("georeference", own_map, "--gnss", tmp_path)
