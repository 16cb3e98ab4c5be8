"""Test `topoloc scale`: the scale of a map is set or corrected, and every length with it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import photographed_room as room
import tiny_world
from topoloc.apps.cli import main
from topoloc.errors import MapError
from topoloc.geometry.geodesy import GeoPoint
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.merge import rescale_map
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.config import MapConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import MemorySequence, StereoFrame
from topoloc.rigs.rig import Rig, RigCamera
from topoloc.rigs.rig_localizer import RigLocalizer

UNIT = 0.5  # metres


def _photo_frame(number: int) -> StereoFrame:
    pose = room.photo_pose(number)
    in_units = Rigid3(pose.rotation, pose.translation / UNIT)
    image, camera = room.photo(number), tiny_world.CAMERA
    return StereoFrame(room.NAMES[number], number * 10**9, image, camera, world_from_cam=in_units)


@pytest.fixture(scope="module")
def in_units(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a map without scale, whose photos are gone."""
    path = tmp_path_factory.mktemp("scale") / "units.topo"
    frames = MemorySequence([_photo_frame(number) for number in range(18)], "photos")
    config = replace(BuildConfig(), features=replace(BuildConfig().features, kind="surf"))
    config = replace(config, other_kinds=(), scale_sigma=None)
    build_map([frames], config, are_poses_checked=False).save(path)
    return path


@pytest.fixture
def target(in_units: Path, tmp_path: Path) -> Path:
    path = tmp_path / "map.topo"
    path.write_bytes(in_units.read_bytes())
    return path


def _answer(path: Path) -> Localization:
    with TopoMetricMap.load(path) as topomap:
        answer = Localizer(topomap).localize(room.photo(5), tiny_world.CAMERA)
    assert isinstance(answer, Localization)
    return answer


def test_all_lengths_are_scaled_and_undo_gives_the_same_bytes(target: Path):
    before, small, config = target.read_bytes(), _answer(target), MapConfig()
    with TopoMetricMap.load(target) as topomap:
        config, length_m = topomap.config, topomap.length_m
        node = topomap.nodes[3]
        sums = [one.roots for one in node.session_statistics]
    rescale_map(target, 2.0, 0.0)
    large = _answer(target)
    assert large.world_from_cam.is_same(
        Rigid3(small.world_from_cam.rotation, 2.0 * small.world_from_cam.translation), 1e-6, 1e-7
    )
    factors = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    scaled = factors[:, None] * small.covariance * factors
    np.testing.assert_allclose(large.covariance, scaled, rtol=1e-4, atol=1e-12)
    assert not small.provenance.has_scale
    assert large.provenance.has_scale

    with TopoMetricMap.load(target) as topomap:
        assert topomap.config.d_thresh == 2.0 * config.d_thresh
        assert topomap.config.lambda_rot == 2.0 * config.lambda_rot
        assert topomap.length_m == pytest.approx(2.0 * length_m)
        other = topomap.nodes[3]
        np.testing.assert_array_equal(other.points_cam, 2.0 * node.points_cam)
        np.testing.assert_array_equal(other.point_sqrt_covs, 2.0 * node.point_sqrt_covs)
        for one, roots in zip(other.session_statistics, sums, strict=True):
            np.testing.assert_allclose(2.0 * one.roots, roots, rtol=2e-3, atol=4e-3)
    assert main(["undo", str(target)]) == 0
    assert target.read_bytes() == before


def test_a_distance_sets_the_scale(target: Path, tmp_path: Path):
    true = f"{room.NAMES[0]},{room.NAMES[8]}={room.distance(0, 8):.3f}m"
    facts = tmp_path / "scale.json"
    assert main(["scale", str(target), "--distance", true, "--json", str(facts)]) == 0
    found = json.loads(facts.read_text())
    assert found["factor"] == pytest.approx(UNIT, rel=2e-3)
    answer = _answer(target)
    np.testing.assert_allclose(
        answer.world_from_cam.translation, room.photo_pose(5).translation, atol=0.02
    )
    with TopoMetricMap.load(target) as topomap:
        assert topomap.config.scale_sigma == found["scale_sigma"] > 0.009


def test_a_tag_in_the_nodes_images_corrects_a_wrong_scale(
    target: Path, capsys: pytest.CaptureFixture[str]
):
    rescale_map(target, 0.7, 0.01)
    assert main(["scale", str(target), "--tag", f"{room.TAG_SIDE:.4f}"]) == 0
    told = capsys.readouterr().out
    assert "tag 7 of APRILTAG_36h11" in told
    assert "metre of before" in told
    position = _answer(target).world_from_cam.translation
    np.testing.assert_allclose(position, room.photo_pose(5).translation, atol=0.03)


def test_a_file_of_gnss_sets_the_scale(target: Path, tmp_path: Path):
    """A place of 30 times the size, so that metres of GNSS say something."""
    origin, lines = GeoPoint(50.1, 8.6, 100.0).ecef_from_enu(), ["name,lat,lon,h"]
    for number, name in enumerate(room.NAMES):
        place = GeoPoint.from_ecef(origin.apply(30.0 * room.photo_pose(number).translation))
        lines.append(f"{name},{place.lat:.9f},{place.lon:.9f},{place.h:.3f}")
    (tmp_path / "places.csv").write_text("\n".join(lines))
    assert main(["scale", str(target), "--gnss", str(tmp_path / "places.csv")]) == 0
    with TopoMetricMap.load(target) as topomap:
        (edit,) = [one for one in topomap.edits if one.name == "scale"]
        sigma = topomap.config.scale_sigma
    assert edit.changes is not None
    assert float(edit.changes["factor"]) == pytest.approx(30.0 * UNIT, rel=0.01)
    assert sigma is not None
    assert 0.01 < sigma < 0.05


def test_photos_are_read_if_they_are_named(target: Path, tmp_path: Path):
    photos = room.write_photos(tmp_path / "photos")
    options = ["--tag", f"{room.TAG_SIDE:.4f}", "--images", str(photos)]
    assert main(["scale", str(target), *options]) == 0
    position = _answer(target).world_from_cam.translation
    np.testing.assert_allclose(position, room.photo_pose(5).translation, atol=0.02)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "--distance IMAGE_A,IMAGE_B=METRES, --tag METRES, or --gnss exif|FILE"),
        (["--gnss", "exif"], "0 places of mapping images give no scale"),
        (["--tag", "-1"], "side of a tag in metres"),
        (["--distance", "3.2"], "IMAGE_A,IMAGE_B=3.2m"),
        (["--distance", "IMG_9999.jpg,IMG_0001.jpg=1"], "0 images are named IMG_9999"),
        (["--distance", f"{room.NAMES[0]},{room.NAMES[8]}=1e6"], "are no metres"),
    ],
)
def test_what_gives_no_scale(
    target: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
):
    before = target.read_bytes()
    assert main(["scale", str(target), *options]) != 0
    assert said in capsys.readouterr().err
    assert target.read_bytes() == before


def test_a_rig_needs_metres(target: Path):
    with TopoMetricMap.load(target) as topomap:
        rig = Rig({"ahead": RigCamera(Rigid3.identity(), tiny_world.CAMERA)})
        with pytest.raises(MapError, match=r"a rig needs metres: set it by `topoloc scale"):
            RigLocalizer(Localizer(topomap), rig)
