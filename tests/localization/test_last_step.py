"""Test the last step: it makes a reported pose more exact, or leaves it unchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from scipy import ndimage

from built_corridor import WIDE, ahead, built_corridor, corridor
from built_room import unseen_views
from tiny_world import CAMERA, render
from topoloc.apps.report.explanation import explain, explanation_to_json
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.exact import last_step
from topoloc.localization.exact.patch_alignment import (
    align_patches,
    load_last_step_weights,
)
from topoloc.localization.exact.templates import NodeTemplate, NodeTemplates, PointTemplates
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_query import MapQuery
from topoloc.localization.query import Deadline, QueryImage, StageClock
from topoloc.localization.result import Localization
from topoloc.localization.search import Trace
from topoloc.mapping.mapping_frames import encode_small
from topoloc.mapping.topomap import TopoMetricMap


@pytest.fixture(scope="module")
def room(room_map: Path) -> Iterator[TopoMetricMap]:
    with TopoMetricMap.load(room_map) as topomap:
        yield topomap


def _localized(
    localizer: Localizer, image: np.ndarray, camera: Camera | UncalibratedCamera = CAMERA
) -> Localization:
    result = localizer.localize(image, camera)
    assert isinstance(result, Localization)
    return result


def _error_mm(found: Localization, truth: Rigid3) -> float:
    return 1e3 * float(np.linalg.norm((truth.inverse() @ found.world_from_cam).translation))


def test_poses_become_more_exact_and_stay_inside_their_ellipsoids(room: TopoMetricMap):
    best, fast = Localizer(room), Localizer(room, LocalizerConfig(exactness="fast"))
    before, after = list[float](), list[float]()
    for image, truth in unseen_views(step=0.75):
        precise, first = _localized(best, image), _localized(fast, image)
        assert precise.probability == first.probability
        before.append(_error_mm(first, truth))
        after.append(_error_mm(precise, truth))
        off = (precise.world_from_cam.inverse() @ truth).log()
        assert off @ np.linalg.solve(precise.camera_covariance, off) < 22.5  # 0.1 % of 6 dof
        assert precise.position_sigma_m < first.position_sigma_m
    assert np.mean(after) < 0.8 * np.mean(before)


def test_poses_far_ahead_of_the_map_know_how_little_they_know():
    """All points lie on a wall far ahead, where a shift and a turn look alike. The nodes saw it
    from 5 to 9 metres farther away, so few of their patches lie side by side."""
    localizer, number = Localizer(built_corridor()), 0
    for k, y in enumerate((8.0, 8.4, 8.8, 9.2)):
        truth = ahead(y, x=0.1, yaw=-0.03)
        image = render(corridor(), truth, WIDE, noise_seed=910 + k)[0]
        found = localizer.localize(image, WIDE)
        if isinstance(found, Localization):
            off, number = (found.world_from_cam.inverse() @ truth).log(), number + 1
            assert off @ np.linalg.solve(found.camera_covariance, off) < 22.5  # 0.1 % of 6 dof
    assert number >= 3


def test_a_pose_that_cannot_be_aligned_stays_as_it_was(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    best, fast = Localizer(room), Localizer(room, LocalizerConfig(exactness="fast"))
    image, _ = unseen_views(step=0.75)[0]
    first, aligned = _localized(fast, image), _localized(best, image)
    none = msgspec.structs.replace(load_last_step_weights(), min_aligned=10**6)
    monkeypatch.setattr(last_step, "load_last_step_weights", lambda: none)
    found = _localized(best, image)
    np.testing.assert_array_equal(found.world_from_cam.matrix(), first.world_from_cam.matrix())
    np.testing.assert_array_equal(found.covariance, first.covariance)
    assert aligned.position_sigma_m < found.position_sigma_m


def test_a_pose_without_points_in_view_is_left_alone(room: TopoMetricMap):
    image, truth = unseen_views()[2]
    localizer, clock = Localizer(room), StageClock()
    searches = localizer.context.searches(QueryImage(image, CAMERA), clock, Deadline())
    query = MapQuery(localizer.context, searches)
    query.search_first()
    weights = load_last_step_weights()
    assert last_step.refine_precisely(searches, truth.inverse(), weights) is not None
    behind = Rigid3(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3)) @ truth.inverse()
    assert last_step.refine_precisely(searches, behind, weights) is None


def test_strong_distortion_is_part_of_the_warp(room: TopoMetricMap):
    image, truth = unseen_views()[3]
    lens = Camera(
        "OPENCV", 320, 240, (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, -0.2, 0.03, 0.0, 0.0)
    )
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([lens.normalized_from_img(pixels), np.ones(len(pixels))])
    source = CAMERA.img_from_cam(rays).reshape(240, 320, 2).astype(np.float32)
    seen = cv2.remap(image, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    best = _error_mm(_localized(Localizer(room), seen, lens), truth)
    assert best < 3.0


def test_without_images_of_the_nodes_a_pose_is_found_all_the_same(
    room: TopoMetricMap, monkeypatch: pytest.MonkeyPatch
):
    image, truth = unseen_views()[2]
    read = NodeTemplate.of_node
    for damaged in (b"", b"no image"):
        monkeypatch.setattr(
            NodeTemplate,
            "of_node",
            staticmethod(lambda node, jpeg=damaged: read(replace(node, template=jpeg))),
        )
        trace = Trace()
        result = Localizer(room).localize(image, CAMERA, trace=trace)
        assert isinstance(result, Localization)
        assert _error_mm(result, truth) < 10.0
        assert result.node_id in trace.nodes_without_image
    explained = explain(Localizer(room), image, CAMERA)
    assert "missing or damaged" in " ".join(explained.advice)
    assert explanation_to_json("a", explained)["nodes_without_image"]


def test_a_focal_length_that_is_estimated_is_left_alone(room: TopoMetricMap):
    rough = UncalibratedCamera.unknown(320, 240)
    image = unseen_views()[2][0]
    results = [
        _localized(Localizer(room, LocalizerConfig(exactness=exactness)), image, rough)
        for exactness in ("best", "fast")
    ]
    assert np.array_equal(*(one.world_from_cam.matrix() for one in results))


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.3, -0.6), (-2.25, 2.5)])
def test_a_shifted_patch_is_found_to_a_tenth_of_a_pixel(shift: tuple[float, float]):
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (80, 100)), None, 2.0)
    texture = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)
    image = np.clip(ndimage.shift(texture, shift[::-1]), 0.0, 255.0)
    predicted = np.array([[50.0, 40.0], [48.5, 37.25], [2.0, 2.0]])  # the last: at the border
    pixels, correlations, _ = align_patches(
        image.round().astype(np.uint8),
        texture.round().astype(np.uint8)[None],
        np.array([texture.shape]),
        np.zeros(3, np.int64),
        predicted,
        predicted.copy(),
        np.tile(np.eye(2), (3, 1, 1)),
        11,
        4,
        2.0,
    )
    assert np.abs(pixels[:2] - predicted[:2] - shift).max() < 0.1
    assert correlations[:2].min() > 0.98
    assert np.isnan(correlations[2])


def test_points_are_projected_and_coloured_by_the_node_of_each():
    grey, colours = np.zeros((240, 320), np.uint8), np.full((60, 80, 3), 0.25, np.float32)
    turned = Rigid3(exp_so3(np.array([0.0, 0.2, 0.0])), np.array([0.3, 0.0, -0.2]))
    nodes = [
        NodeTemplate(grey, CAMERA, turned, colours=colours),
        NodeTemplate(grey, CAMERA.with_focal(300.0), Rigid3.identity()),
        NodeTemplate(grey, CAMERA, Rigid3.identity(), colours=2.0 * colours),
    ]
    rng = np.random.default_rng(0)
    points, of_point = rng.uniform([-1, -1, 3], [1, 1, 5], (30, 3)), np.arange(30) % 3
    templates = PointTemplates(NodeTemplates(nodes), of_point)
    (pixels,) = templates.project(templates.in_nodes(points)[None])
    for k, node in enumerate(nodes):
        in_node = node.world_from_cam.inverse().apply(points[of_point == k])
        expected = node.camera.img_from_cam(in_node)
        np.testing.assert_allclose(pixels[of_point == k], expected, atol=1e-9)
    sampled = templates.sample_colours(points)
    np.testing.assert_allclose(sampled[of_point == 0], 0.25)
    np.testing.assert_allclose(sampled[of_point == 2], 0.5)
    assert np.isnan(sampled[of_point == 1]).all()


def test_a_stored_image_is_scaled_as_its_camera_is():
    picture = np.zeros((720, 960), np.uint8)  # 720 pixels become 400, and 960 become 533.3
    picture[350:370, 900:920] = 255
    stored = []
    encode_small(picture, 400, lambda small: stored.append(small) or b"")
    height, width = stored[0].shape
    scaled = Camera.pinhole(960, 720, 570.0, 570.0, 479.5, 359.5).rescaled(width, height)
    middle = np.array(ndimage.center_of_mass(stored[0].astype(float)))[::-1]
    expected = scaled.img_from_cam(np.array([[(909.5 - 479.5) / 570.0, 0.0, 1.0]]))[0]
    assert middle == pytest.approx(expected, abs=0.05)


def test_a_patch_without_texture_matches_nothing():
    flat = np.full((60, 60), 90, np.uint8)
    pixels, correlations, _ = align_patches(
        flat,
        flat[None],
        np.array([flat.shape]),
        np.zeros(1, np.int64),
        np.array([[30.0, 30.0]]),
        np.array([[30.0, 30.0]]),
        np.eye(2)[None],
        11,
        4,
        2.0,
    )
    assert np.isnan(correlations[0])
    assert np.isnan(pixels).all()


def test_an_edge_fixes_a_pixel_across_it_alone():
    rng = np.random.default_rng(0)
    columns, rows = np.meshgrid(np.arange(60.0), np.arange(60.0))
    edge = np.clip(128.0 + 20.0 * (columns - 30.0 + 0.05 * rng.normal(size=(60, 1))), 40.0, 200.0)
    image = (edge + rng.normal(size=(60, 60))).astype(np.uint8)
    corner = np.where(rows < 30.0, image, 40).astype(np.uint8)
    middle = np.array([[30.0, 30.0]])
    bends = []
    for picture in (image, corner):
        seen = picture, picture[None], np.array([picture.shape]), np.zeros(1, np.int64)
        *_, bend = align_patches(*seen, middle, middle.copy(), np.eye(2)[None], 11, 3, 2.0)
        bends.append(bend[0])
    (along, across), directions = np.linalg.eigh(bends[0])
    assert across > 0.01
    assert along < 0.05 * across
    assert abs(directions[0, 1]) > 0.99  # the edge is upright
    assert np.linalg.eigvalsh(bends[1])[0] > 5.0 * max(along, 0.0)
