"""hloc's scheme in pycolmap: SIFT, triangulation with the known poses, retrieval, COLMAP's absolute
pose.

Left and right pictures of the map's nodes are matched with each other and with their neighbours,
and their points triangulated under the recording's poses. A query is matched with the images of the
five nodes that `surf-vlad` names, and gets COLMAP's absolute pose by its default settings; as in
hloc every pose that comes out is believed. `colmap_worker.py` does the work in a process of its
own: pycolmap and OpenCV bring two builds of the same compression library, and do not survive each
other in one.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from topoloc.errors import MissingExtraError, TopolocError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import Image, StereoFrame, StereoSequence
from topoloc_paper.peer_answers import PeerAnswer
from topoloc_paper.peer_retrieval import Retrieval
from topoloc_paper.settings import evenly

NUM_RETRIEVED = 5
NUM_NEIGHBOURS = 6
NUM_RANKED = 10 * NUM_RETRIEVED


class Colmap:
    """pycolmap's map of the nodes' pictures; made anew, in a temporary folder, for each set of
    queries.

    Raises:
        MissingExtraError: pycolmap is not installed.
    """

    def __init__(
        self,
        topomap: TopoMetricMap,
        sequences: Sequence[StereoSequence],
        max_images: int,
        folder: Path,
    ) -> None:
        if importlib.util.find_spec("pycolmap") is None:
            raise MissingExtraError("pycolmap is not installed: pip install pycolmap")
        self._topomap, self._folder = topomap, folder
        self._retrieval = Retrieval(topomap)
        self._kept = evenly(len(topomap.summaries), max_images)
        self._frames = {
            (sequence.name, name): (sequence, i)
            for sequence in sequences
            for i, name in enumerate(sequence.names)
        }
        self.map_bytes = self._retrieval.map_bytes
        self.seconds_to_map = 0.0

    def localize(self, frames: Sequence[StereoFrame]) -> list[PeerAnswer]:
        """An answer for each frame.

        Raises:
            TopolocError: pycolmap ended with an error.
        """
        with tempfile.TemporaryDirectory(dir=self._folder) as work:
            folder = Path(work)
            job: dict[str, Any] = {
                "map": self._write_map(folder),
                "queries": [self._write_query(folder, i, frame) for i, frame in enumerate(frames)],
            }
            job["pairs"] = self._pairs(job["map"])
            answers = run_worker(folder, job)
        self.map_bytes = self._retrieval.map_bytes + answers["map_bytes"]
        self.seconds_to_map = answers["seconds_to_map"]
        rows = zip(job["queries"], answers["queries"], strict=True)
        return [
            PeerAnswer(pose_of(answer["cam_from_world"]), query["retrieval_ms"] + answer["ms"])
            for query, answer in rows
        ]

    def _write_map(self, folder: Path) -> list[dict[str, Any]]:
        """Yield the left image of every kept node, and the right one if there is one, with camera
        and pose."""
        rows = []
        for node_id in self._kept:
            summary = self._topomap.summaries[node_id]
            sequence, index = self._frames[summary.recording, summary.name]
            rows += map_rows(folder, node_id, sequence[index])
        return rows

    def _write_query(self, folder: Path, number: int, frame: StereoFrame) -> dict[str, Any]:
        start = time.perf_counter()
        kept = set(self._kept)
        ranked = [
            node_id for node_id in self._retrieval.nodes(frame.image, NUM_RANKED) if node_id in kept
        ][:NUM_RETRIEVED]
        retrieval_ms = 1e3 * (time.perf_counter() - start)
        return query_row(folder, number, frame, ranked) | {"retrieval_ms": retrieval_ms}

    def _pairs(self, rows: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
        """Each left picture with its right one and with the left ones of the nearest nodes."""
        names: dict[int, list[str]] = {}
        for row in rows:
            names.setdefault(row["node"], []).append(row["name"])
        poses = [self._topomap.summaries[node_id].world_from_cam for node_id in self._kept]
        stacked, lambda_rot = NodePoses.from_poses(poses), self._topomap.config.lambda_rot
        pairs = [(both[0], both[1]) for both in names.values() if len(both) == 2]
        for node_id, pose in zip(self._kept, poses, strict=True):
            nearest = np.argsort(node_distances(pose, stacked, lambda_rot), kind="stable")[
                1 : NUM_NEIGHBOURS + 1
            ]
            pairs += [
                (names[min(node_id, self._kept[k])][0], names[max(node_id, self._kept[k])][0])
                for k in nearest
            ]
        return sorted(set(pairs))


def run_worker(
    folder: Path, job: dict[str, Any], worker: str = "colmap_worker", *options: str
) -> dict[str, Any]:
    """Write the job, let a worker process do it and return its answers.

    Raises:
        TopolocError: The worker ended with an error.
    """
    (folder / "job.json").write_text(json.dumps(job), encoding="utf-8")
    command = [sys.executable, "-m", f"topoloc_paper.{worker}", str(folder), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, encoding="utf-8")
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise TopolocError(f"{worker} ended with status {done.returncode}: {last[:200]}")
    return json.loads((folder / "answers.json").read_text(encoding="utf-8"))


def query_row(
    folder: Path, number: int, frame: StereoFrame, node_ids: Sequence[int]
) -> dict[str, Any]:
    """Write a query's picture and return its row of the job, to be matched with these nodes."""
    assert frame.camera is not None
    name = _write(folder, f"queries/{number:05d}", frame.image)
    return {"name": name, "camera": _colmap_camera(frame.camera), "nodes": list(node_ids)}


def map_rows(folder: Path, node_id: int, frame: StereoFrame) -> list[dict[str, Any]]:
    """Write the left image of a node, and the right one if there is one. Return their rows."""
    assert frame.camera is not None
    assert frame.world_from_cam is not None
    cam_from_world = frame.world_from_cam.inverse()
    left = _map_row(
        folder, f"map/{node_id:05d}-0", node_id, frame.image, frame.camera, cam_from_world
    )
    if frame.right is None or frame.rig is None:
        return [left]
    right_from_world = frame.rig.right_from_left @ cam_from_world
    name = f"map/{node_id:05d}-1"
    return [left, _map_row(folder, name, node_id, frame.right, frame.rig.right, right_from_world)]


def _map_row(
    folder: Path, name: str, node_id: int, image: Image, camera: Camera, cam_from_world: Rigid3
) -> dict[str, Any]:
    matrix = np.column_stack([cam_from_world.rotation, cam_from_world.translation]).tolist()
    return {
        "name": _write(folder, name, image),
        "node": node_id,
        "camera": _colmap_camera(camera),
        "cam_from_world": matrix,
    }


def _write(folder: Path, name: str, image: Image) -> str:
    path = folder / "pictures" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return f"{name}.png"


def _colmap_camera(camera: Camera) -> dict[str, Any]:
    """The camera in COLMAP's convention: the centre of the first pixel is at (0.5, 0.5)."""
    content = camera.to_json()
    params = [float(value) for value in camera.params]
    first = 1 if camera.model.startswith("SIMPLE") or camera.model == "RADIAL" else 2
    params[first], params[first + 1] = params[first] + 0.5, params[first + 1] + 0.5
    return {
        "model": content["model"],
        "width": camera.width,
        "height": camera.height,
        "params": params,
    }


def pose_of(cam_from_world: list[list[float]] | None) -> Rigid3 | None:
    if cam_from_world is None:
        return None
    matrix = np.array(cam_from_world)
    return Rigid3(matrix[:, :3], matrix[:, 3]).inverse()
