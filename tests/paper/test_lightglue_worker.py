"""Test triangulation and pose of the worker with known key points and matches."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tiny_world import CAMERA
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoFrame
from topoloc_paper.lightglue_worker import near_epipolar_lines
from topoloc_paper.peer_colmap import map_rows, pose_of, query_row

# Runs the worker on features.npz: image i is filled with the value i and sees the points in the
# order of row i. A fifth of the matches is wrong.
WORKER = """
import sys, numpy as np, torch
from pathlib import Path
from topoloc_paper import lightglue_worker
folder, cache = Path(sys.argv[1]), Path(sys.argv[2])
pixels = np.load(cache / "pixels.npy")

class Extractor:
    def extract(self, image, resize):
        seen = torch.from_numpy(pixels[int(torch.round(image[0, 0, 0, 0] * 255))])[None]
        ids = torch.arange(seen.shape[1], dtype=torch.float32)[None, :, None]
        return {"keypoints": seen, "descriptors": ids, "image_size": torch.zeros(1, 2)}

def matcher(data):
    rows = torch.arange(pixels.shape[1])
    other = torch.where(rows % 5 == 0, (rows + 7) % len(rows), rows)
    return {"matches": [torch.stack([rows, other], 1)]}

lightglue_worker.load = lambda site, max_points: (Extractor(), matcher)
lightglue_worker.LightGlueWorker(folder, folder, -1, cache).run()
"""


def _frame(number: int, world_from_cam: Rigid3) -> StereoFrame:
    image = np.full((CAMERA.height, CAMERA.width), number, np.uint8)
    return StereoFrame(f"{number}", number, image, CAMERA, world_from_cam=world_from_cam)


def test_the_worker_triangulates_and_finds_the_pose(tmp_path: Path):
    for package in ("pycolmap", "torch"):
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    rng = np.random.default_rng(0)
    points = rng.uniform([-2.0, -1.0, 4.0], [2.0, 1.0, 7.0], (80, 3))
    poses = [Rigid3(exp_so3(rng.normal(0, 0.02, 3)), np.array([0.3 * i, 0, 0])) for i in range(5)]
    pixels = [CAMERA.img_from_cam(pose.inverse().apply(points)) for pose in poses]
    np.save(tmp_path / "pixels.npy", np.array(pixels, np.float32))
    frames = [_frame(number, pose) for number, pose in enumerate(poses)]
    for folder in (tmp_path / "computed", tmp_path / "cached"):
        rows = [row for i in range(4) for row in map_rows(folder, i, frames[i])]
        names = [row["name"] for row in rows]
        job: dict[str, Any] = {
            "map": rows,
            "pairs": [(names[i], names[j]) for i in range(4) for j in range(i + 1, 4)],
            "queries": [query_row(folder, 0, frames[4], [3, 2])],
        }
        (folder / "job.json").write_text(json.dumps(job))
        subprocess.run([sys.executable, "-c", WORKER, str(folder), str(tmp_path)], check=True)
        (answer,) = json.loads((folder / "answers.json").read_text())["queries"]
        found = pose_of(answer["cam_from_world"])
        assert found is not None
        assert np.allclose(found.translation, poses[4].translation, atol=1e-3)
        assert np.allclose(found.rotation, poses[4].rotation, atol=1e-3)
        assert answer["ms"] > 0
    # 5 images, 6 pairs of the map and 2 of the query
    assert len(list(tmp_path.glob("*.npz"))) == 5 + 6 + 2


def test_matches_beside_the_epipolar_line_are_dropped():
    rng = np.random.default_rng(1)
    points = rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (20, 3))
    cams_from_world = [
        Rigid3(exp_so3(np.array([0.1, 0.2, -0.1])), np.array([0.3, 0.1, 0.2])),
        Rigid3(exp_so3(np.array([0.0, -0.1, 0.1])), np.array([-0.4, 0.2, 0.1])),
    ]
    first, second = ((cam := pose.apply(points))[:, :2] / cam[:, 2:] for pose in cams_from_world)
    matrices = [np.column_stack([pose.rotation, pose.translation]) for pose in cams_from_world]
    both, limits = (matrices[0], matrices[1]), (1e-6, 1e-6)
    assert near_epipolar_lines((first, second), both, limits).all()
    moved = second + 0.01 * rng.normal(size=second.shape)
    assert not near_epipolar_lines((first, moved), both, limits).any()
    assert near_epipolar_lines((first, moved), both, (0.1, 0.1)).all()
