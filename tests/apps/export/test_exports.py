"""Check each export format with the program that reads it."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image as Pillow

from topoloc.apps.cli import main
from topoloc.apps.export.formats import to_ply
from topoloc.apps.export.foxglove import to_mcap
from topoloc.apps.viewer.map_scene import create_map_scene
from topoloc.apps.viewer.scene import Points, Scene
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap

PLACE = "48.2,16.37,170,30"
READ_COLMAP = """
import json, sys
import pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
model.update_point_3d_errors()
images = {}
for image in model.images.values():
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    observed = [k for k, point in enumerate(image.points2D) if point.has_point3D()]
    off = [float(((image.project_point(model.points3D[image.points2D[k].point3D_id].xyz) - image.points2D[k].xy) ** 2).sum() ** 0.5)
           for k in observed]
    images[image.name] = {"centre": image.projection_center().tolist(), "errors": off, "rotation": pose.rotation.matrix().tolist()}
rgb = [point.color.tolist() for point in model.points3D.values()]
tracks = [point.track.length() for point in model.points3D.values()]
print(json.dumps({"images": images, "rgb": rgb, "tracks": tracks, "num_rigs": model.num_rigs(), "num_frames": model.num_frames(),
                  "error": model.compute_mean_reprojection_error(), "camera": [c.params.tolist() for c in model.cameras.values()]}))
"""  # noqa: E501


@pytest.fixture(scope="module")
def placed_map(room_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the room's map with a place on earth."""
    path = Path(shutil.copy(room_map, tmp_path_factory.mktemp("placed") / "room.topo"))
    assert main(["georeference", str(path), "--origin", PLACE]) == 0
    return path


@pytest.fixture(scope="module")
def results(placed_map: Path, queries: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the results of the queries and one refusal."""
    path = tmp_path_factory.mktemp("results") / "results.jsonl"
    assert main(["localize", str(placed_map), str(queries), "--json", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def scene(placed_map: Path) -> Scene:
    with TopoMetricMap.load(placed_map) as topomap:
        return create_map_scene(topomap, "room")


def export(source: Path, out: Path, *options: str) -> Path:
    assert main(["export", str(source), str(out), *options]) == 0
    return out


def colmap_of(folder: Path) -> dict:
    """Return the model as pycolmap reads it. It runs in its own process, because it
    conflicts with OpenCV."""
    done = subprocess.run(
        [sys.executable, "-c", READ_COLMAP, str(folder)],
        capture_output=True,
        text=True,
        env=os.environ,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_pycolmap_reads_the_model_and_its_tracks_fit(room_map: Path, scene: Scene, tmp_path: Path):
    model = colmap_of(export(room_map, tmp_path / "model"))
    assert (model["num_rigs"], model["num_frames"]) == (1, len(scene.views))
    for view in scene.views:
        image = model["images"][view.name]
        np.testing.assert_allclose(image["centre"], view.world_from_cam.translation, atol=1e-9)
        np.testing.assert_allclose(
            image["rotation"], view.world_from_cam.inverse().rotation, atol=1e-9
        )
    errors = np.concatenate([image["errors"] for image in model["images"].values()])
    assert errors.mean() < 1.0  # tracks allow 1.5 pixels, in images of 320
    assert errors.max() < 2.0
    assert np.median(errors) < 0.5
    assert np.mean(np.array(model["tracks"]) >= 3) > 0.3
    assert model["error"] == pytest.approx(float(errors.mean()), abs=0.1)
    assert np.ptp(np.array(model["rgb"])) > 50
    assert scene.views[0].camera is not None
    assert model["camera"] == [list(scene.views[0].camera.to_colmap()[3])]


def test_the_binary_form_of_a_colmap_model_is_its_text(room_map: Path, tmp_path: Path):
    whole = export(room_map, tmp_path / "model")
    models = []
    for suffix in (".bin", ".txt"):
        folder = tmp_path / suffix
        folder.mkdir()
        for file in whole.glob(f"*{suffix}"):
            (folder / file.name).write_bytes(file.read_bytes())
        assert len(list(folder.iterdir())) == 5
        models.append(colmap_of(folder))
    binary, text = models
    assert binary["camera"] == text["camera"]
    assert binary["images"].keys() == text["images"].keys()
    for name, image in text["images"].items():
        np.testing.assert_allclose(binary["images"][name]["centre"], image["centre"], atol=1e-12)
    for key in ("rgb", "tracks", "num_rigs", "num_frames", "error"):
        np.testing.assert_allclose(np.ravel(binary[key]), np.ravel(text[key]), atol=1e-5)


def test_pycolmap_reads_results(results: Path, tmp_path: Path):
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    model = colmap_of(export(results, tmp_path / "model"))
    assert set(model["images"]) == {line["query"] for line in lines if line["localized"]}
    for line in lines:
        if line["localized"]:
            np.testing.assert_allclose(
                model["images"][line["query"]]["centre"],
                line["world_from_cam"]["translation"],
                atol=1e-9,
            )


def test_the_lab_of_the_zed_as_a_colmap_model(shared: Path, tmp_path: Path):
    path = tmp_path / "zed.topo"
    sequence = f"{shared}/data/zed_lab/session1@0:16"
    assert main(["build", sequence, str(path), "--features", "surf"]) == 0
    model = colmap_of(export(path, tmp_path / "model"))
    assert model["error"] < 1.0
    assert np.mean(np.array(model["tracks"]) >= 2) > 0.3


def test_nerfstudio_finds_pictures_cameras_and_poses(
    placed_map: Path, scene: Scene, tmp_path: Path
):
    folder = export(placed_map, tmp_path / "nerf", "--format", "nerfstudio")
    transforms = json.loads((folder / "transforms.json").read_text())
    assert transforms["camera_model"] == "OPENCV"
    assert (folder / transforms["ply_file_path"]).is_file()
    for frame, view in zip(transforms["frames"], scene.views, strict=True):
        assert (folder / frame["file_path"]).read_bytes() == view.image
        assert Pillow.open(folder / frame["file_path"]).format == "WEBP"
        assert frame["file_path"].endswith(".webp")
        assert view.image_camera is not None
        assert (frame["w"], frame["h"]) == (view.image_camera.width, view.image_camera.height)
        # a point in front of the camera has negative z in OpenGL's axes, and the right pixel
        seen = np.flatnonzero(view.point_rows >= 0)[:20]
        world = scene.points.world[view.point_rows[seen]]
        gl = (
            np.column_stack([world, np.ones(len(world))])
            @ np.linalg.inv(np.array(frame["transform_matrix"])).T
        )[:, :3]
        assert (gl[:, 2] < 0).all()
        assert view.camera is not None
        pixels = np.column_stack(
            [
                frame["cx"] - frame["fl_x"] * gl[:, 0] / gl[:, 2],
                frame["cy"] + frame["fl_y"] * gl[:, 1] / gl[:, 2],
            ]
        )
        np.testing.assert_allclose(
            pixels * view.camera.width / frame["w"] - 0.5, view.points_img[seen], atol=2.5
        )


def test_trimesh_reads_the_points(placed_map: Path, scene: Scene, tmp_path: Path):
    trimesh = pytest.importorskip("trimesh")
    cloud = trimesh.load(export(placed_map, tmp_path / "room.ply"))
    np.testing.assert_allclose(cloud.vertices, scene.points.world, atol=1e-5)
    np.testing.assert_array_equal(cloud.colors[:, :3], scene.points.rgb)


@pytest.mark.parametrize("offset", [(512345.678, 5412345.678, 345.6), (4.08e6, 1.2e6, 4.73e6)])
def test_points_in_coordinates_of_the_earth_are_exact(scene: Scene, offset: tuple[float, ...]):
    """UTM, ECEF: 32 bits would round to 0.25 m."""
    world = scene.points.world + np.array(offset)
    far = replace(scene, points=replace(scene.points, world=world))
    header, _, body = to_ply(far).partition(b"end_header\n")
    assert header.count(b"property double") == 3
    vertices = np.frombuffer(body, [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    np.testing.assert_array_equal(vertices["xyz"], world)
    np.testing.assert_array_equal(vertices["rgb"], scene.points.rgb)
    reader = make_reader(io.BytesIO(to_mcap(far)), decoder_factories=[DecoderFactory()])
    ((*_, points),) = reader.iter_decoded_messages(["/points"])
    xyz = np.frombuffer(points.data, np.float32).reshape(-1, points.point_stride // 4)[:, :3]
    origin = [getattr(points.pose.position, name) for name in "xyz"]
    np.testing.assert_allclose(xyz + np.array(origin), world, rtol=0.0, atol=1e-5)


def test_positions_of_results_in_coordinates_of_the_earth(scene: Scene):
    pose = Rigid3(np.eye(3), np.array([512345.678, 5412345.678, 345.6]))
    path = replace(scene, points=Points.none(), trajectory=[pose])
    body = to_ply(path).partition(b"end_header\n")[2]
    np.testing.assert_array_equal(np.frombuffer(body[:24], "<f8"), pose.translation)


def test_evo_reads_trajectories(placed_map: Path, results: Path, scene: Scene, tmp_path: Path):
    file_interface = pytest.importorskip(
        "evo.tools.file_interface", reason="evo is of the GPL, so nothing here asks for it"
    )
    tum = file_interface.read_tum_trajectory_file(export(placed_map, tmp_path / "room.tum"))
    np.testing.assert_allclose(
        tum.positions_xyz, [view.world_from_cam.translation for view in scene.views], atol=1e-9
    )
    np.testing.assert_allclose(tum.timestamps, [(view.t_ns or 0) / 1e9 for view in scene.views])
    kitti = file_interface.read_kitti_poses_file(export(placed_map, tmp_path / "room.kitti"))
    np.testing.assert_allclose(
        kitti.poses_se3, [pose.matrix() for pose in scene.trajectory], atol=1e-9
    )
    assert len(kitti.poses_se3) == 14  # all mapping images
    asked = file_interface.read_tum_trajectory_file(export(results, tmp_path / "asked.tum"))
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    np.testing.assert_allclose(
        asked.timestamps, [line["t_ns"] / 1e9 for line in lines if line["localized"]]
    )


def test_geojson_is_valid_and_where_the_map_is(placed_map: Path, results: Path, tmp_path: Path):
    position = {
        "type": "array",
        "prefixItems": [{"minimum": 16.36, "maximum": 16.38}, {"minimum": 48.19, "maximum": 48.21}],
        "minItems": 3,
    }
    coordinates = {
        "Point": position,
        "LineString": {"type": "array", "items": position, "minItems": 2},
    }
    for source in (placed_map, results):
        data = json.loads(export(source, tmp_path / f"{source.stem}.geojson").read_text())
        assert data["type"] == "FeatureCollection"
        kinds = Counter(feature["geometry"]["type"] for feature in data["features"])
        assert kinds["LineString"] == 1
        assert kinds["Point"] > 3
        for feature in data["features"]:
            assert set(feature) == {"type", "geometry", "properties"}
            Draft202012Validator(coordinates[feature["geometry"]["type"]]).validate(
                feature["geometry"]["coordinates"]
            )


def test_mcap_holds_foxgloves_schemas(placed_map: Path, scene: Scene, tmp_path: Path):
    data = export(placed_map, tmp_path / "room.mcap").read_bytes()
    reader = make_reader(io.BytesIO(data), decoder_factories=[DecoderFactory()])
    found = list(reader.iter_decoded_messages())
    schemas = {channel.topic: schema.name for schema, channel, _, _ in found if schema is not None}
    assert schemas == {
        "/path": "foxglove.PosesInFrame",
        "/points": "foxglove.PointCloud",
        "/camera": "foxglove.PoseInFrame",
        "/tf": "foxglove.FrameTransform",
        "/camera/calibration": "foxglove.CameraCalibration",
        "/camera/image": "foxglove.CompressedImage",
        "/camera/fix": "foxglove.LocationFix",
    }
    poses = [decoded for _, channel, _, decoded in found if channel.topic == "/camera"]
    for pose, view in zip(poses, scene.views, strict=True):
        assert pose.frame_id == "map"
        assert pose.timestamp.seconds * 10**9 + pose.timestamp.nanos == view.t_ns
        np.testing.assert_allclose(
            [pose.pose.position.x, pose.pose.position.y, pose.pose.position.z],
            view.world_from_cam.translation,
        )
    (cloud,) = [decoded for _, channel, _, decoded in found if channel.topic == "/points"]
    assert len(cloud.data) == cloud.point_stride * len(scene.points.world)
    fixes = [decoded for _, channel, _, decoded in found if channel.topic == "/camera/fix"]
    assert scene.views[0].geopose is not None
    assert fixes[0].latitude == scene.views[0].geopose.position.lat
