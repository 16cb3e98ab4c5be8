"""Check that drawn matches between a query and its node agree with map and camera and end at
the right pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from built_room import built_room, unseen_views
from tiny_world import CAMERA
from topoloc.apps.report.match_images import MAX_LINES, NodeMatches, draw_pair, match_with_node
from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.evaluation.node_matching import NodeMatcher
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.stored_images import decode_stored_image, encode_jpeg


@pytest.fixture(scope="module")
def topomap(tiny_recording: Path) -> TopoMetricMap:
    return built_room(tiny_recording)


def _seen_in_node(
    topomap: TopoMetricMap, node_id: int, matches: NodeMatches, world_from_cam: Rigid3
) -> np.ndarray:
    """Return the distance in pixels, in the query, of each matched node point from its
    true projection."""
    node = topomap.nodes[node_id]
    rows = [
        int(np.argmin(np.linalg.norm(node.features.points_img - pixel, axis=1)))
        for pixel in matches.points_node
    ]
    points_world = node.summary.world_from_cam.apply(node.points_cam[rows].astype(np.float64))
    return np.linalg.norm(
        CAMERA.img_from_cam(world_from_cam.inverse().apply(points_world)) - matches.points_query,
        axis=1,
    )


def test_matches_of_a_localized_query_are_those_that_its_pose_explains(topomap: TopoMetricMap):
    picture, truth = unseen_views()[2]
    result = Localizer(topomap).localize(picture, CAMERA)
    assert isinstance(result, Localization)
    config = topomap.config.features
    matches = match_with_node(
        EvaluatedQuery("q", result, truth),
        picture,
        CAMERA,
        NodeMatcher(topomap.nodes[result.node_id], config),
    )
    assert len(matches.is_inlier) > 60
    assert matches.is_inlier.all()
    assert np.median(_seen_in_node(topomap, result.node_id, matches, truth)) < 1.0


def test_without_a_pose_the_truth_labels_the_matches(topomap: TopoMetricMap):
    picture, truth = unseen_views()[2]
    matcher = NodeMatcher(topomap.nodes[2], topomap.config.features)
    known = match_with_node(
        EvaluatedQuery("q", NotLocalized("not_in_map"), truth),
        picture,
        CAMERA,
        matcher,
    )
    off = _seen_in_node(topomap, 2, known, truth)
    assert known.is_inlier.any()
    np.testing.assert_array_equal(known.is_inlier, off <= 4.0)  # 8 px in an image of 640
    unknown = match_with_node(
        EvaluatedQuery("q", NotLocalized("not_in_map"), None),
        picture,
        CAMERA,
        matcher,
    )
    assert len(unknown.is_inlier) == len(known.is_inlier)
    assert not unknown.is_inlier.any()


def test_a_picture_without_features_has_no_matches(topomap: TopoMetricMap):
    black = np.zeros((240, 320), np.uint8)
    config = topomap.config.features
    matches = match_with_node(
        EvaluatedQuery("q", NotLocalized("too_few_matches"), None),
        black,
        CAMERA,
        NodeMatcher(topomap.nodes[0], config),
    )
    assert len(matches.is_inlier) == 0


def test_lines_lead_from_the_query_to_the_node():
    query, template = np.full((400, 960, 3), 40, np.uint8), np.full((100, 200), 40, np.uint8)
    node_camera = Camera.pinhole(400, 200, 300.0, 300.0, 199.5, 99.5)
    matches = NodeMatches(
        np.array([[200.0, 100.0], [600.0, 300.0]]),
        np.array([[100.0, 50.0], [300.0, 160.0]]),
        np.array([True, False]),
    )
    pair = draw_pair(query, template, matches, node_camera)
    assert pair.shape == (200, 480 + 6 + 400, 3)  # both as high as the query at 480 pixels' width
    green, red = pair[100 // 2, 200 // 2].astype(int), pair[300 // 2, 600 // 2].astype(int)
    assert green[1] > green[0] + 50
    assert red[0] > red[1] + 50
    assert np.abs(pair[50, 486 + 100].astype(int) - green).max() < 30
    assert np.abs(pair[160, 486 + 300].astype(int) - red).max() < 30
    np.testing.assert_array_equal(draw_pair(query, template)[:, :480], 40)
    np.testing.assert_array_equal(draw_pair(query, None), 40)


def test_many_matches_are_thinned_out():
    grid = (
        np.stack(np.meshgrid(np.arange(10, 470, 10), np.arange(10, 290, 10)), axis=-1)
        .reshape(-1, 2)
        .astype(np.float64)
    )
    blank = np.zeros((300, 480, 3), np.uint8)
    matches = NodeMatches(grid, grid, np.ones(len(grid), dtype=bool))
    pair = draw_pair(blank, blank, matches, Camera.pinhole(480, 300, 300.0, 300.0, 239.5, 149.5))
    num_dots = sum(pair[int(y), int(x)].max() > 200 for x, y in grid)
    assert num_dots == MAX_LINES


def test_an_encoded_picture_is_the_same_twice_and_nearly_the_original():
    picture = np.repeat(np.linspace(0, 255, 64).astype(np.uint8)[None, :, None], 48, axis=0).repeat(
        3, axis=2
    )
    assert encode_jpeg(picture, 78) == encode_jpeg(picture, 78)
    assert np.abs(decode_stored_image(encode_jpeg(picture, 78)).astype(int) - picture).max() < 12
