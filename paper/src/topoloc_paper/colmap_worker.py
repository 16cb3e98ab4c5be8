"""Run pycolmap for `peer_colmap.py` in a process of its own: ``python -m ... FOLDER``.

The folder holds the images and `job.json`. `answers.json` is written into it. The process loads no
other large library.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

RATIO = 0.8
MIN_POINTS = 4


@dataclass(frozen=True, eq=False)
class MapImage:
    """Hold a triangulated image. Row k of `points_world` is NaN if key point k has no 3-D point."""

    name: str
    descriptors: Float32[np.ndarray, "n d"]
    points_world: Float[np.ndarray, "n 3"]


class Worker:
    """One map and its queries. The database's cameras play no part: those of the job do."""

    def __init__(self, folder: Path) -> None:
        self.pycolmap: Any = importlib.import_module("pycolmap")
        self.pycolmap.logging.minloglevel = 2
        self.folder, self.pictures = folder, folder / "pictures"
        self.job: dict[str, Any] = json.loads((folder / "job.json").read_text(encoding="utf-8"))

    def run(self) -> None:
        start = self._now()
        images = self._map()
        answers: dict[str, Any] = {"seconds_to_map": self._now() - start}
        answers["map_bytes"] = sum(
            image.descriptors.shape[0] * (128 + 8) + image.points_world.nbytes // 2
            for image in images.values()
        )
        start = self._now()
        database = self._extract("queries", self.job["queries"])
        extraction_ms = 1e3 * (self._now() - start) / max(len(self.job["queries"]), 1)
        answers["queries"] = [
            self._answer(query, database, images, extraction_ms) for query in self.job["queries"]
        ]
        database.close()
        (self.folder / "answers.json").write_text(json.dumps(answers), encoding="utf-8")

    def _now(self) -> float:
        """Seconds of a clock that never goes back."""
        return time.perf_counter()

    def _extract(self, name: str, rows: list[dict[str, Any]]) -> Any:
        """Return a database with the features of these images. Images of equal cameras share one
        camera."""
        path = self.folder / f"{name}.db"
        for camera in {json.dumps(row["camera"], sort_keys=True) for row in rows}:
            names = [
                row["name"] for row in rows if json.dumps(row["camera"], sort_keys=True) == camera
            ]
            reader, content = self.pycolmap.ImageReaderOptions(), json.loads(camera)
            reader.camera_model, reader.camera_params = (
                content["model"],
                ",".join(map(repr, content["params"])),
            )
            single, cpu = self.pycolmap.CameraMode.SINGLE, self.pycolmap.Device.cpu
            self.pycolmap.extract_features(
                path, self.pictures, names, camera_mode=single, reader_options=reader, device=cpu
            )
        return self.pycolmap.Database.open(path)

    def _map(self) -> dict[int, MapImage]:
        """Features, matches, and points triangulated under the known poses; the left picture of
        each node."""
        rows = self.job["map"]
        database = self._extract("map", rows)
        self._match_map(database)
        known = self.pycolmap.Reconstruction()
        for camera in database.read_all_cameras():
            known.add_camera_with_trivial_rig(camera)
        ids = {row["name"]: database.read_image_with_name(row["name"]) for row in rows}
        for row in rows:
            image = ids[row["name"]]
            bare = self.pycolmap.Image(
                name=image.name, camera_id=image.camera_id, image_id=image.image_id
            )
            known.add_image_with_trivial_frame(
                bare, self.pycolmap.Rigid3d(np.array(row["cam_from_world"]))
            )
        (self.folder / "model").mkdir()
        model = self.pycolmap.triangulate_points(
            known, self.folder / "map.db", self.pictures, self.folder / "model"
        )
        first = {row["node"]: ids[row["name"]] for row in reversed(rows)}
        images = {
            node: MapImage(
                image.name,
                self._descriptors(database, image.image_id),
                _points(model, image.image_id),
            )
            for node, image in first.items()
        }
        database.close()
        return images

    def _match_map(self, database: Any) -> None:
        """Write the verified matches of the job's pairs into the database of the map."""
        pairing = self.pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(self.folder / "pairs.txt")
        (self.folder / "pairs.txt").write_text(
            "".join(f"{a} {b}\n" for a, b in self.job["pairs"]), encoding="utf-8"
        )
        self.pycolmap.match_image_pairs(
            self.folder / "map.db", pairing_options=pairing, device=self.pycolmap.Device.cpu
        )

    def _match(
        self, name: str, descriptors: Float32[np.ndarray, "n d"], found: MapImage
    ) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """Match the query of this name with a picture of the map: rows of both's key points."""
        return mutual_matches(descriptors, found.descriptors, RATIO)

    def _descriptors(self, database: Any, image_id: int) -> Float32[np.ndarray, "n 128"]:
        """Of unit length; as many as there are key points."""
        data = np.asarray(database.read_descriptors(image_id).data, np.float32).reshape(-1, 128)
        return data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-6)

    def _answer(
        self,
        query: dict[str, Any],
        database: Any,
        images: dict[int, MapImage],
        extraction_ms: float,
    ) -> dict[str, Any]:
        start = self._now()
        image = database.read_image_with_name(query["name"])
        pixels = np.asarray(database.read_keypoints(image.image_id), np.float64)[:, :2]
        pose = self._pose(query, pixels, self._descriptors(database, image.image_id), images)
        return {"cam_from_world": pose, "ms": extraction_ms + 1e3 * (self._now() - start)}

    def _pose(
        self,
        query: dict[str, Any],
        pixels: Float[np.ndarray, "n 2"],
        descriptors: Float32[np.ndarray, "n 128"],
        images: dict[int, MapImage],
    ) -> list[list[float]] | None:
        rows = [np.zeros((0, 4))]
        for node in query["nodes"]:
            found = images[node]
            query_idx, map_idx = self._match(query["name"], descriptors, found)
            rows.append(np.column_stack([query_idx.astype(float), found.points_world[map_idx]]))
        pairs = np.concatenate(rows)
        pairs = np.unique(pairs[np.isfinite(pairs).all(axis=1)], axis=0)
        if len(pairs) < MIN_POINTS:
            return None
        camera = self.pycolmap.Camera(**query["camera"])
        answer = self.pycolmap.estimate_and_refine_absolute_pose(
            pixels[pairs[:, 0].astype(int)], pairs[:, 1:], camera
        )
        return (
            None
            if answer is None
            else np.asarray(answer["cam_from_world"].matrix(), np.float64).tolist()
        )


def mutual_matches(
    query: Float32[np.ndarray, "n d"], train: Float32[np.ndarray, "m d"], ratio: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Mutual nearest neighbours of unit vectors that pass Lowe's ratio test."""
    if len(query) < 2 or len(train) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    products = query @ train.T
    best = products.argmax(axis=1)
    second = np.partition(products, -2, axis=1)[:, -2]
    first = products[np.arange(len(query)), best]
    distances = np.sqrt(np.maximum(2.0 - 2.0 * np.stack([first, second]), 0.0))
    keeps = (distances[0] < ratio * distances[1]) & (
        products.argmax(axis=0)[best] == np.arange(len(query))
    )
    return np.flatnonzero(keeps), best[keeps]


def _points(model: Any, image_id: int) -> Float[np.ndarray, "n 3"]:
    """Return the 3-D point (metres, world) of each key point, NaN if it has none."""
    points = model.images[image_id].points2D
    return np.array(
        [model.points3D[p.point3D_id].xyz if p.has_point3D() else [np.nan] * 3 for p in points]
    ).reshape(-1, 3)


if __name__ == "__main__":
    Worker(Path(sys.argv[1])).run()
