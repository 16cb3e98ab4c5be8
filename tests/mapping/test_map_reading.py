"""Test an open map file: it is read entry by entry, and damage inside it is one line."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc.errors import MapError
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.coarse import open_coarse_localizer


def read_all(path: Path) -> None:
    topomap = TopoMetricMap.load(path)
    list(topomap.summaries), list(topomap.nodes), list(topomap.place_images)
    for name in topomap.first_layer.coarse_models:
        open_coarse_localizer(topomap.first_layer.coarse_models[name])


def test_entries_are_counted_and_sliced_as_in_a_list(saved: Path):
    topomap = TopoMetricMap.load(saved)
    count = len(topomap.place_images)
    assert topomap.place_images[-1].name == topomap.place_images[count - 1].name
    assert [image.name for image in topomap.place_images[1:3]] == [
        topomap.place_images[k].name for k in (1, 2)
    ]
    with pytest.raises(IndexError):
        topomap.nodes[len(topomap.nodes)]
    with pytest.raises(KeyError):
        topomap.first_layer.coarse_models["cnn-fc"]


def test_a_loaded_map_can_be_saved_again_also_over_itself(saved: Path):
    before = saved.read_bytes()
    TopoMetricMap.load(saved).save(saved)
    assert saved.read_bytes() == before
    read_all(saved)


QUERIES_OF_OPENING = """
import sqlite3, sys
from topoloc.mapping.storage import map_file
from topoloc.mapping.topomap import TopoMetricMap
connect, asked = sqlite3.connect, []
def traced(*args, **kwargs):
    database = connect(*args, **kwargs)
    database.set_trace_callback(asked.append)
    return database
map_file.sqlite3.connect = traced
topomap = TopoMetricMap.load(sys.argv[1])
print(asked)
len(topomap.summaries), topomap.nodes[0]
print(asked)
"""


def test_opening_reads_no_node(saved: Path):
    """It runs in another process, because the shape checks of the tests read the
    entries of a map."""
    answer = subprocess.run(
        [sys.executable, "-c", QUERIES_OF_OPENING, str(saved)],
        capture_output=True,
        text=True,
        check=True,
    )
    opening, later = answer.stdout.splitlines()
    assert "FROM map" in opening
    assert "FROM nodes" not in opening
    assert "node_points" not in opening
    assert "place_images" not in opening
    assert later.count("checksum FROM node_points WHERE") == 1


def test_a_map_without_measured_error_share_returns_none(tiny_map: TopoMetricMap, tmp_path: Path):
    tiny_map.with_first_layer(shared_errors=None).save(tmp_path / "older.topo")
    assert TopoMetricMap.load(tmp_path / "older.topo").first_layer.shared_errors is None


SPOILT = {
    "half a blob": "UPDATE node_points SET points_cam = substr(points_cam, 1, 100)",
    "a blob of odd length": "UPDATE node_points SET sqrt_covs = sqrt_covs || x'00'",
    "a pose of no length": "UPDATE nodes SET world_from_cam = x''",
    "a pose that is not finite": (
        "UPDATE nodes SET world_from_cam = zeroblob(88) || x'000000000000f87f'"
    ),
    "a camera that is none": (
        'UPDATE cameras SET json = \'{"model": "PINHOLE"}\' WHERE camera_id = 1'
    ),
    "a camera that is no JSON": "UPDATE cameras SET json = '{' WHERE camera_id = 1",
    "no node points": "DELETE FROM node_points",
    "no configuration": "DELETE FROM map",
    "a configuration that is no JSON": "UPDATE map SET value = 'x'",
    "shared errors that are no number": (
        'UPDATE map SET value = \'{"rho": "much", "digest": ""}\' WHERE key = \'shared_errors\''
    ),
    "shared errors below zero": (
        'UPDATE map SET value = \'{"rho": -1, "digest": ""}\' WHERE key = \'shared_errors\''
    ),
    "a coarse model cut off": "UPDATE coarse_models SET arrays = substr(arrays, 1, 1000)",
    "a coarse model of nothing": "UPDATE coarse_models SET arrays = x''",
    "a gap in the images": "UPDATE place_images SET image_id = image_id + 100",
    "no table": "DROP TABLE edges",
}


@pytest.mark.parametrize("change", SPOILT.values(), ids=SPOILT.keys())
def test_damage_inside_is_a_map_error_of_one_line(saved: Path, change: str):
    database = sqlite3.connect(saved)
    database.executescript(change)
    database.close()
    with pytest.raises(MapError, match=r"room\.topo is damaged") as caught:
        read_all(saved)
    assert "\n" not in str(caught.value)


def test_overwritten_pages_are_a_map_error_or_do_no_harm(saved: Path):
    """A structure that SQLite finds broken, at any depth, must not raise another exception."""
    size, rng, found = saved.stat().st_size, np.random.default_rng(0), 0
    content = saved.read_bytes()
    for page in range(1, size // 16384):
        saved.write_bytes(content[: page * 16384] + rng.bytes(16) + content[page * 16384 + 16 :])
        try:
            read_all(saved)
        except MapError:
            found += 1
    assert found > 5


def test_unknown_coarse_models_are_named(saved: Path):
    topomap = TopoMetricMap.load(saved)
    model = replace(topomap.first_layer.coarse_models["surf-vlad"], name="cnn-xy")
    with pytest.raises(MapError, match="'cnn-xy' is not known"):
        open_coarse_localizer(model)


def test_damaged_text_that_an_error_of_sqlite_quotes_is_damage(saved: Path):
    whole = saved.read_bytes()
    at = whole.index(b"CREATE TABLE")
    saved.write_bytes(whole[: at + 8] + b"\xc6" + whole[at + 9 :])
    with pytest.raises(MapError, match="is damaged"):
        TopoMetricMap.load(saved)
