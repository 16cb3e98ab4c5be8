"""Make images that leave the usual path of a query: dark, of a rolling shutter, and others."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from inputs import rolled, through_barrel, zoomed
from topoloc.geometry.camera import Camera
from topoloc.recordings.open import open_sequence

VARIATIONS = (
    "dark",
    "very_dark",
    "bright",
    "rolled",
    "slightly_rolled",
    "zoomed",
    "barrel",
    "swapped",
)


def vary(recording: str, every: int, folder: Path) -> None:
    """Write varied images of each frame in so many as recordings of one camera below a folder."""
    sequence = open_sequence(recording)
    for index in range(0, len(sequence), every):
        frame = sequence[index]
        assert frame.camera is not None
        for name, image, camera in varied(frame.image, frame.camera):
            images = folder / name / "images"
            images.mkdir(parents=True, exist_ok=True)
            (folder / name / "camera.json").write_text(json.dumps(camera.to_json()))
            pixels = image if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
            cv2.imwrite(str(images / f"{index:06d}.png"), pixels)


def varied(image: np.ndarray, camera: Camera) -> Iterator[tuple[str, np.ndarray, Camera]]:
    """Yield names, images and the cameras that are stated for them."""
    yield "dark", _scaled(image, 0.25), camera
    yield "very_dark", _scaled(image, 0.06), camera
    yield "bright", _scaled(image, 2.5), camera
    yield "rolled", rolled(image, camera, 2.0), camera
    yield "slightly_rolled", rolled(image, camera, 0.7), camera
    yield "zoomed", zoomed(image, 1.08), camera
    yield "barrel", *through_barrel(image, camera)
    yield "swapped", np.ascontiguousarray(image[:, :, ::-1]) if image.ndim == 3 else image, camera


def _scaled(image: np.ndarray, factor: float) -> np.ndarray:
    return np.clip(np.round(image * factor), 0, 255).astype(np.uint8)
