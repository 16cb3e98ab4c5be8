"""Test virtual views to the left and right: equal rays, a wall without slant, and no pixel
outside of the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from tiny_world import LEVEL_FROM_CAM, Panel, render
from topoloc.features.extraction import VirtualView, make_virtual_views
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3

CAMERAS = {
    "pinhole": Camera.pinhole(480, 320, 240.0, 250.0, 231.5, 166.5),
    # EuRoC's left camera.
    "distorted": Camera(
        "OPENCV",
        752,
        480,
        (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    ),
    "fisheye": Camera(
        "OPENCV_FISHEYE", 640, 480, (350.0, 351.0, 322.0, 238.0, 0.01, -0.02, 0.005, -0.001)
    ),
    # The ends of its rows see behind the camera.
    "wider than half of all": Camera(
        "OPENCV_FISHEYE", 800, 600, (220.0, 220.0, 399.5, 299.5, 0.0, 0.0, 0.0, 0.0)
    ),
}
SIDES = {"left": -1.0, "right": 1.0}
WORLD_FROM_CAM = Rigid3(LEVEL_FROM_CAM, np.zeros(3))
TEXELS_PER_METRE = 90.0


def features_at(points_img: np.ndarray) -> Features:
    one = np.ones(len(points_img), np.float32)
    return Features(
        points_img.astype(np.float32), one, one, one, np.ones((len(points_img), 1), np.float32)
    )


def wall(name: str, texture: np.ndarray) -> Panel:
    """Return a wall along the path, one metre to this side of the camera at `WORLD_FROM_CAM`. It
    begins beside the camera, and its texture is upright and not mirrored."""
    along = np.array([0.0, -SIDES[name], 0.0])
    half = (texture.shape[1] / TEXELS_PER_METRE / 2.0, texture.shape[0] / TEXELS_PER_METRE / 2.0)
    return Panel(
        np.array([SIDES[name], half[0], 0.0]), along, np.array([0.0, 0.0, -1.0]), half, texture
    )


def view_of(name: str, camera: Camera) -> VirtualView:
    return {view.name: view for view in make_virtual_views(camera)}[name]


def seen(name: str, camera: Camera, texture: np.ndarray) -> tuple[VirtualView, np.ndarray]:
    """Return the virtual view of such a wall, and its image."""
    view, (picture, _) = (
        view_of(name, camera),
        render([wall(name, texture)], WORLD_FROM_CAM, camera),
    )
    return view, view.picture(picture)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_there_is_one_view_to_each_side_and_it_contains_the_path_ahead(camera: Camera):
    assert [view.name for view in make_virtual_views(camera)] == list(SIDES)
    for view in make_virtual_views(camera):
        assert max(view.camera.width, view.camera.height) <= 700
        to_the_side = view.cam_from_virtual.rotation[:, 2]
        np.testing.assert_allclose(to_the_side, [SIDES[view.name], 0.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(
            view.cam_from_virtual.rotation[:, 1], [0.0, 1.0, 0.0], atol=1e-12
        )  # upright
        assert np.linalg.det(view.cam_from_virtual.rotation) == pytest.approx(1.0)
        assert view.inside.mean() > 0.5


@given(
    camera=st.sampled_from(list(CAMERAS.values())),
    side=st.sampled_from([0, 1]),
    at=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_a_pixel_and_its_source_pixel_have_one_direction(
    camera: Camera, side: int, at: tuple[float, float]
):
    view = make_virtual_views(camera)[side]
    rows, columns = np.nonzero(view.inside)
    k = round(at[0] * (len(rows) - 1))
    row, column = int(rows[k]), int(columns[k])
    point_img = view.points_img[row, column].astype(np.float64)
    assert (point_img >= 0).all()
    assert (point_img <= [camera.width - 1, camera.height - 1]).all()
    ray = (
        view.camera.rays_from_img(np.array([[column, row]], np.float64))
        @ view.cam_from_virtual.rotation.T
    )
    np.testing.assert_allclose(camera.rays_from_img(point_img[None]), ray, atol=1e-5)
    back = view.to_image_pixels(features_at(np.array([[column, row]])), camera)
    np.testing.assert_allclose(back.points_img[0], point_img, atol=1e-3)


@given(
    camera=st.sampled_from(list(CAMERAS.values())),
    side=st.sampled_from([0, 1]),
    seed=st.integers(0, 1000),
)
def test_features_between_pixels_are_the_points_of_the_same_wall_in_the_picture(
    camera: Camera, side: int, seed: int
):
    """Compute the point of the wall without the view's own tables."""
    view, rng = make_virtual_views(camera)[side], np.random.default_rng(seed)
    ahead, up, distance = (
        rng.uniform(1.7, 2.8, 20),
        rng.uniform(-0.4, 0.4, 20),
        rng.uniform(0.5, 4.0),
    )
    points_cam = distance * np.column_stack([np.full(20, SIDES[view.name]), up, ahead])
    points_side = view.cam_from_virtual.inverse().apply(points_cam)
    np.testing.assert_allclose(
        points_side[:, 2], distance
    )  # no slant: the depth of the wall is constant
    features = features_at(view.camera.img_from_cam(points_side))
    np.testing.assert_allclose(
        view.to_image_pixels(features, camera).points_img,
        camera.img_from_cam(points_cam),
        atol=5e-3,
    )
    assert len(view.to_image_pixels(features, camera)) == 20


LETTER = np.array(
    [
        [1, 1, 1, 1],
        [1, 0, 0, 0],
        [1, 1, 1, 0],
        [1, 0, 0, 0],
        [1, 0, 0, 0],
    ],
    np.float32,
)  # an F


def in_grey(cells: np.ndarray, cell_m: float) -> np.ndarray:
    """Return a texture with cells of this size (metres)."""
    return np.kron(40.0 + 170.0 * cells, np.ones((round(cell_m * TEXELS_PER_METRE),) * 2)).astype(
        np.float32
    )


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("name", SIDES)
def test_lettering_on_a_wall_stays_readable(name: str, camera: Camera):
    sheet = np.zeros((9, 28), np.float32)
    # 2 m ahead: on the right in a view of the left wall, on the left in a view of the right wall
    first = 19 if name == "left" else 5
    sheet[2:7, first : first + 4] = LETTER
    view, picture = seen(name, camera, in_grey(sheet, 0.1))
    metres = np.array(
        [
            [(first + 0.5 + i) * 0.1 - 1.4, (j + 0.5) * 0.1 - 0.45]
            for j in range(2, 7)
            for i in range(4)
        ]
    )
    ahead = 1.4 + (metres[:, 0] if name == "left" else -metres[:, 0])
    points_side = np.column_stack(
        [ahead if name == "left" else -ahead, metres[:, 1], np.ones(len(metres))]
    )
    columns, rows = np.rint(view.camera.img_from_cam(points_side)).astype(int).T
    read = (picture[rows, columns].reshape(5, 4) > 125).astype(np.float32)
    np.testing.assert_array_equal(read, LETTER)
    assert (np.diff(columns.reshape(5, 4)[0]) > 0).all()  # from left to right


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("name", SIDES)
def test_a_wall_along_the_path_has_the_same_scale_everywhere(name: str, camera: Camera):
    """Bars of 0.2 m have equal widths from near to far. A pixel of the slanted wall
    covers up to 4 cm."""
    view, picture = seen(
        name, camera, in_grey(np.tile(np.arange(18) % 2, (5, 1)).astype(np.float32), 0.2)
    )
    row = round(view.camera.cy)
    held = np.flatnonzero(view.inside[row])
    bright = (picture[row, held[0] : held[-1] + 1] > 125).astype(int)
    edges = np.flatnonzero(np.diff(bright)) + held[0]
    metres_ahead = (edges + 0.5 - view.camera.cx) / view.camera.fx * -SIDES[name]
    steps = metres_ahead / 0.2
    np.testing.assert_allclose(0.2 * (steps - np.rint(steps)), 0.0, atol=0.03)
    assert len(set(np.rint(steps))) == len(edges) >= 5


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_pixels_outside_of_the_image_are_dropped(camera: Camera):
    for view in make_virtual_views(camera):
        rows, columns = np.mgrid[0 : view.camera.height : 3, 0 : view.camera.width : 3]
        everywhere = features_at(np.column_stack([columns.ravel(), rows.ravel()]))
        kept = view.select_inside(everywhere)
        assert 0 < len(kept) < len(everywhere)
        points_img = view.to_image_pixels(kept, camera).points_img
        assert (points_img >= 0).all()
        assert (points_img <= [camera.width - 1, camera.height - 1]).all()
        # and all that is well within is kept
        points_img = view.to_image_pixels(everywhere, camera).points_img
        with np.errstate(invalid="ignore"):
            deep = ((points_img > 40) & (points_img < [camera.width - 41, camera.height - 41])).all(
                axis=1
            )
        last = np.array([view.camera.width - 1, view.camera.height - 1])
        deep &= ((everywhere.points_img >= 16) & (everywhere.points_img <= last - 16)).all(axis=1)
        assert deep.any()
        assert view.inside[
            everywhere.points_img[deep, 1].astype(int), everywhere.points_img[deep, 0].astype(int)
        ].all()
        assert len(view.select_inside(Features.empty(1))) == 0


@pytest.mark.parametrize(("share", "num_views"), [(0.3, 2), (0.95, 2), (1.05, 0), (4.0, 0)])
def test_the_number_of_views_depends_on_the_field_of_view(share: float, num_views: int):
    focal = share * 239.5 * 1.5
    assert (
        len(make_virtual_views(Camera.pinhole(480, 320, focal, focal, 239.5, 159.5))) == num_views
    )


def test_a_camera_with_a_shifted_centre_may_have_one_virtual_view():
    views = make_virtual_views(Camera.pinhole(480, 320, 400.0, 400.0, 120.0, 159.5))
    assert [view.name for view in views] == ["right"]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_the_nearest_part_of_a_view_ends_at_its_tangent(camera: Camera):
    for view in make_virtual_views(camera):
        is_near = np.zeros(view.camera.width, bool)
        is_near[view.columns_within(2.0)] = True
        pixels = np.column_stack([np.arange(view.camera.width), np.zeros(view.camera.width)])
        ahead = np.abs(view.camera.normalized_from_img(pixels)[:, 0])
        one_pixel = 1.5 / view.camera.fx
        assert ahead[is_near].max() <= 2.0 + one_pixel
        assert ahead[~is_near].min() >= 2.0 - one_pixel
