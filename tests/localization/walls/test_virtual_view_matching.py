"""Test joint matching of both virtual views of an image around a pose."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from built_corridor import WIDE, back, built_corridor, seen_on_the_way_back
from topoloc.features.extraction import extract_features, make_virtual_views
from topoloc.features.feature_types import SURF, FeatureConfig
from topoloc.features.features import Features
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.pose_fit import LocalMap, PoseFit, fit_pose
from topoloc.localization.walls.virtual_view_matching import (
    QueryVirtualView,
    count_virtual_views,
    match_virtual_views,
    select_nearest_virtual_nodes,
)
from topoloc.mapping.topomap import VirtualNodes

PICTURE, TRUTH = seen_on_the_way_back()[2]
GUIDED = GuidedConfig(radius_px=25.0).resolved(SURF)


def _sides() -> VirtualNodes:
    sides = built_corridor().sides
    assert sides is not None
    return sides


def _centres_and_axes() -> tuple[np.ndarray, np.ndarray]:
    (model,) = _sides().coarse_models.values()
    return model.arrays["centres"], np.array(
        [s.world_from_cam.rotation[:, 2] for s in _sides().summaries]
    )


@cache
def _seen() -> list[QueryVirtualView]:
    """Return both virtual views of the image, left first."""
    seen = []
    for view in make_virtual_views(WIDE):
        features = view.select_inside(extract_features(view.picture(PICTURE), FeatureConfig()))
        seen.append(QueryVirtualView.from_features(view, features, WIDE))
    return seen


@cache
def _around() -> list[tuple[QueryVirtualView, LocalMap]]:
    centres, axes = _centres_and_axes()
    found = []
    for side in _seen():
        side_ids = select_nearest_virtual_nodes(side.view, TRUTH.inverse(), centres, axes, 4)
        found.append(
            (side, LocalMap.concatenate([LocalMap.of_node(_sides().nodes[k]) for k in side_ids]))
        )
    return found


@pytest.mark.parametrize("y", [4.0, 5.0, 6.5])
def test_the_selected_virtual_nodes_show_the_visible_wall(y: float):
    centres, axes = _centres_and_axes()
    for view in make_virtual_views(WIDE):
        side_ids = select_nearest_virtual_nodes(view, back(y).inverse(), centres, axes, 3)
        assert 1 <= len(side_ids) <= 3
        to_the_right = (back(y) @ view.cam_from_virtual).rotation[0, 2]
        assert (centres[side_ids, 0] * to_the_right > 1.0).all()  # all on the same wall
        # a camera at y in reverse direction sees 1 to 3 wall distances behind y, and the middle
        # comes first
        off_middle = np.abs(centres[side_ids, 1] - (y - 2.2))
        assert off_middle[0] < 0.6
        assert off_middle.max() < 2.2


def test_no_virtual_node_is_near_a_distant_pose():
    centres, axes = _centres_and_axes()
    for view in make_virtual_views(WIDE):
        assert select_nearest_virtual_nodes(view, back(60.0).inverse(), centres, axes, 4) == []
        assert (
            select_nearest_virtual_nodes(
                view, back(5.0, yaw=np.pi / 2.0).inverse(), centres, axes, 4
            )
            == []
        )


def test_matches_of_both_views_lie_at_the_projected_points():
    found = match_virtual_views(_around(), TRUTH.inverse(), WIDE, GUIDED)
    assert found is not None
    assert len(found.features) == sum(len(side.features) for side in _seen())
    assert len(found.local_map.radii) == sum(len(local_map.radii) for _, local_map in _around())
    points_world = found.local_map.points_world[found.matches.train_idx]
    offsets = (
        WIDE.img_from_cam(TRUTH.inverse().apply(points_world))
        - found.features.points_img[found.matches.query_idx]
    )
    assert np.median(np.linalg.norm(offsets, axis=1)) < 2.0
    for wall in (-1.1, 1.1):
        assert np.count_nonzero(np.abs(points_world[:, 0] - wall) < 0.1) > 50
    # the same feature once, at its own pixel
    assert len(set(found.matches.query_idx.tolist())) == len(found.matches)
    first = len(_seen()[0].features)
    np.testing.assert_array_equal(
        found.features.points_img[first:], _seen()[1].features_in_image.points_img
    )
    cosines = np.sum(
        found.features.descriptors[found.matches.query_idx]
        * found.local_map.descriptors[found.matches.train_idx],
        axis=1,
    )
    assert np.median(cosines) > 0.8


def test_at_a_wrong_pose_little_more_is_found_than_by_chance():
    at_truth = match_virtual_views(_around(), TRUTH.inverse(), WIDE, GUIDED)
    shifted = Rigid3(TRUTH.rotation, TRUTH.translation + np.array([0.0, 0.9, 0.0]))
    elsewhere = match_virtual_views(_around(), shifted.inverse(), WIDE, GUIDED)
    assert at_truth is not None
    assert elsewhere is not None
    assert len(elsewhere.matches) < 0.5 * len(at_truth.matches)
    assert count_virtual_views(_around(), TRUTH.inverse(), GUIDED).num_by_chance < 0.4 * len(
        at_truth.matches
    )


def test_visible_points_are_counted_by_area_and_not_by_nodes():
    once = count_virtual_views(_around(), TRUTH.inverse(), GUIDED)
    twice = count_virtual_views(
        [(side, LocalMap.concatenate([points, points])) for side, points in _around()],
        TRUTH.inverse(),
        GUIDED,
    )
    assert 100 < once.num_visible == twice.num_visible


def test_visible_points_lie_at_their_pixels():
    counts = count_virtual_views(_around(), TRUTH.inverse(), GUIDED)
    assert counts.agreeing_img is None  # SURF has no dense descriptors
    assert 100 < len(counts.visible_img) <= 2 * 512
    points_img = np.concatenate(
        [WIDE.img_from_cam(TRUTH.inverse().apply(points.points_world)) for _, points in _around()]
    )
    offsets = np.nanmin(
        np.linalg.norm(counts.visible_img[:, None] - points_img[None], axis=2), axis=1
    )
    assert offsets.max() < 2.0  # pixels of the side view are rounded


def test_a_near_pose_of_both_views_is_refined_in_rounds():
    """Matches around an inexact pose are biased towards it, so that one round is not enough."""
    world_from_cam = Rigid3(TRUTH.rotation, TRUTH.translation + np.array([0.03, -0.06, 0.02]))
    config = AbsolutePoseConfig(max_reprojection_error_px=6.0, sigma_px=2.0)
    for _ in range(3):
        found = match_virtual_views(_around(), world_from_cam.inverse(), WIDE, GUIDED)
        assert found is not None
        start = world_from_cam.inverse(), WIDE
        fit = fit_pose(found.features, WIDE, found.local_map, found.matches, config, start)
        assert isinstance(fit, PoseFit)
        world_from_cam = fit.world_from_cam
    assert translation_error(world_from_cam, TRUTH) < 0.02
    assert rotation_error(world_from_cam, TRUTH) < np.deg2rad(0.3)


def test_nothing_matched_is_none():
    assert match_virtual_views([], TRUTH.inverse(), WIDE, GUIDED) is None
    side, points = _around()[0]
    nothing = QueryVirtualView.from_features(side.view, Features.empty(64), WIDE)
    assert match_virtual_views([(nothing, points)], TRUTH.inverse(), WIDE, GUIDED) is None
