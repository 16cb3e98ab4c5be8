"""Damaged files of settings, calibrations, cameras of queries, and tables of places."""

from __future__ import annotations

import json
import shutil
from functools import cache
from pathlib import Path

import numpy as np

from topoloc.apps.cli.queries.evaluate import read_rigid
from topoloc.apps.cli.settings_file import all_tables, read_settings, settings_text
from topoloc.apps.formats.euroc import read_sensor
from topoloc.apps.georeferencing.georeference import read_control_points, read_gnss
from topoloc.apps.query_camera import parse_camera_option
from topoloc.apps.service.query_request import parse_camera_field
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.calibration import parse_calibration
from topoloc.recordings.image_io import EncodedImage
from topoloc.recordings.trajectory import Trajectory

from .damage import damage_bytes, damage_file, damage_json
from .harness import Read
from .maps import FIXTURES
from .recordings import SENSOR

KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [40.0, 41.0, 15.5, 11.5]
  resolution: [32, 24]
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.002, 3.0e-05, 1.e-05]
  distortion_model: equidistant
  intrinsics: [42.0, 43.0, 14.5, 12.5]
  resolution: [32, 24]
"""
ROS = """image_width: 32
image_height: 24
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [40., 0, 15.5, 0, 41, 11.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.02, 0.001, -0.002, 0]
"""
STEREO = {
    "left": {"model": "OPENCV", "width": 32, "height": 24, "fx": 40.0, "fy": 41.0, "cx": 15.5,
             "cy": 11.5, "k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002},
    "right": {"model": "PINHOLE", "width": 32, "height": 24, "fx": 40.0, "fy": 41.0, "cx": 15.5,
              "cy": 11.5},
    "right_from_left": [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "depth_factor": 5000.0,
}  # fmt: skip
QUERY_CAMERAS = (
    '{"model": "PINHOLE", "width": 480, "height": 320, "fx": 240, "fy": 240, "cx": 239.5,'
    ' "cy": 159.5}',
    '{"model": "OPENCV", "params": [240, 240, 239.5, 159.5, 0.1, 0, 0, 0]}',
    '{"model": "OPENCV_FISHEYE", "width": 480, "height": 320, "params": [240, 240, 239, 159, 0.1,'
    " 0, 0, 0]}",
    "240,240,239.5,159.5",
)
TABLES = {
    "gnss.csv": "name,lat,lon,h\n" + "".join(f"{k}.5,50.87{k},4.70{k},30\n" for k in range(4)),
    "points.csv": "".join(f"{k},0,{k % 2},50.87{k},4.70{k},30\n" for k in range(4)),
    "poses.tum": "".join(f"{k}.5 {k} 0 0 0 0 0 1\n" for k in range(4)),
    "poses.txt": "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(4)),
    "rigid.json": json.dumps({"map_from_truth": np.eye(4).tolist()}),
}


class Settings:
    """Files of `--config`: of this version, and of an earlier one."""

    def make(self, folder: Path) -> None:
        """Write all tables in one file, and one file for each table."""
        for table in all_tables():
            (folder / f"{table}.toml").write_text(settings_text([table]))
        shutil.copy(FIXTURES / "settings.toml", folder / "earlier.toml")

    def check(self, whole: Path) -> None:
        """Read all files."""
        for path in whole.iterdir():
            read_settings(str(path))

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """Damage one file by its bytes."""
        names = sorted(one.name for one in whole.iterdir())
        path = Path(shutil.copy(whole / names[rng.integers(len(names))], folder))
        damage_file(path, rng)

        def read() -> None:
            read_settings(str(path))

        return "settings, TOML", read


class Calibrations:
    """Calibrations in YAML and JSON, trajectories and tables of places."""

    def make(self, folder: Path) -> None:
        """Write one file of each kind."""
        texts = {
            "sensor.yaml": SENSOR.format(x=0.1),
            "kalibr.yaml": KALIBR,
            "ros.yaml": ROS,
            "opencv.yml": "%YAML:1.0\n---\n" + _opencv_matrices(),
            "camera.json": json.dumps(STEREO),
            "single.json": json.dumps(STEREO["left"] | {"baseline": 0.1}),
        }
        for name, text in (texts | TABLES).items():
            (folder / name).write_text(text)

    def check(self, whole: Path) -> None:
        """Read all files."""
        for path in whole.iterdir():
            if path.name != "gnss.csv":  # its times are not of the map
                _read(path)

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """Damage one file."""
        names = sorted(one.name for one in whole.iterdir())
        path = Path(shutil.copy(whole / names[rng.integers(len(names))], folder))
        damage_file(path, rng)
        kind = "table" if path.name in TABLES else "calibration"
        return f"{kind}, {path.suffix[1:]}", lambda: _read(path)


def _opencv_matrices() -> str:
    matrices = {
        "M1": (3, 3, "40., 0., 15.5, 0., 41., 11.5, 0., 0., 1."),
        "D1": (1, 4, "-0.1, 0.02, 0.001, -0.002"),
        "M2": (3, 3, "42., 0., 14.5, 0., 43., 12.5, 0., 0., 1."),
        "D2": (1, 4, "0., 0., 0., 0."),
        "R": (3, 3, "1., 0., 0., 0., 1., 0., 0., 0., 1."),
        "T": (3, 1, "-0.1, 0., 0."),
    }
    return "".join(
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
        f"   data: [ {data} ]\n"
        for name, (rows, cols, data) in matrices.items()
    )


def _read(path: Path) -> None:
    if path.name == "gnss.csv":
        read_gnss(path, _room())
    elif path.name == "points.csv":
        read_control_points(path)
    elif path.name == "rigid.json":
        read_rigid(path)
    elif path.stem == "poses":
        Trajectory.read(path)
    elif path.name == "sensor.yaml":
        read_sensor(path)
    else:
        parse_calibration(path)(32, 24)


@cache
def _room() -> TopoMetricMap:
    return TopoMetricMap.load(FIXTURES / "schema_3.topo")


class QueryCameras:
    """Cameras of queries, as the field of a request and as the option of the command line."""

    def make(self, folder: Path) -> None:
        """Nothing is read but texts."""

    def check(self, whole: Path) -> None:
        """Parse all texts."""
        for text in QUERY_CAMERAS:
            parse_camera_field(text, EncodedImage("q", b""), (480, 320), None)

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """Damage one text by bytes or values."""
        text = QUERY_CAMERAS[rng.integers(len(QUERY_CAMERAS))]
        if text.startswith("{") and rng.random() < 0.7:
            text = damage_json(text, rng)
        else:
            text = damage_bytes(text.encode(), rng).decode("utf-8", "surrogateescape")
        size = (int(rng.integers(1, 5000)), 320) if rng.random() < 0.3 else (480, 320)

        def read() -> None:
            if text.startswith("{"):
                parse_camera_field(text, EncodedImage("q", b""), size, _room())
            else:
                parse_camera_option(text, _room())(*size)

        return "camera of a query", read
