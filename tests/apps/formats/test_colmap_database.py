"""Test a COLMAP database, written by pycolmap, as a recording of single images without poses."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from tiny_recordings import HEIGHT, WIDTH, picture, write
from topoloc.errors import CalibrationError, RecordingError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import find_format, open_sequence

pycolmap = pytest.importorskip("pycolmap", reason="the extra colmap is not installed")
OPENCV = ("OPENCV", [40.0, 41.0, 16.0, 12.0, 0.1, 0.0, 0.0, 0.0])
Make = Callable[..., Path]


@pytest.fixture
def database(tmp_path: Path) -> Make:
    """Return a function that writes database.db and images/. Image k uses camera k,
    or the last one."""

    def make(
        names: tuple[str, ...] = ("10.png", "9.5.png", "11.png"), cameras: tuple = (OPENCV,)
    ) -> Path:
        root = tmp_path / "scene"
        root.mkdir()
        with pycolmap.Database.open(root / "database.db") as written:
            ids = [
                written.write_camera(
                    pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
                )
                for model, params in cameras
            ]
            for number, name in enumerate(names):
                write(root / "images" / name, picture(number))
                written.write_image(
                    pycolmap.Image(name=name, camera_id=ids[min(number, len(ids) - 1)])
                )
        return root

    return make


def test_pictures_and_cameras_come_without_poses(database: Make):
    root = database()
    assert find_format(root) == "colmap_database"
    for path in (root, root / "database.db"):
        sequence = open_sequence(path)
        assert list(sequence.names) == ["9.5.png", "10.png", "11.png"]
        assert list(sequence.t_ns) == [9_500_000_000, 10_000_000_000, 11_000_000_000]
        assert list(sequence.poses) == [None] * 3
        frame = sequence[0]
        assert frame.camera == Camera(
            "OPENCV", WIDTH, HEIGHT, (40.0, 41.0, 15.5, 11.5, 0.1, 0.0, 0.0, 0.0)
        )
        np.testing.assert_array_equal(frame.image, picture(1))


def test_each_picture_has_its_own_camera(database: Make):
    sequence = open_sequence(database(cameras=(OPENCV, ("PINHOLE", [50.0, 51.0, 15.0, 11.0]))))
    cameras = [sequence[k].camera for k in range(3)]
    assert [camera.fx for camera in cameras if camera is not None] == [50.0, 40.0, 50.0]


def test_a_model_beside_it_counts(database: Make, tmp_path: Path):
    root = database()
    (root / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (root / "sparse" / "0" / f"{name}.txt").touch()
    assert find_format(root) == "colmap"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("UPDATE images SET name = '/etc/passwd' WHERE name = '10.png'", "passwd"),
        ("UPDATE images SET camera_id = 77", "the camera of 9.5.png is missing"),
        ("UPDATE cameras SET params = x'00'", "an invalid camera"),
        ("UPDATE cameras SET model = 99", "camera 1: unknown camera model 'number 99'"),
        ("UPDATE cameras SET width = 'wide'", "an invalid camera"),
        ("DELETE FROM images", "no image in this database"),
        ("DROP TABLE cameras", "no database of COLMAP, or damaged"),
    ],
)
def test_faults_are_one_line(database: Make, change: str, said: str):
    root = database()
    with closing(sqlite3.connect(root / "database.db")) as opened:
        opened.executescript(f"PRAGMA foreign_keys = OFF; {change};")
    with pytest.raises((RecordingError, CalibrationError)) as raised:
        open_sequence(root)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_database_without_images_is_refused(database: Make):
    root = database()
    (root / "images").rename(root / "elsewhere")
    with pytest.raises(RecordingError, match="--images"):
        open_sequence(root)
    assert len(open_sequence(root, images=root / "elsewhere")) == 3


def test_mutated_databases_are_read_or_refused(database: Make):
    root, rng = database(), np.random.default_rng(0)
    whole = (root / "database.db").read_bytes()
    for _ in range(150):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), rng.integers(1, 40)):
            data[at] = rng.integers(0, 256)
        (root / "database.db").write_bytes(
            bytes(data[: rng.integers(100, len(data) + 1)] if rng.random() < 0.3 else data)
        )
        with suppress(TopolocError):
            open_sequence(root)
