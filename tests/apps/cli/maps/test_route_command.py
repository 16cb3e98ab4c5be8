"""Test `topoloc route` as it is typed, and the junctions that other outputs show of its map."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from topoloc import Atlas, TopoMetricMap
from topoloc.apps.cli import main
from topoloc.apps.viewer.document import create_document
from topoloc.apps.viewer.worlds import create_world_document
from topoloc.atlas.place import SharedWorld
from walked_maps import map_of_walks, walk_along

EAST_WEST, NORTH_SOUTH = [(-8.0, 0.0), (8.0, 0.0)], [(0.0, -8.0), (0.0, 8.0)]


@pytest.fixture
def crossing(tmp_path: Path) -> Path:
    path = tmp_path / "crossing.topo"
    map_of_walks(walk_along(EAST_WEST), walk_along(NORTH_SOUTH)).save(path)
    return path


@pytest.fixture
def hall(tmp_path: Path) -> str:
    """Return an atlas of two tiles in one world. Their walks cross."""
    names = {"across": EAST_WEST, "along": NORTH_SOUTH}
    for name, corners in names.items():
        map_of_walks(walk_along(corners)).save(tmp_path / f"{name}.topo")
    where = tmp_path / "hall"
    Atlas.create(str(where), [str(tmp_path / f"{name}.topo") for name in names], world="hall")
    return str(where)


def test_the_way_is_printed_along_nodes(crossing: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["route", str(crossing), "-8,0,1.4", "0,8,1.4"]) == 0
    first, header, *rows = capsys.readouterr().out.splitlines()
    cells = [row.split() for row in rows]
    with TopoMetricMap.load(crossing) as topomap:
        at = {str(one.node_id): one.world_from_cam.translation for one in topomap.summaries}
    assert header.split() == ["metres", "node", "x", "y", "z"]
    np.testing.assert_allclose(at[cells[0][1]], [-8.0, 0.0, 1.4], atol=0.5)
    np.testing.assert_allclose(at[cells[-1][1]], [0.0, 8.0, 1.4], atol=0.5)
    assert first.startswith(f"{cells[-1][0]} m from node {cells[0][1]} to {cells[-1][1]}")
    assert 14.0 < float(cells[-1][0]) < 1.1 * 16.0
    for _, node, *position in cells:
        np.testing.assert_allclose([float(value) for value in position], at[node], atol=0.006)


def test_nodes_are_named_by_their_ids(
    crossing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    target = tmp_path / "way.json"
    assert main(["route", str(crossing), "0", "7", "--json", str(target)]) == 0
    way = json.loads(target.read_text())
    assert [way["nodes"][0]["node"], way["nodes"][-1]["node"]] == [0, 7]
    assert way["metres"] == way["nodes"][-1]["metres"] > way["nodes"][0]["metres"] == 0.0
    capsys.readouterr()
    assert main(["route", str(crossing), "0", "7", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == way


def test_a_way_leads_over_tiles(hall: str, capsys: pytest.CaptureFixture[str]):
    assert main(["route", hall, "across/0", "0,8,1.4", "--json", "-"]) == 0
    way = json.loads(capsys.readouterr().out)
    tiles = [one["tile"] for one in way["nodes"]]
    assert (tiles[0], tiles[-1]) == ("across", "along")
    assert tiles == sorted(tiles)  # it changes the tile once
    assert 14.0 < way["metres"] < 1.1 * 16.0


def test_faults_of_the_ends_are_named(crossing: Path, hall: str, complaint: Callable[..., str]):
    assert "such as 0 or" in complaint("route", crossing, "0", "9999", status=2)
    assert "x,y,z" in complaint("route", crossing, "1,2", "0", status=2)
    assert "x,y,z" in complaint("route", crossing, "0", "nan,0,0", status=2)
    assert "such as across/0 or" in complaint("route", hall, "0", "along/0", status=2)
    assert "no tile" in complaint("route", hall, "0", "1", "--tile", "attic")


def test_unconnected_parts_and_the_remedy(tmp_path: Path, complaint: Callable[..., str]):
    path = tmp_path / "parts.topo"
    map_of_walks(walk_along(EAST_WEST), walk_along([(0.0, 4.0), (0.0, 8.0)])).save(path)
    assert "topoloc update" in complaint("route", path, "-8,0,1.4", "0,8,1.4")
    map_of_walks(*map(walk_along, (EAST_WEST, [(0.0, 4.0), (0.0, 8.0)], NORTH_SOUTH))).save(path)
    assert main(["route", str(path), "-8,0,1.4", "0,8,1.4"]) == 0


def test_info_and_exports_show_junctions(
    crossing: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["info", str(crossing), "--json", str(tmp_path / "info.json")]) == 0
    (one,) = json.loads((tmp_path / "info.json").read_text())["junctions"]
    assert one["ways"] == 4
    np.testing.assert_allclose(one["position"][:2], [0.0, 0.0], atol=1.0)
    line = next(row for row in capsys.readouterr().out.splitlines() if row.startswith("junctions"))
    assert line.split(maxsplit=1)[1].startswith(f"1: node {one['node']} at ")
    assert main(["georeference", str(crossing), "--origin", "48.2,16.37,170,90"]) == 0
    for arguments in (["info", crossing, "--graph"], ["export", crossing]):
        target = tmp_path / f"{arguments[0]}.geojson"
        assert main([*map(str, arguments), str(target)]) == 0
        features = json.loads(target.read_text())["features"]
        facts = [feature["properties"] for feature in features]
        marked = [each for each in facts if each.get("junction") or each.get("is_junction")]
        assert [each["node"] for each in marked] == [one["node"]]


def test_a_plain_walk_has_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "walk.topo"
    map_of_walks(walk_along(EAST_WEST)).save(path)
    assert main(["info", str(path)]) == 0
    assert ["junctions", "none"] in [row.split() for row in capsys.readouterr().out.splitlines()]


def test_documents_of_the_viewer_hold_junctions(crossing: Path, tmp_path: Path):
    with TopoMetricMap.load(crossing) as topomap:
        (one,) = create_document(topomap, "crossing")["junctions"]
    Atlas.create(str(tmp_path / "campus"), [str(shutil.copy(crossing, tmp_path / "yard.topo"))])
    atlas = Atlas.open(str(tmp_path / "campus"))
    (world,) = SharedWorld.group(atlas.manifest)
    assert create_world_document(atlas, world, "campus")["junctions"] == [one | {"tile": "yard"}]
