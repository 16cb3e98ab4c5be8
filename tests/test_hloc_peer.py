"""Test the benchmark with hloc's scheme: the matched images, and the threshold of a wrong pose."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import CAMERA
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence


@pytest.fixture
def peer(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    return importlib.import_module("hloc_peer")


def test_the_nearest_frames_look_the_same_way(peer: Any):
    poses = {i: Rigid3(np.eye(3), np.array([float(i), 0.0, 0.0])) for i in range(5)}
    poses[2] = Rigid3(exp_so3(np.array([0.0, np.deg2rad(31.0), 0.0])), poses[2].translation)
    here = Rigid3(np.eye(3), np.array([2.2, 0.0, 0.0]))
    assert peer.nearest_frames(here, poses, 3) == [3, 1, 4]
    assert peer.nearest_frames(here, poses, 9) == [3, 1, 4, 0]


def test_retrieved_frames_are_matched_with_their_right_image_and_their_neighbours(
    peer: Any, tiny_recording: Path, tmp_path: Path
):
    image, pose = next(iter(unseen_views()))
    frame = StereoFrame("view", 0, image, CAMERA, world_from_cam=pose)
    queries = peer.Queries(["views"], [frame])
    job = peer.write_job(tmp_path, open_sequence(tiny_recording), queries, 2, 1)
    (query,) = job["queries"]
    first, second = query["nodes"]
    pairs = {tuple(pair) for pair in job["pairs"]}
    for node in (first, second):
        assert (f"map/{node:05d}-0.png", f"map/{node:05d}-1.png") in pairs
        assert sum(f"map/{node:05d}-0.png" in pair for pair in pairs) >= 2
    assert {name for pair in pairs for name in pair} <= {row["name"] for row in job["map"]}
    assert all((tmp_path / "pictures" / row["name"]).is_file() for row in (query, *job["map"]))


def test_wrong_is_beyond_25_cm_or_2_degrees(peer: Any):
    text = peer.text_of([(0.01, 0.1), (0.26, 0.1), (0.02, 2.1), (0.24, 1.9)], 5)
    assert text.startswith("4 of 5, 2 wrong, median 13.00 cm 1.000 deg")
    assert peer.text_of([], 5) == "0 of 5"
    turned = Rigid3(exp_so3(np.array([0.0, 0.0, np.deg2rad(3.0)])), np.array([0.0, 0.3, 0.0]))
    assert np.allclose(peer.errors_of(turned, Rigid3.identity()), (0.3, 3.0))
