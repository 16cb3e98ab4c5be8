"""Test guided matching with made map points and key points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from topoloc.features.feature_types import SURF
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.guided import (
    GuidedConfig,
    count_chance_matches,
    count_seen_points,
    match_guided,
    predict_key_points,
    select_visible_points,
)
from topoloc.localization.pose_fit import LocalMap
from topoloc.mapping.topomap import NodeSummary, TopoNode

GUIDED = GuidedConfig().resolved(SURF)

CAMERA = Camera.pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
NUM_POINTS = 200


def _node(rng: np.random.Generator) -> TopoNode:
    """Return a node at the origin with points on a wall and beside it, each with its
    own descriptor."""
    pixels = rng.uniform([40, 40], [600, 440], (NUM_POINTS, 2))
    depth = rng.uniform(2.0, 4.0, NUM_POINTS)
    points_cam = np.column_stack(
        [CAMERA.normalized_from_img(pixels) * depth[:, None], depth]
    ).astype(np.float32)
    descriptors = rng.normal(size=(NUM_POINTS, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    angles, sizes = (
        rng.uniform(0, 6.2, NUM_POINTS).astype(np.float32),
        rng.uniform(10, 40, NUM_POINTS).astype(np.float32),
    )
    features = Features(
        pixels.astype(np.float32), sizes, angles, np.ones(NUM_POINTS, np.float32), descriptors
    )
    root = np.tile(np.array([0.005, 0, 0.005, 0, 0, 0.02], np.float32), (NUM_POINTS, 1))
    return TopoNode(
        NodeSummary(0, "made", "0", 0, Rigid3.identity(), NUM_POINTS),
        CAMERA,
        features,
        points_cam,
        root,
        b"",
    )


def _seen(
    node: TopoNode,
    cam_from_world: Rigid3,
    shift_px: float = 0.0,
    turn: float = 0.0,
    scale: float = 1.0,
) -> Features:
    """Return the node's points as features of another camera, which is rolled about its axis."""
    points = cam_from_world.apply(node.points_cam.astype(np.float64))
    roll = np.arctan2(cam_from_world.rotation[1, 0], cam_from_world.rotation[0, 0])
    f = node.features
    sizes = f.sizes_px * (node.points_cam[:, 2] / points[:, 2]) * scale
    pixels = CAMERA.img_from_cam(points) + np.array([shift_px, 0.0])
    return Features(
        pixels.astype(np.float32),
        sizes.astype(np.float32),
        (f.angles + roll + turn).astype(np.float32),
        f.responses,
        f.descriptors,
    )


POSES = [
    Rigid3(np.eye(3), np.array([0.1, -0.05, 0.3])),
    Rigid3(exp_so3(np.array([0.0, 0.0, np.pi / 2])), np.zeros(3)),  # rolled onto its side
]


@pytest.mark.parametrize("cam_from_world", POSES)
def test_every_point_in_view_is_matched_with_itself(cam_from_world: Rigid3):
    node = _node(np.random.default_rng(0))
    local_map = LocalMap.of_node(node)
    matches = match_guided(_seen(node, cam_from_world), local_map, cam_from_world, CAMERA, GUIDED)
    num_visible = len(select_visible_points(local_map.points_world, cam_from_world, CAMERA)[0])
    assert num_visible > 100
    assert len(matches) > 0.95 * num_visible
    assert np.array_equal(matches.query_idx, matches.train_idx)


@pytest.mark.parametrize("wrong", [{"shift_px": 25.0}, {"turn": 1.2}, {"scale": 2.0}])
def test_distant_rotated_or_scaled_key_points_are_no_match(wrong: dict[str, float]):
    node = _node(np.random.default_rng(1))
    matches = match_guided(
        _seen(node, POSES[0], **wrong), LocalMap.of_node(node), POSES[0], CAMERA, GUIDED
    )
    assert len(matches) < 0.03 * NUM_POINTS


def test_a_key_point_is_matched_once_though_two_nodes_hold_it():
    node = _node(np.random.default_rng(2))
    twice = LocalMap.concatenate([LocalMap.of_node(node), LocalMap.of_node(node)])
    matches = match_guided(_seen(node, POSES[0]), twice, POSES[0], CAMERA, GUIDED)
    assert len(set(matches.query_idx.tolist())) == len(matches) > 100


def test_nothing_is_visible_behind_the_camera():
    local_map = LocalMap.of_node(_node(np.random.default_rng(3)))
    backwards = Rigid3(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    assert len(select_visible_points(local_map.points_world, backwards, CAMERA)[0]) == 0


def test_points_are_seen_from_the_side_of_their_node_only():
    points = LocalMap.of_node(_node(np.random.default_rng(7)))
    at_node, behind = Rigid3.identity(), Rigid3(np.diag([-1.0, 1.0, -1.0]), np.array([0, 0, 6.0]))
    assert count_seen_points(points, np.zeros(3), at_node, CAMERA) == NUM_POINTS
    assert len(select_visible_points(points.points_world, behind, CAMERA)[0]) > 0.3 * NUM_POINTS
    assert count_seen_points(points, np.zeros(3), behind, CAMERA) == 0


def test_chance_finds_next_to_nothing_among_descriptors_that_differ():
    node = _node(np.random.default_rng(4))
    features = _seen(node, POSES[0])
    assert len(match_guided(features, LocalMap.of_node(node), POSES[0], CAMERA, GUIDED)) > 100
    assert count_chance_matches(features, LocalMap.of_node(node), POSES[0], CAMERA, GUIDED) < 5


def test_chance_finds_as_many_matches_among_equal_descriptors():
    node = _node(np.random.default_rng(5))
    same = np.tile(node.features.descriptors[:1], (NUM_POINTS, 1))
    alike = replace(
        node,
        features=replace(
            node.features, descriptors=same, angles=np.zeros_like(node.features.angles)
        ),
    )
    config = GuidedConfig(radius_px=40.0).resolved(SURF)
    config = replace(config, min_margin=0.0, max_scale=4.0)
    found = len(
        match_guided(_seen(alike, POSES[0]), LocalMap.of_node(alike), POSES[0], CAMERA, config)
    )
    by_chance = count_chance_matches(
        _seen(alike, POSES[0]), LocalMap.of_node(alike), POSES[0], CAMERA, config
    )
    assert by_chance > 0.5 * found > 10


def test_a_type_without_scale_and_angle_matches_any_size_and_rotation():
    node = _node(np.random.default_rng(6))
    plain = GuidedConfig().resolved(replace(SURF, has_scale=False, has_angle=False))
    cam_from_world = POSES[1] @ POSES[0]
    seen = _seen(node, cam_from_world)
    constant = replace(
        seen, sizes_px=np.full_like(seen.sizes_px, 24.0), angles=np.zeros_like(seen.angles)
    )
    matches = match_guided(constant, LocalMap.of_node(node), cam_from_world, CAMERA, plain)
    assert len(matches) > 100
    assert np.array_equal(matches.query_idx, matches.train_idx)
    assert len(
        match_guided(constant, LocalMap.of_node(node), cam_from_world, CAMERA, GUIDED)
    ) < 0.3 * len(matches)


def test_a_pinhole_predicts_the_pixels_of_a_barely_distorted_camera():
    """A kernel projects one camera, the camera model the other. Some points lie behind the camera
    or outside of the image."""
    local_map = LocalMap.of_node(_node(np.random.default_rng(5)))
    lens = Camera("OPENCV", 640, 480, (500.0, 500.0, 320.0, 240.0, 0.0, 0.0, 1e-15, 0.0))
    assert lens.is_distorted
    for cam_from_world in (
        Rigid3(exp_so3(np.array([0.1, 0.5, 0.3])), np.array([0.2, 0.1, 0.4])),
        Rigid3(np.eye(3), np.array([0, 0, -3.0])),
    ):
        plain, by_camera = (
            predict_key_points(local_map, cam_from_world, camera) for camera in (CAMERA, lens)
        )
        np.testing.assert_allclose(plain, by_camera, rtol=1e-6)
        assert 0 < np.isnan(plain[:, 0]).sum() < len(plain)
        (rows, pixels), (lens_rows, lens_pixels) = (
            select_visible_points(local_map.points_world, cam_from_world, camera)
            for camera in (CAMERA, lens)
        )
        np.testing.assert_array_equal(rows, lens_rows)
        np.testing.assert_allclose(pixels, lens_pixels, rtol=1e-9)
