"""Test features of a network, with networks made by the tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tiny_network import STRIDE, cells, write_network
from topoloc.errors import WeightsError
from topoloc.features import learned
from topoloc.features.dense import SingleLevelDescriptors
from topoloc.features.feature_types import check_available, default_learned_type
from topoloc.features.learned import extract_learned, find_maxima, refine_subpixel, run_network

CONFIG = ("xfeat", 64, 1000, 0.05)


@pytest.fixture
def network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write XFeat's file as a network that returns the image as its scores."""
    monkeypatch.setenv("TOPOLOC_CACHE", str(tmp_path))
    return write_network(tmp_path / "xfeat.onnx")


def _bumps(centres: list[tuple[float, float]], height: int, width: int) -> np.ndarray:
    """Return scores with a Gaussian bump around each (x, y), so that their logarithm is a parabola.
    The first bump is the highest."""
    y, x = np.mgrid[:height, :width]
    bumps = [
        (0.9 - 0.1 * k) * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8.0)
        for k, (u, v) in enumerate(centres)
    ]
    return np.max(bumps, axis=0).astype(np.float32)


# at the highest scores


def test_key_points_lie_at_the_tops_to_a_fraction_of_a_pixel():
    centres = [(20.3, 15.8), (40.0, 30.0), (55.5, 9.25), (9.9, 38.6)]
    scores = _bumps(centres, 48, 64)
    pixels, found = find_maxima(scores, 48, 64, 4, np.float32(0.1))
    points = refine_subpixel(scores, pixels)
    order = np.argsort(-found)
    np.testing.assert_allclose(points[order], centres, atol=0.01)
    np.testing.assert_allclose(found[order], [0.9, 0.8, 0.7, 0.6], atol=0.06)


def test_no_key_point_lies_at_the_border_or_in_the_padding():
    scores = _bumps(
        [
            (30.0, 20.0),
            (3.0, 20.0),
            (4.0, 40.0),
            (59.0, 10.0),
            (60.0, 30.0),
            (20.0, 45.0),
            (45.0, 44.0),
            (40.0, 2.0),
        ],
        64,
        64,
    )
    points, _ = find_maxima(
        scores, 48, 64, 4, np.float32(0.1)
    )  # the image ends at row 48, the scores do not
    assert (
        len(find_maxima(scores, 8, 64, 4, np.float32(0.1))[0])
        == len(find_maxima(scores, 48, 7, 4, np.float32(0.1))[0])
        == 0
    )
    np.testing.assert_allclose(
        points[np.argsort(points[:, 0])], [(4.0, 40.0), (30.0, 20.0), (59.0, 10.0)], atol=0.01
    )


def test_weak_maxima_and_neighbours_of_stronger_ones_are_dropped():
    scores = np.zeros((32, 32), np.float32)
    scores[10, 10], scores[10, 12], scores[8, 11] = (
        0.5,
        0.4,
        0.3,
    )  # within two pixels of the strongest
    scores[20, 20] = scores[20, 21] = scores[21, 20] = scores[22, 22] = 0.2
    scores[25, 8] = 0.1
    points, found = find_maxima(scores, 32, 32, 4, np.float32(0.1))
    assert sorted(np.rint(points).tolist()) == [[10.0, 10.0], [20.0, 20.0]]
    np.testing.assert_array_equal(found, np.array([0.5, 0.2], np.float32))


def test_key_points_are_the_maxima_of_their_windows():
    """Compare with all windows of random scores. Few values make many of them equal."""
    scores = np.random.default_rng(7).integers(0, 30, (40, 56)).astype(np.float32) / 30
    pixels, found = find_maxima(scores, 37, 50, 4, np.float32(0.3))
    expected = []
    for y in range(4, 33):
        for x in range(4, 46):
            window = scores[y - 2 : y + 3, x - 2 : x + 3]
            first = np.argwhere(window == window.max())[0]  # row by row
            if scores[y, x] > 0.3 and first.tolist() == [2, 2]:
                expected.append([x, y])
    assert pixels.tolist() == expected
    assert len(expected) > 20
    np.testing.assert_array_equal(found, scores[pixels[:, 1], pixels[:, 0]])


# descriptors between the grid's points


def _bilinear(dense: np.ndarray, points: np.ndarray, stride: float) -> np.ndarray:
    """Interpolate in NumPy. Beyond the outermost points of the grid, the values stay constant."""
    rows, columns = dense.shape[1:]
    u, v = (
        np.clip((points[:, k] + 0.5) / stride - 0.5, 0, n - 1) for k, n in ((0, columns), (1, rows))
    )
    x, y = (
        np.minimum(np.floor(u).astype(int), columns - 2),
        np.minimum(np.floor(v).astype(int), rows - 2),
    )
    s, t = u - x, v - y
    above = (1 - s) * dense[:, y, x] + s * dense[:, y, x + 1]
    below = (1 - s) * dense[:, y + 1, x] + s * dense[:, y + 1, x + 1]
    found = ((1 - t) * above + t * below).T
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_descriptors_are_bilinear_and_of_unit_length():
    rng = np.random.default_rng(1)
    dense = rng.normal(size=(16, 5, 7)).astype(np.float32)
    points = (rng.random((200, 2)) * (7 * STRIDE - 1, 5 * STRIDE - 1)).astype(np.float32)
    points[:4] = [(0, 0), (55, 39), (0, 39), (3.5, 3.5)]
    found = SingleLevelDescriptors(dense, float(STRIDE)).sample(points)
    np.testing.assert_allclose(
        found, _bilinear(dense.astype(np.float64), points.astype(np.float64), STRIDE), atol=1e-5
    )
    at_a_point = dense[:, 0, 0] / np.linalg.norm(dense[:, 0, 0])
    np.testing.assert_allclose(found[3], at_a_point, atol=1e-6)  # the middle of the first cell


# pictures


@pytest.mark.parametrize(("height", "width"), [(96, 128), (100, 131), (33, 64), (31, 40)])
def test_pictures_of_any_size_are_continued_by_their_border(network: Path, height: int, width: int):
    picture = np.random.default_rng(2).integers(0, 256, (height, width), dtype=np.uint8)
    answer = run_network(picture, "xfeat")
    assert answer.places is None
    assert isinstance(answer.dense, SingleLevelDescriptors)
    scores, dense = answer.scores, answer.dense.planes
    assert scores.shape == (32 * -(-height // 32), 32 * -(-width // 32))
    assert dense.shape == (64, scores.shape[0] // STRIDE, scores.shape[1] // STRIDE)
    np.testing.assert_allclose(scores[:height, :width], picture / 255.0, atol=1e-6)
    np.testing.assert_array_equal(
        scores[height:, :width], np.tile(scores[height - 1, :width], (len(scores) - height, 1))
    )
    np.testing.assert_array_equal(
        scores[:, width:], np.tile(scores[:, width - 1 : width], (1, scores.shape[1] - width))
    )
    first = np.einsum("cij,ij->c", cells()[:, 0], scores[:STRIDE, :STRIDE])
    np.testing.assert_allclose(dense[:, 0, 0], first, atol=1e-4)


def test_features_are_the_strongest_first_with_the_descriptors_of_their_places(network: Path):
    picture = (
        255 * _bumps([(70.0, 20.0), (20.0, 30.0), (50.0, 50.0), (90.0, 60.0)], 75, 110)
    ).astype(np.uint8)
    features = extract_learned(picture, *CONFIG)
    np.testing.assert_allclose(
        features.points_img, [(70, 20), (20, 30), (50, 50), (90, 60)], atol=0.1
    )
    assert (np.diff(features.responses) < 0).all()
    assert (np.ptp(features.sizes_px), np.ptp(features.angles)) == (0.0, 0.0)
    dense = run_network(picture, "xfeat").dense
    assert isinstance(dense, SingleLevelDescriptors)
    expected = _bilinear(dense.planes, features.points_img, STRIDE)
    np.testing.assert_allclose(features.descriptors, expected, atol=1e-4)
    np.testing.assert_array_equal(
        extract_learned(picture, "xfeat", 64, 2, 0.05).points_img,
        features.points_img[:2],
    )


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (8, 400), (240, 320)], ids=str)
def test_a_picture_without_any_gives_none(network: Path, size: tuple[int, int]):
    features = extract_learned(np.zeros(size, np.uint8), *CONFIG)
    assert len(features) == 0
    assert features.descriptors.shape == (0, 64)


def test_the_same_on_any_number_of_threads(network: Path):
    picture = np.random.default_rng(3).integers(0, 256, (120, 160), dtype=np.uint8)
    one, two = (
        extract_learned(picture, "xfeat", 64, 500, 0.05, num_threads) for num_threads in (1, 2)
    )
    np.testing.assert_array_equal(one.points_img, two.points_img)
    np.testing.assert_array_equal(one.descriptors, two.descriptors)


# means per cell


def test_cells_are_means_over_the_picture_and_nothing_beyond_it(network: Path):
    learned._session_for_size.cache_clear()
    write_network(network, outputs=("scores", "descriptors", "places"))
    picture = np.random.default_rng(4).integers(
        0, 256, (96, 144), dtype=np.uint8
    )  # continued to 96x160
    features = extract_learned(picture, *CONFIG)
    assert features.cells is not None
    expected = picture.reshape(4, 24, 6, 24).mean(axis=(1, 3)) / 255.0
    np.testing.assert_allclose(features.cells[:, :, 0], expected, atol=1e-5)
    assert features.select(np.arange(2)).cells is None  # only for the whole image
    small = extract_learned(picture[:8, :8], *CONFIG).cells
    assert small is not None
    np.testing.assert_allclose(small, np.full((4, 6, 1), picture[:8, :8].mean() / 255.0), atol=1e-5)


def test_networks_without_have_none(network: Path):
    assert extract_learned(np.zeros((64, 64), np.uint8), *CONFIG).cells is None


# missing and unsuitable networks


def _refused(network: str = "xfeat", descriptor_size: int = 64) -> str:
    with pytest.raises(WeightsError) as caught:
        extract_learned(np.zeros((64, 64), np.uint8), network, descriptor_size)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_damaged_missing_or_other_network_is_one_line(network: Path):
    assert "descriptors of 64 numbers, not 32" in _refused(descriptor_size=32)
    write_network(network.with_name("edgepoint2-t32.onnx"), "edgepoint2-s64")
    assert "holds edgepoint2-s64, not edgepoint2-t32" in _refused("edgepoint2-t32")
    assert "`topoloc weights get edgepoint2-e64`" in _refused("edgepoint2-e64")
    learned._session_for_size.cache_clear()
    network.write_bytes(network.read_bytes()[:500])
    assert "cut short, damaged, or not ONNX" in _refused()


def test_learned_features_are_those_of_the_network_that_comes_along():
    assert default_learned_type() == "topoloc-net"
    check_available("surf")
    with pytest.raises(WeightsError, match="`topoloc weights get edgepoint2-s64`"):
        check_available("edgepoint2-s64")
