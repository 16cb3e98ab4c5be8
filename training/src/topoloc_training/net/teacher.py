"""Compute training images and the teacher's outputs once, and store them in files. The teacher gets
unchanged images."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int8, UInt8

from topoloc.features.network_files import load_onnxruntime
from topoloc.recordings.format import list_images
from topoloc.recordings.frame import to_grey
from topoloc.recordings.image_io import read_image

WIDTH, HEIGHT = 640, 384
STRIDE = 4
_DIMENSION = 64
_UNIT = 127.0


@dataclass(frozen=True, eq=False)
class Lessons:
    """Pictures and the teacher's answers, mapped from files. `pictures[i]` comes from `paths[i]`,
    scaled by `scales[i]`, top rows."""

    paths: list[str]
    scales: Float[np.ndarray, " n"]
    pictures: UInt8[np.ndarray, "n h w"]
    scores: UInt8[np.ndarray, "n h w"]
    descriptors: Int8[np.ndarray, "n 64 h4 w4"]

    def described(
        self, index: int, pixels: Float[np.ndarray, "m 2"]
    ) -> Float32[np.ndarray, "m 64"]:
        """The teacher's unit descriptors at pixels of a picture, bilinearly."""
        place = (pixels + 0.5) / STRIDE - 0.5
        limit = np.array([WIDTH // STRIDE, HEIGHT // STRIDE]) - 1.001
        place = np.clip(place, 0, limit)
        corner = place.astype(int)
        right, down = (place - corner).T.astype(np.float32)
        x, y = corner.T
        maps = self.descriptors[index]
        weights = [(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down]
        corners = [(0, 0), (1, 0), (0, 1), (1, 1)]
        parts = [
            w * maps[:, y + dy, x + dx].astype(np.float32)
            for w, (dx, dy) in zip(weights, corners, strict=True)
        ]
        values = np.sum(parts, axis=0).T
        return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6)


def learn(folders: list[str], teacher: Path, cache: Path) -> Lessons:
    """Read the cache, or run the teacher (an ONNX file of the contract, 64 numbers, stride 4) on
    all images of the folders.

    A folder may end with `::step` to take every `step`-th image.
    """
    key = {"folders": folders, "teacher": teacher.name, "size": [WIDTH, HEIGHT]}
    index_file = cache / "lessons.json"
    if (
        index_file.is_file()
        and (index := json.loads(index_file.read_text(encoding="utf-8")))["key"] == key
    ):
        return _opened(cache, index["paths"], index["scales"], "r")
    paths = [str(path) for folder in folders for path in _listed(folder)]
    cache.mkdir(parents=True, exist_ok=True)
    lessons = _opened(cache, paths, [0.0] * len(paths), "w+")
    onnxruntime = load_onnxruntime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        str(teacher), options, providers=["CPUExecutionProvider"]
    )
    for i, path in enumerate(paths):
        lessons.pictures[i], lessons.scales[i] = _fitted(to_grey(read_image(Path(path))))
        outputs = session.run(
            None, {"image": lessons.pictures[i].astype(np.float32)[None, None] / 255}
        )
        scores, descriptors = (np.asarray(output)[0] for output in outputs)
        descriptors = descriptors / np.linalg.norm(descriptors, axis=0, keepdims=True)
        lessons.scores[i] = np.round(scores[0] * 255)
        lessons.descriptors[i] = np.round(descriptors * _UNIT)
    index_file.write_text(
        json.dumps({"key": key, "paths": paths, "scales": lessons.scales.tolist()}),
        encoding="utf-8",
    )
    return lessons


def _listed(folder: str) -> list[Path]:
    name, _, step = folder.partition("::")
    return list_images(Path(name))[:: int(step or 1)]


def _opened(
    cache: Path, paths: list[str], scales: list[float], mode: Literal["r", "w+"]
) -> Lessons:
    def mapped(name: str, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
        return np.memmap(cache / name, dtype, mode, shape=(len(paths), *shape))

    quarter = (_DIMENSION, HEIGHT // STRIDE, WIDTH // STRIDE)
    return Lessons(
        paths,
        np.array(scales),
        mapped("pictures.u8", np.uint8, (HEIGHT, WIDTH)),
        mapped("scores.u8", np.uint8, (HEIGHT, WIDTH)),
        mapped("descriptors.i8", np.int8, quarter),
    )


def _fitted(picture: UInt8[np.ndarray, "h w"]) -> tuple[UInt8[np.ndarray, "384 640"], float]:
    """Scale an image to the width. Crop rows at the bottom, or mirror them if there are too few."""
    scale = WIDTH / picture.shape[1]
    if scale != 1:
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        picture = cv2.resize(
            picture, (WIDTH, round(picture.shape[0] * scale)), interpolation=interpolation
        )
    missing = max(0, HEIGHT - picture.shape[0])
    return cv2.copyMakeBorder(picture[:HEIGHT], 0, missing, 0, 0, cv2.BORDER_REFLECT_101), scale
