"""Test `topoloc prune --descriptors coarse`: the file shrinks, and the same images
are localized."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc import Localizer, TopoMetricMap
from topoloc.apps.cli import main
from topoloc.geometry.alignment import translation_error
from topoloc.lifelong.node_pruning import quantize_node_descriptors
from topoloc.localization.result import Localization
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.storage.point_encoding import compress_array

STEP = 0.64


@pytest.fixture
def path(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "room.topo"))


def _descriptors(path: Path) -> list[np.ndarray]:
    with TopoMetricMap.load(path) as topomap:
        return [
            node.features.descriptors for layer in topomap.layers.values() for node in layer.nodes
        ]


def test_the_file_is_smaller_and_the_same_is_found(path: Path):
    size, before = path.stat().st_size, _descriptors(path)
    assert main(["prune", str(path), "--descriptors", "coarse"]) == 0
    assert path.stat().st_size < 0.9 * size
    assert find_map_damage(path) == []
    for fine, coarse in zip(before, _descriptors(path), strict=True):
        np.testing.assert_allclose(np.linalg.norm(coarse, axis=1), 1.0, atol=1e-5)
        assert np.median(np.sum(fine * coarse, axis=1)) > 0.97
    with TopoMetricMap.load(path) as topomap:
        found = [
            (Localizer(topomap).localize(picture, CAMERA), pose) for picture, pose in unseen_views()
        ]
    assert all(
        isinstance(one, Localization) and translation_error(pose, one.world_from_cam) < 0.02
        for one, pose in found
    )


def test_pruning_again_changes_nothing(path: Path):
    main(["prune", str(path), "--descriptors", "coarse"])
    data = path.read_bytes()
    main(["prune", str(path), "--descriptors", "coarse"])
    main(["prune", str(path)])
    assert path.read_bytes() == data


def test_it_is_undone_to_the_byte(path: Path):
    data = path.read_bytes()
    main(["prune", str(path), "--descriptors", "coarse"])
    assert main(["undo", str(path)]) == 0
    assert path.read_bytes() == data


def test_more_landmarks_fit_into_the_same_bytes(path: Path, tmp_path: Path):
    fine, budget = (
        Path(shutil.copy(path, tmp_path / "fine.topo")),
        f"{0.7 * path.stat().st_size / 1e6:.4f}",
    )
    dropped, said = [], tmp_path / "said.json"
    for one, form in ((fine, "fine"), (path, "coarse")):
        assert (
            main(
                ["prune", str(one), "--max-mb", budget, "--descriptors", form, "--json", str(said)]
            )
            == 0
        )
        assert one.stat().st_size <= float(budget) * 1e6
        dropped.append(json.loads(said.read_text())["landmarks_dropped"])
    assert dropped[1] < 0.6 * dropped[0]


def test_a_node_is_described_in_a_third_of_the_bytes(path: Path):
    with TopoMetricMap.load(path) as topomap:
        node = topomap.nodes[0]
        rounded = quantize_node_descriptors(node, STEP)
    assert node.stored_descriptors is not None
    assert rounded.stored_descriptors is not None
    assert len(compress_array(rounded.stored_descriptors)) < 0.5 * len(
        compress_array(node.stored_descriptors)
    )
    assert quantize_node_descriptors(rounded, STEP) is rounded
