"""Check that maps of older schemas open, give the same results, and are saved in the
current schema."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from schema_1 import write_schema_1
from schema_2 import write_schema_2

from built_corridor import WIDE, built_corridor, seen_ahead
from topoloc.errors import MapError
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.storage.entries import Session
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap


def answers(topomap: TopoMetricMap) -> list[tuple[bytes, int]]:
    results = [Localizer(topomap).localize(picture, WIDE) for picture, _ in seen_ahead()]
    assert all(isinstance(result, Localization) for result in results)
    return [
        (result.world_from_cam.matrix().tobytes(), result.node_id)
        for result in results
        if isinstance(result, Localization)
    ]


def test_schema_1_answers_the_same_bytes_and_is_saved_as_schema_3(tmp_path: Path):
    built_corridor().save(tmp_path / "new.topo")
    old = TopoMetricMap.load(write_schema_1(built_corridor(), tmp_path / "old.topo"))
    new = TopoMetricMap.load(tmp_path / "new.topo")
    before = answers(new)
    assert answers(old) == before
    assert list(old.sessions) == [Session(0, "walk")]
    assert old.sides is not None
    assert new.sides is not None
    assert [summary.of_node for summary in old.sides.summaries] == [
        summary.of_node for summary in new.sides.summaries
    ]
    assert find_map_damage(tmp_path / "old.topo") == []
    old.save(tmp_path / "saved.topo")
    saved = TopoMetricMap.load(tmp_path / "saved.topo")
    assert answers(saved) == before
    saved.save(tmp_path / "again.topo")
    assert (tmp_path / "again.topo").read_bytes() == (tmp_path / "saved.topo").read_bytes()
    assert find_map_damage(tmp_path / "saved.topo") == []


def test_schema_2_answers_the_same_bytes_and_is_saved_as_schema_3(tmp_path: Path):
    built_corridor().save(tmp_path / "new.topo")
    path = write_schema_2(built_corridor(), tmp_path / "old.topo")
    assert find_map_damage(path) == []
    old, new = TopoMetricMap.load(path), TopoMetricMap.load(tmp_path / "new.topo")
    assert old.file is not None
    assert old.file.version == 2
    assert answers(old) == answers(new)
    old.save(tmp_path / "saved.topo")
    assert (tmp_path / "saved.topo").read_bytes() == (tmp_path / "new.topo").read_bytes()
    assert path.stat().st_size > 1.2 * (tmp_path / "new.topo").stat().st_size


@pytest.mark.slow
def test_schema_1_without_side_tables_is_a_map_without_sides(tmp_path: Path):
    old = TopoMetricMap.load(
        write_schema_1(replace(built_corridor(), sides=None), tmp_path / "old.topo")
    )
    assert old.sides is None
    np.testing.assert_array_equal(
        answers(old), answers(replace(TopoMetricMap.load(tmp_path / "old.topo"), sides=None))
    )


def read_summaries(path: Path) -> None:
    topomap = TopoMetricMap.load(path)
    assert topomap.sides is not None
    list(topomap.summaries), list(topomap.sides.summaries)


@pytest.mark.parametrize(
    "change",
    [
        "CREATE VIEW extra AS SELECT 1",
        "DROP TABLE side_coarse_models",
        "UPDATE map SET value = '{}' WHERE key = 'config'",
        """UPDATE map SET value = replace(value, '"vlad"', '"vlat"') WHERE key = 'config'""",
        "UPDATE nodes SET num_points = -1",
        "UPDATE side_nodes SET recording = 'elsewhere'",
    ],
)
def test_damage_in_schema_1_is_a_map_error_of_one_line(tmp_path: Path, change: str):
    path = write_schema_1(built_corridor(), tmp_path / "old.topo")
    with sqlite3.connect(path) as database:
        database.executescript(change)
    with pytest.raises(MapError, match=r"old\.topo is damaged") as caught:
        read_summaries(path)
    assert "\n" not in str(caught.value)
