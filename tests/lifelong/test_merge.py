"""Test `topoloc merge`: two maps become one if they overlap, and stay apart otherwise."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tiny_world import CAMERA, path_pose, render, room, write_stereo_recording
from topoloc import Localizer, TopoMetricMap, open_sequence
from topoloc.apps.cli import main
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.session_content import is_well_localized
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.edit import edit_map
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import Layer
from topoloc.recordings.recording import with_poses

OTHER_WORLD = Rigid3(exp_so3(np.array([0.1, 0.4, -0.8])), np.array([-4.0, 7.0, 1.0]))
SECOND = np.arange(4.0, 17.0)


def _map_of(folder: Path, target: Path, moved: Rigid3) -> Path:
    sequence = open_sequence(folder)
    poses = [moved @ pose for pose in sequence.poses if pose is not None]
    build_map(with_poses(sequence, poses), BuildConfig(other_kinds=())).save(target)
    return target


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a map of the room's left part, and one of its right part in another world frame."""
    folder = tmp_path_factory.mktemp("parts")
    left = write_stereo_recording(folder / "left", indices=[float(k) for k in range(7)])
    right = write_stereo_recording(folder / "right", indices=SECOND.tolist())
    return _map_of(left, folder / "left.topo", Rigid3.identity()), _map_of(
        right, folder / "right.topo", OTHER_WORLD
    )


@pytest.mark.skipif(os.name == "nt", reason="no locks")
def test_a_merge_over_a_map_in_edit_waits_with_a_message(
    maps: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = Path(shutil.copy(maps[0], tmp_path / "out.topo"))
    with ThreadPoolExecutor() as pool:
        with edit_map(out) as edit:
            merging = pool.submit(main, ["merge", *map(str, maps), str(out)])
            said = ""
            while "another process edits this map; waiting for it ..." not in said:
                assert not merging.done()
                time.sleep(0.05)
                said += capsys.readouterr().err
            edit.commit(edit.topomap, "the first")
        assert merging.result() == 0
    with TopoMetricMap.load(out) as topomap:
        assert [one.name for one in topomap.edits] == ["build", "merge right.topo"]


def test_two_maps_become_one_in_the_world_of_the_first(
    maps: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    before = [path.read_bytes() for path in maps]
    out, said = tmp_path / "both.topo", tmp_path / "said.json"
    monkeypatch.setattr(
        "topoloc.lifelong.merge.is_well_localized", partial(is_well_localized, min_inliers=250)
    )
    assert main(["merge", *map(str, maps), str(out), "--json", str(said)]) == 0
    assert [path.read_bytes() for path in maps] == before
    facts = json.loads(said.read_text())
    assert facts["agreeing"] >= 5
    assert facts["nodes_added"] > 0
    assert find_map_damage(out) == []
    with TopoMetricMap.load(out) as topomap:
        assert [session.name for session in topomap.sessions] == ["left", "right"]
        added = [summary for summary in topomap.summaries if summary.session_id == 1]
        assert len(added) == facts["nodes_added"]
        for summary in added:
            true = path_pose(SECOND[int(Path(summary.name).stem)])
            assert translation_error(true, summary.world_from_cam) < 0.02
            assert np.degrees(rotation_error(true, summary.world_from_cam)) < 0.5
        assert len({summary.node_id for summary in topomap.summaries}) == len(topomap.summaries)
        localizer = Localizer(topomap)
        for index in (13.5, 15.5):
            result = localizer.localize(render(room(), path_pose(index), noise_seed=77)[0], CAMERA)
            assert isinstance(result, Localization)
            assert translation_error(path_pose(index), result.world_from_cam) < 0.02


def test_maps_of_two_places_stay_apart(
    maps: tuple[Path, Path], tmp_path: Path, complaint: Callable[..., str]
):
    other = _map_of(
        write_stereo_recording(tmp_path / "other", seed=5),
        tmp_path / "other.topo",
        Rigid3.identity(),
    )
    assert "no map is changed" in complaint("merge", maps[0], other, tmp_path / "both.topo")
    assert not (tmp_path / "both.topo").exists()


def test_maps_that_cannot_be_merged_are_named(
    maps: tuple[Path, Path], tmp_path: Path, complaint: Callable[..., str]
):
    first, second = maps
    again = Path(shutil.copy(first, tmp_path / "again.topo"))
    assert "one map in two versions" in complaint("merge", first, again, tmp_path / "both.topo")
    assert "choose another path" in complaint("merge", again, second, again, status=2)
    assert "No such file" in complaint(
        "merge", first, tmp_path / "none.topo", tmp_path / "both.topo"
    )
    with TopoMetricMap.load(first) as topomap:
        layers = {**topomap.layers, "sift": Layer(topomap.nodes)}
        replace(topomap, layers=layers, map_id="0123456789abcdef").save(tmp_path / "two.topo")
    assert "holds no features sift" in complaint(
        "merge", tmp_path / "two.topo", second, tmp_path / "both.topo"
    )


def test_a_nodes_features_are_localized_as_its_picture_is(maps: tuple[Path, Path]):
    with TopoMetricMap.load(maps[0]) as first, TopoMetricMap.load(maps[1]) as second:
        node = second.nodes[0]
        result = Localizer(first).localize_query(
            QueryImage.of_features({second.kind: node.features}, node.camera)
        )[0]
        assert isinstance(result, Localization)
        assert (
            translation_error(
                OTHER_WORLD.inverse() @ node.summary.world_from_cam, result.world_from_cam
            )
            < 0.02
        )
