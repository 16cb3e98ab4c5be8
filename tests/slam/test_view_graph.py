"""Test the pairs of images without poses: what is matched is right, and only views of one place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import room_frames
import tiny_world
from topoloc.geometry.camera import UncalibratedCamera
from topoloc.recordings.frame import MemorySequence
from topoloc.slam.view_graph import ViewGraph, match_views

PLACES = [0.0, 3.0, 6.0, 9.0, 1.5, 4.5, 7.5]


def _graph(*seeds: int) -> ViewGraph:
    sequences = [
        MemorySequence(
            replace(frame, camera=None, right=None, rig=None)
            for frame in room_frames.walk(PLACES, seed).frames
        )
        for seed in seeds
    ]
    return match_views(sequences, lambda stage, done, total: None)


@pytest.fixture(scope="module")
def graph() -> ViewGraph:
    return _graph(0, 1)


def test_matches_are_on_the_epipolar_lines_of_the_truth(graph: ViewGraph):
    inside = [pair for pair in graph.pairs if pair.second < len(PLACES)]
    assert len(inside) >= 12
    for pair in inside:
        poses = [tiny_world.path_pose(PLACES[k]) for k in (pair.first, pair.second)]
        rays = [
            tiny_world.CAMERA.rays_from_img(graph.points_img[k][rows].astype(np.float64))
            for k, rows in zip((pair.first, pair.second), pair.features.T, strict=True)
        ]
        step = poses[1].inverse() @ poses[0]
        normals = np.cross(rays[0] @ step.rotation.T, step.translation)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        errors_px = tiny_world.CAMERA.fx * np.abs(np.sum(normals * rays[1], axis=1))
        assert np.median(errors_px) < 1.0
        assert np.mean(errors_px < 4.0) > 0.9


def test_two_places_share_no_pair(graph: ViewGraph):
    assert {pair.first // len(PLACES) for pair in graph.pairs} == {0, 1}
    assert all(pair.first // len(PLACES) == pair.second // len(PLACES) for pair in graph.pairs)


def test_cameras_without_calibration_have_a_range(graph: ViewGraph):
    assert {(one.width, one.height) for one in graph.cameras} == {(320, 240)}
    for one in graph.cameras:
        assert isinstance(one, UncalibratedCamera)
        assert one.min_focal < 260.0 < one.max_focal
