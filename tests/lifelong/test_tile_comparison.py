"""Test `topoloc atlas join`: overlapping tiles get one world, and tiles of two places do not,
however similar."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tiny_world import CAMERA, Panel, path_pose, render, room, write_stereo_recording
from topoloc.apps.cli import main
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.editing import add_joins, add_tiles, create_atlas, new_tiles, remove_tiles
from topoloc.atlas.joint_worlds import sigmas_at
from topoloc.atlas.location_prior import WorldPositionPrior, tiles_in_reach
from topoloc.atlas.manifest import Manifest
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.geodesy import GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.tiles.tile_comparison import (
    NotJoined,
    compare_tiles,
    estimate_by_shared_images,
)
from topoloc.lifelong.tiles.tile_joining import TileJoiningResult, find_candidate_pairs, join_tiles
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import SequenceView
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import with_poses

# each part of the walk in a world of its own: own_from_room
WORLDS = {
    "left": Rigid3.identity(),
    "middle": Rigid3(exp_so3(np.array([0.1, 0.4, -0.8])), np.array([-4.0, 7.0, 1.0])),
    "right": Rigid3(exp_so3(np.array([-0.3, 0.1, 2.0])), np.array([20.0, -3.0, 0.5])),
}
PARTS = {"left": range(9), "middle": range(4, 13), "right": range(6, 15)}
FEW = partial(compare_tiles, num_probed=4, max_queries=6, min_near=8)


def _map_of(
    folder: Path, indices: list[float], own_from_room: Rigid3, panels: list[Panel] | None = None
) -> Path:
    sequence = open_sequence(write_stereo_recording(folder, indices=indices, panels=panels))
    poses = [own_from_room @ pose for pose in sequence.poses if pose is not None]
    _built(with_poses(sequence, poses)).save(folder.with_suffix(".topo"))
    return folder.with_suffix(".topo")


def _built(sequence: SequenceView) -> TopoMetricMap:
    return build_map(sequence, BuildConfig(other_kinds=()), are_poses_checked=False)


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return maps of three overlapping parts of one walk."""
    folder = tmp_path_factory.mktemp("parts")
    return {
        name: _map_of(folder / name, [float(k) for k in PARTS[name]], WORLDS[name])
        for name in PARTS
    }


@pytest.fixture(scope="module", autouse=True)
def few_nodes() -> Iterator[None]:
    """Lower the number of nodes that a join needs, because these tiles have fewer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("topoloc.lifelong.tiles.tile_joining.compare_tiles", FEW)
        yield


@pytest.fixture(scope="module")
def joined_once(
    parts: dict[str, Path], other_room: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, TileJoiningResult]:
    """Return an atlas of the three parts, joined, and of another room. Read-only."""
    where = tmp_path_factory.mktemp("atlas") / "campus"
    create_atlas(str(where), new_tiles([*map(str, parts.values()), str(other_room)]))
    return where, join_tiles(str(where))


@pytest.fixture
def joined_atlas(joined_once: tuple[Path, TileJoiningResult]) -> tuple[Path, Manifest]:
    return joined_once[0], joined_once[1].manifest


@pytest.fixture(scope="module")
def other_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map of a room with the same plan, side wall and floor, in which all else differs."""
    panels = [
        own if k in (1, 2) else other
        for k, (own, other) in enumerate(zip(room(), room(9), strict=True))
    ]
    return _map_of(
        tmp_path_factory.mktemp("other") / "other",
        [float(k) for k in range(5)],
        Rigid3.identity(),
        panels,
    )


@pytest.fixture
def own(joined_atlas: tuple[Path, Manifest], tmp_path: Path) -> Path:
    """Return a copy of the atlas that a test may change."""
    return Path(shutil.copytree(joined_atlas[0], tmp_path / "campus"))


def test_parts_of_one_walk_become_one_world(joined_atlas: tuple[Path, Manifest]):
    manifest = joined_atlas[1]
    assert {tile.tile_id for tile in manifest.tiles if tile.joint is not None} == set(PARTS)
    left = manifest.by_id["left"]
    for name in ("middle", "right"):
        tile = manifest.by_id[name]
        assert tile.joint is not None
        assert tile.joint.joint == "left"
        true = WORLDS["left"] @ WORLDS[name].inverse()
        pose = path_pose(8.0)
        assert (
            translation_error(
                true @ WORLDS[name] @ pose, tile.joint.joint_from_world @ WORLDS[name] @ pose
            )
            < 0.01
        )
        assert np.degrees(rotation_error(true, tile.joint.joint_from_world)) < 0.3
        found = left.from_world_of(tile)
        assert found is not None
        assert np.allclose(found.matrix(), tile.joint.joint_from_world.matrix())


def test_each_join_is_as_exact_as_it_states(joined_atlas: tuple[Path, Manifest]):
    manifest = joined_atlas[1]
    assert [join.pair for join in manifest.joins] == [
        ("left", "middle"),
        ("left", "right"),
        ("middle", "right"),
    ]
    for join in manifest.joins:
        true = WORLDS[join.first] @ WORLDS[join.second].inverse()
        at = WORLDS[join.second] @ path_pose(8.0)
        metres, radians = sigmas_at((true @ at).translation, join.covariance)
        assert translation_error(true @ at, join.first_from_second @ at) < 4.0 * metres
        assert metres < 0.05
        assert radians < np.radians(2.0)
        assert join.residual is not None
        assert join.residual < 4.0


def test_a_room_of_the_same_plan_is_not_joined(joined_once: tuple[Path, TileJoiningResult]):
    """Its side wall and floor are equal, so that images of one room are recognised in the other
    with agreeing poses."""
    where, neighbours = joined_once
    assert neighbours.manifest.by_id["other"].joint is None
    of_other = [one for one in neighbours.pair_results if "other" in (one.first, one.second)]
    assert len(of_other) == 3
    assert all(isinstance(one.found, NotJoined) for one in of_other)
    assert any(
        "answers agree, but" in one.found.reason
        for one in of_other
        if isinstance(one.found, NotJoined)
    )
    pairs = [
        (a.tile_id, b.tile_id) for a, b in find_candidate_pairs(Atlas.open(str(where)), {"left"})
    ]
    assert pairs == [("left", "other")]  # joined tiles are not compared again


def test_poses_agree_through_the_joins_and_have_a_pose_in_the_joint_world(
    joined_atlas: tuple[Path, Manifest],
):
    """In the overlap, both tiles localize the image. Without a join that is ambiguous."""
    where, _ = joined_atlas
    localizer = Localizer(Atlas.open(str(where)))
    for index in (5.5, 6.5, 8.5, 10.5):
        result = localizer.localize(render(room(), path_pose(index), noise_seed=77)[0], CAMERA)
        assert isinstance(result, Localization)
        assert result.provenance.joint_world == "left"
        assert result.provenance.joint_from_cam is not None
        assert translation_error(path_pose(index), result.provenance.joint_from_cam) < 0.03
        assert result.provenance.atlas_from_cam is None
        read = Localization.from_json(result.to_json("view")).provenance
        assert read.joint_world == "left"
        assert read.joint_from_cam is not None


def test_near_a_pose_reaches_tiles_that_are_joined(joined_atlas: tuple[Path, Manifest]):
    reached = tiles_in_reach(joined_atlas[1], WorldPositionPrior("left", path_pose(9.0), 1.0))
    assert reached.keys() == set(PARTS)
    pose = reached["right"]
    assert pose is not None
    assert translation_error(WORLDS["right"] @ path_pose(9.0), pose) < 0.01


def test_one_georeferenced_tile_georeferences_all(
    own: Path, parts: dict[str, Path], tmp_path: Path
):
    """A georeferenced map replaces the middle tile. Its old joins are removed, and new
    ones are found."""
    place, enu_from_room = (
        GeoPoint(50.87, 4.70, 30.0),
        Rigid3(exp_so3(np.array([0.0, 0.0, 0.5])), np.array([3.0, 2.0, 1.0])),
    )
    with TopoMetricMap.load(parts["middle"]) as topomap:
        known = Georeference(place, enu_from_room @ WORLDS["middle"].inverse(), "origin")
        replace(topomap, georeference=known).save(tmp_path / "middle.topo")
    replaced = add_tiles(str(own), new_tiles([str(tmp_path / "middle.topo")]), replaces=True)
    assert [join.pair for join in replaced.joins] == [("left", "right")]
    assert replaced.by_id["left"].atlas_from_world is None
    remove_tiles(str(own), ["other"])
    manifest = join_tiles(str(own), pairs=[("middle", "left"), ("left", "right")]).manifest
    assert [join.pair for join in manifest.joins] == [("left", "middle"), ("left", "right")]
    for name in PARTS:
        tile = manifest.by_id[name]
        assert tile.in_joint_world.joint == "middle"
        assert tile.atlas_from_world is not None
        at = path_pose(8.0)
        assert (
            translation_error(enu_from_room @ at, tile.atlas_from_world @ WORLDS[name] @ at) < 0.02
        )
        assert tile.geo_box is not None
        assert abs(tile.geo_box[0] - 50.87) < 1e-3
    localizer = Localizer(Atlas.open(str(own)))
    result = localizer.localize(render(room(), path_pose(1.5), noise_seed=77)[0], CAMERA)
    assert isinstance(result, Localization)
    assert result.provenance.tile == "left"
    assert result.geopose is not None
    expected = Georeference(place, enu_from_room, "origin").geopose(path_pose(1.5)).position
    assert np.linalg.norm(expected.ecef() - result.geopose.position.ecef()) < 0.05
    gone = remove_tiles(str(own), ["middle"])
    assert gone.by_id["left"].atlas_from_world is None
    assert gone.by_id["left"].geo_box is None


def test_joins_of_a_map_replaced_meanwhile_are_dropped(own: Path, parts: dict[str, Path]):
    before = Atlas.open(str(own)).manifest
    add_tiles(str(own), new_tiles([str(parts["left"])], "middle"), replaces=True)
    after = add_joins(str(own), before.joins, before.by_id)
    assert [join.pair for join in after.joins] == [("left", "right")]
    remove_tiles(str(own), ["right"])
    assert add_joins(str(own), before.joins, before.by_id).joins == ()


def test_tiles_far_apart_on_earth_are_not_compared(parts: dict[str, Path], tmp_path: Path):
    where = tmp_path / "campus"
    for name, lat in (("left", 50.0), ("middle", 50.1)):
        with TopoMetricMap.load(parts[name]) as topomap:
            replace(
                topomap,
                georeference=Georeference(GeoPoint(lat, 4.0, 0.0), Rigid3.identity(), "origin"),
            ).save(tmp_path / f"{name}.topo")
    create_atlas(
        str(where), new_tiles([str(tmp_path / "left.topo"), str(tmp_path / "middle.topo")])
    )
    assert join_tiles(str(where)).pair_results == []


def test_the_command_line(
    own: Path,
    parts: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(
        "topoloc.lifelong.tiles.tile_joining.find_candidate_pairs",
        lambda *of: find_candidate_pairs(*of)[:1],
    )
    remove_tiles(str(own), ["other", "middle"])
    shutil.copy(parts["middle"], tmp_path / "centre.topo")
    assert (
        main(
            [
                "atlas",
                "add",
                str(own),
                str(tmp_path / "centre.topo"),
                "--join",
                "--json",
                "-",
            ]
        )
        == 0
    )
    facts = json.loads(capsys.readouterr().out)
    assert facts["worlds"] == {"centre": ["centre", "left", "right"]}
    joined = [{join["first"], join["second"]} for join in facts["joins"]]
    assert len(joined) == 2
    assert set.union(*joined) == {"centre", "left", "right"}
    assert all(
        0.0 < join["sigma_m"] < 0.05 and 0.0 < join["sigma_deg"] < 2.0 for join in facts["joins"]
    )
    (tried,) = facts["tried"]
    assert tried["joined"]
    assert "centre" in (tried["first"], tried["second"])
    monkeypatch.setattr(
        "topoloc.lifelong.tiles.tile_joining.compare_tiles", partial(FEW, min_near=1000)
    )
    remove_tiles(str(own), ["right", "centre"])
    add_tiles(str(own), new_tiles([str(parts["middle"])]))
    assert main(["atlas", "join", str(own), "middle"]) == 0
    printed = capsys.readouterr()
    assert "nodes stand near one of the other tile" in printed.err
    assert "world" not in printed.out


def test_a_pair_with_a_tile_that_cannot_be_read_is_an_error(
    own: Path, parts: dict[str, Path], capsys: pytest.CaptureFixture[str]
):
    remove_tiles(str(own), ["middle"])
    add_tiles(str(own), new_tiles([str(parts["middle"])]))
    tile = Atlas.open(str(own)).tile("left")
    (own / tile.map.name).write_bytes(b"damaged")
    assert main(["atlas", "join", str(own), "middle"]) == 1
    assert "is not a topoloc map" in capsys.readouterr().err


def test_invalid_arguments_are_one_line(own: Path, complaint: Callable[..., str]):
    assert "has no tile 'attic'" in complaint("atlas", "join", own, "attic")
    assert "--join belongs to create and add" in complaint("atlas", "info", own, "--join", status=2)
    assert "--config belongs to join" in complaint(
        "atlas", "info", own, "--config", "few.toml", status=2
    )


def test_info_names_worlds_and_joins(
    joined_atlas: tuple[Path, Manifest], capsys: pytest.CaptureFixture[str]
):
    assert main(["atlas", "info", str(joined_atlas[0])]) == 0
    printed = capsys.readouterr().out
    assert "world  left: left, middle, right" in printed
    assert "join   left and middle: " in printed


def test_pieces_of_one_recording_are_joined_by_shared_images(
    parts: dict[str, Path], tmp_path: Path
):
    """Each piece has its own world frame. Maps of other images of the walk share no image."""
    recording = open_sequence(
        write_stereo_recording(tmp_path / "walk", indices=[float(k) for k in range(7)])
    )
    maps = list[TopoMetricMap]()
    for rows, own_from_room in ((range(5), WORLDS["left"]), (range(2, 7), WORLDS["middle"])):
        poses = [own_from_room @ path_pose(float(k)) for k in rows]
        maps.append(_built(SequenceView(recording, list(rows), poses)))
    found = estimate_by_shared_images(*maps)
    assert found is not None
    a_from_b, covariance, num_agreeing = found
    assert num_agreeing == 3
    assert np.allclose(a_from_b.matrix(), WORLDS["middle"].inverse().matrix(), atol=1e-6)
    assert sigmas_at(path_pose(6.0).translation, covariance)[0] < 0.02
    with TopoMetricMap.load(parts["left"]) as left, TopoMetricMap.load(parts["middle"]) as middle:
        assert estimate_by_shared_images(left, middle) is None
