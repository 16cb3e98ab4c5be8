"""Run hloc's scheme with ALIKED and LightGlue in a process of its own: ``python -m ... FOLDER SITE
MAX_POINTS CACHE``.

It differs from `colmap_worker.py` in features and matching alone. Matches of the map that miss the
epipolar lines of the known poses by more than 4 px are dropped, as in hloc. CACHE keeps features
and matches by the content of the images, so that a later run computes only what is new. What comes
from there counts with the seconds that it took when it was computed.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from topoloc_paper.colmap_worker import MapImage, Worker
from topoloc_paper.lightglue import load

EPIPOLAR_PX = 4.0


class LightGlueWorker(Worker):
    """One map and its queries, by ALIKED and LightGlue."""

    def __init__(self, folder: Path, site: Path, max_points: int, cache: Path) -> None:
        super().__init__(folder)
        self.extractor, self.matcher = load(site, max_points)
        self.cache, self.max_points = cache, max_points
        self.keys: dict[str, str] = {}
        self.results: dict[str, dict[str, Any]] = {}
        self.saved_seconds = 0.0

    def _now(self) -> float:
        return super()._now() + self.saved_seconds

    def _extract(self, name: str, rows: list[dict[str, Any]]) -> Any:
        """Return a database with cameras, images and the key points of these images."""
        path = self.folder / f"{name}.db"
        self.pycolmap.Database.open(path).close()
        by_camera: dict[str, list[str]] = {}
        for row in rows:
            by_camera.setdefault(json.dumps(row["camera"], sort_keys=True), []).append(row["name"])
        for camera, names in by_camera.items():
            content = json.loads(camera)
            self.pycolmap.import_images(
                path,
                self.pictures,
                self.pycolmap.CameraMode.SINGLE,
                names,
                self.pycolmap.ImageReaderOptions(
                    camera_model=content["model"],
                    camera_params=",".join(map(repr, content["params"])),
                ),
            )
        database = self.pycolmap.Database.open(path)
        for row in rows:
            image = database.read_image_with_name(row["name"])
            database.write_keypoints(image.image_id, self._features(row["name"])["keypoints"] + 0.5)
        return database

    def _descriptors(self, database: Any, image_id: int) -> Float32[np.ndarray, "n 128"]:
        return self._features(database.read_image(image_id).name)["descriptors"]

    def _match_map(self, database: Any) -> None:
        poses = {row["name"]: np.array(row["cam_from_world"]) for row in self.job["map"]}
        cameras = {row["name"]: self.pycolmap.Camera(**row["camera"]) for row in self.job["map"]}
        for pair in self.job["pairs"]:
            matches = self._pair(*pair)
            first, second = (
                cameras[name].cam_from_img(
                    self._features(name)["keypoints"][rows].astype(np.float64) + 0.5
                )
                for name, rows in zip(pair, matches.T, strict=True)
            )
            limits = [cameras[name].cam_from_img_threshold(EPIPOLAR_PX) for name in pair]
            near = near_epipolar_lines(
                (first, second), (poses[pair[0]], poses[pair[1]]), (limits[0], limits[1])
            )
            geometry = self.pycolmap.TwoViewGeometry()
            geometry.config = self.pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches[near].astype(np.uint32)
            ids = [database.read_image_with_name(name).image_id for name in pair]
            database.write_matches(*ids, matches.astype(np.uint32))
            database.write_two_view_geometry(*ids, geometry)

    def _match(
        self, name: str, descriptors: Float32[np.ndarray, "n d"], found: MapImage
    ) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        query_idx, map_idx = self._pair(name, found.name).T
        return query_idx, map_idx

    def _features(self, name: str) -> dict[str, Any]:
        """Key points (n, 2), the centre of the first pixel at (0, 0); descriptors; image size."""
        if name not in self.keys:
            content = (self.pictures / name).read_bytes() + f"{self.max_points}".encode()
            self.keys[name] = hashlib.sha256(content).hexdigest()[:16]
        return self._cached(self.keys[name], lambda: self._extracted(name))

    def _extracted(self, name: str) -> dict[str, Any]:
        import torch

        pixels = self.pycolmap.Bitmap.read(self.pictures / name, True).to_array()
        image = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1)[None] / 255.0
        found = self.extractor.extract(image, resize=None)
        return {
            "keypoints": found["keypoints"][0].numpy(),
            "descriptors": found["descriptors"][0].numpy(),
            "image_size": found["image_size"][0].numpy(),
        }

    def _pair(self, first: str, second: str) -> Int[np.ndarray, "k 2"]:
        """Return the rows of key points that LightGlue matches."""
        import torch

        both = [self._features(name) for name in (first, second)]

        def matched() -> dict[str, Any]:
            tensors = [{key: torch.from_numpy(each[key])[None] for key in each} for each in both]
            found = self.matcher({"image0": tensors[0], "image1": tensors[1]})
            return {"matches": found["matches"][0].numpy()}

        return self._cached(f"{self.keys[first]}-{self.keys[second]}", matched)["matches"]

    def _cached(self, key: str, compute: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        if key in self.results:
            return self.results[key]
        path = self.cache / f"{key}.npz"
        if path.is_file():
            with np.load(path) as content:
                result = dict(content)
            self.saved_seconds += float(result.pop("seconds"))
        else:
            start = time.perf_counter()
            result = compute()
            partial = path.with_suffix(f".{os.getpid()}.npz")
            np.savez(partial, seconds=time.perf_counter() - start, **result)
            partial.replace(path)
        self.results[key] = result
        return result


def near_epipolar_lines(
    rays: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]],
    cams_from_world: tuple[Float[np.ndarray, "3 4"], Float[np.ndarray, "3 4"]],
    limits: tuple[float, float],
) -> Bool[np.ndarray, " n"]:
    """Return which matches lie near each other's epipolar line in both images.

    Args:
        rays: Matched points of both images, on the plane z = 1 of their cameras.
        cams_from_world: The poses of both cameras.
        limits: The largest distance to the line in each image, on the plane z = 1.
    """
    (first, second), (first_pose, second_pose) = rays, cams_from_world
    rotation = second_pose[:, :3] @ first_pose[:, :3].T
    x, y, z = second_pose[:, 3] - rotation @ first_pose[:, 3]
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    points = [np.column_stack([each, np.ones(len(each))]) for each in (first, second)]
    lines = points[1] @ essential, points[0] @ essential.T
    products = np.abs(np.sum(points[0] * lines[0], axis=1))
    distances = [products / np.linalg.norm(line[:, :2], axis=1) for line in lines]
    return (distances[0] <= limits[0]) & (distances[1] <= limits[1])


if __name__ == "__main__":
    LightGlueWorker(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])).run()
