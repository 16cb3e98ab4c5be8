"""Damaged recordings of all formats of text and images, and damaged images."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np

from topoloc.recordings.exif import exif_focal_length
from topoloc.recordings.image_io import image_size, read_depth, read_image
from topoloc.recordings.open import open_sequence

from .damage import damage_file
from .harness import Read

NUM_FRAMES = 3
K = "40 0 16 0 0 40 12 0 0 0 1 0"
POSES = [np.column_stack([np.eye(3), [0.1 * k, 0.0, 0.02 * k]]) for k in range(NUM_FRAMES)]
SENSOR = """T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
resolution: [32, 24]
camera_model: pinhole
intrinsics: [40.0, 40.0, 16.0, 12.0]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.02, 0.001, -0.002]
"""


class Images:
    """Images of every type."""

    def make(self, folder: Path) -> None:
        """Write small images."""
        colour, deep = _pixels()
        for suffix in ("png", "jpg", "bmp", "ppm", "pgm", "tiff", "webp"):
            pixels = colour if suffix != "pgm" else colour[:, :, 0]
            cv2.imwrite(str(folder / f"colour.{suffix}"), pixels)
        for suffix in ("png", "tiff", "pgm"):
            cv2.imwrite(str(folder / f"deep.{suffix}"), deep)
        cv2.imwrite(str(folder / "alpha.png"), np.dstack([colour, colour[:, :, 0]]))
        (folder / "plain.pgm").write_text("P2 4 2 255\n" + " ".join(map(str, range(8))))
        exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0\0\0\0\0"
        exif += b"\x01\0\x05\xa4\x03\0\x01\0\0\0\x1c\0\0\0\0\0\0\0"
        jpeg = (folder / "colour.jpg").read_bytes()
        segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
        (folder / "exif.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])

    def check(self, whole: Path) -> None:
        """Read all images."""
        for path in whole.iterdir():
            _read_image(path)

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """One image is damaged."""
        names = sorted(one.name for one in whole.iterdir())
        path = Path(shutil.copy(whole / names[rng.integers(len(names))], folder))
        damage_file(path, rng)
        return "image", lambda: _read_image(path)


class Recordings:
    """A small recording of each format."""

    def make(self, folder: Path) -> None:
        """Write one folder for each format."""
        _recordings(folder, *_pixels())

    def check(self, whole: Path) -> None:
        """Read all recordings."""
        for path in whole.iterdir():
            _read_recording(path)

    def damage(self, whole: Path, folder: Path, rng: np.random.Generator) -> tuple[str, Read]:
        """One file of one recording is damaged, three times in four a text."""
        names = sorted(one.name for one in whole.iterdir())
        copy = folder / names[rng.integers(len(names))]
        shutil.copytree(whole / copy.name, copy)
        files = sorted(path for path in copy.rglob("*") if path.is_file())
        texts = [one for one in files if one.suffix in (".txt", ".json", ".tum", ".csv", ".yaml")]
        among = texts if texts and rng.random() < 0.75 else files
        damage_file(among[rng.integers(len(among))], rng)
        return f"recording, {copy.name}", lambda: _read_recording(copy)


def _pixels() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    colour = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    return colour, rng.integers(0, 65536, (24, 32), dtype=np.uint16)


def _read_image(path: Path) -> None:
    width, height = image_size(path)
    exif_focal_length(path, width, height)
    (read_depth if path.name.startswith("deep") else lambda path, _: read_image(path))(path, 1000.0)


def _read_recording(path: Path) -> None:
    sequence = open_sequence(path)
    for k in range(min(len(sequence), 5)):
        _ = sequence[k]


def _recordings(whole: Path, colour: np.ndarray, deep: np.ndarray) -> None:
    stamps = [f"{k}.5" for k in range(NUM_FRAMES)]
    tum = "\n".join(
        f"{stamp} {pose[0, 3]} 0 {pose[2, 3]} 0 0 0 1"
        for stamp, pose in zip(stamps, POSES, strict=True)
    )
    kitti = "\n".join(" ".join(map(str, pose.ravel())) for pose in POSES)
    camera = {
        "model": "PINHOLE",
        "width": 32,
        "height": 24,
        "fx": 40.0,
        "fy": 40.0,
        "cx": 16.0,
        "cy": 12.0,
        "baseline": 0.1,
    }
    texts = {
        "folder/camera.json": json.dumps(camera),
        "folder/times.txt": "\n".join(stamps),
        "folder/truth.tum": tum,
        "kitti/calib.txt": f"P0: {K}\nP1: {K.replace('16 0 0', '16 -4 0')}",
        "kitti/times.txt": "\n".join(stamps),
        "kitti/poses.txt": kitti,
        "tum/rgb.txt": "\n".join(f"{stamp} rgb/{k}.png" for k, stamp in enumerate(stamps)),
        "tum/depth.txt": "\n".join(f"{stamp} depth/{k}.png" for k, stamp in enumerate(stamps)),
        "tum/groundtruth.txt": tum,
        "tum/camera.json": json.dumps(
            {key: camera[key] for key in camera if key != "baseline"} | {"depth_factor": 5000.0}
        ),
        "nerfstudio/transforms.json": json.dumps(
            {"fl_x": 40.0, "fl_y": 40.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24, "k1": 0.1}
            | {
                "frames": [
                    {
                        "file_path": f"images/{k}.png",
                        "transform_matrix": [*p.tolist(), [0, 0, 0, 1]],
                    }
                    for k, p in enumerate(POSES)
                ]
            }
        ),
        "colmap/sparse/0/cameras.txt": "1 OPENCV 32 24 40 40 16 12 0.1 0 0 0",
        "colmap/sparse/0/images.txt": "\n".join(
            f"{k + 1} 1 0 0 0 {0.1 * k} 0 0 1 {k}.png\n" for k in range(NUM_FRAMES)
        ),
        "colmap/sparse/0/points3D.txt": "1 0 0 5 1 2 3 0.5",
        "euroc/mav0/state_groundtruth_estimate0/data.csv": "\n".join(
            f"{50_000_000 * k},{0.1 * k},0,0,1,0,0,0" for k in range(NUM_FRAMES)
        ),
    }
    for number in range(2):
        texts[f"euroc/mav0/cam{number}/sensor.yaml"] = SENSOR.format(x=0.1 * number)
        texts[f"euroc/mav0/cam{number}/data.csv"] = "\n".join(
            f"{50_000_000 * k},{k}.png" for k in range(NUM_FRAMES)
        )
    for k in range(NUM_FRAMES):
        pose = np.vstack([POSES[k], [0, 0, 0, 1]])
        texts[f"seven_scenes/frame-{k:06d}.pose.txt"] = "\n".join(
            " ".join(map(str, row)) for row in pose
        )
        for name in (
            "folder/left/{}.png",
            "folder/right/{}.png",
            "kitti/image_0/{:06d}.png",
            "kitti/image_1/{:06d}.png",
            "tum/rgb/{}.png",
        ):
            _write(whole / name.format(k), colour)
        for name in (
            "nerfstudio/images/{}.png",
            "colmap/images/{}.png",
            "euroc/mav0/cam0/data/{}.png",
            "euroc/mav0/cam1/data/{}.png",
        ):
            _write(whole / name.format(k), colour)
        _write(whole / f"tum/depth/{k}.png", deep)
        _write(
            whole / f"seven_scenes/frame-{k:06d}.color.png", np.zeros((480, 640, 3), np.uint8)
        )  # its camera is built in
        _write(
            whole / f"seven_scenes/frame-{k:06d}.depth.png", np.full((480, 640), 1000, np.uint16)
        )
    for name, text in texts.items():
        (whole / name).parent.mkdir(parents=True, exist_ok=True)
        (whole / name).write_text(text)


def _write(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)
