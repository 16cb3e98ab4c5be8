"""Test surf-vlad: the vectors of places, the learned words, and the rank of the right node."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tiny_world
import topoloc
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.features import Features
from topoloc.mapping.build import BuildConfig, build_node_map
from topoloc.mapping.nodes import NodeConfig, NodePoses, node_distances
from topoloc.recordings.frame import to_grey
from topoloc.retrieval.coarse import CoarseLocalizer, VladConfig, open_coarse_localizer
from topoloc.retrieval.vlad import (
    SurfVlad,
    append_positions,
    learn_words,
    learn_words_from_parts,
    vlad,
)

NO_IMAGE = np.zeros((2, 2), np.uint8)


def unit(array: np.ndarray) -> np.ndarray:
    return (array / np.maximum(np.linalg.norm(array, axis=-1, keepdims=True), 1e-12)).astype(
        np.float32
    )


def descriptors(num: int, seed: int, centres: np.ndarray | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((num, 64))
    return unit(
        noise
        if centres is None
        else 2.0 * centres[rng.integers(0, len(centres), num)] + 0.1 * noise
    )


def feature_config_for(rows: np.ndarray) -> Features:
    zero = np.zeros(len(rows), np.float32)
    return Features(np.zeros((len(rows), 2), np.float32), zero, zero, zero, rows)


def fitted(
    num_images: int, images_a_node: int = 2, dimension: int = 128, num_words: int = 8
) -> tuple[SurfVlad, list[np.ndarray]]:
    """Return a localizer of places with different descriptors, and the descriptors
    of their images."""
    rows = [
        descriptors(
            120, k, unit(np.random.default_rng(1000 + k // images_a_node).standard_normal((10, 64)))
        )
        for k in range(num_images)
    ]
    config = VladConfig(num_words=num_words, dimension=dimension, position_weight=0.0)
    words = learn_words(np.concatenate(rows), config)
    return SurfVlad.fit(
        words,
        np.stack([vlad(r, words) for r in rows]),
        np.arange(num_images) // images_a_node,
        config,
    ), rows


def test_vlad_is_the_sum_of_residuals_normalised_thrice():
    words, rows = descriptors(5, 1), descriptors(200, 2)
    nearest = np.argmin(np.linalg.norm(rows[:, None] - words[None], axis=2), axis=1)
    expected = np.zeros_like(words)
    for k in range(5):
        expected[k] = unit(unit(rows[nearest == k] - words[k]).sum(axis=0))
    np.testing.assert_allclose(vlad(rows, words), unit(expected.reshape(-1)), atol=1e-5)


def test_vlad_does_not_depend_on_the_order_of_features():
    words, rows = descriptors(5, 1), descriptors(300, 2)
    np.testing.assert_allclose(vlad(rows, words), vlad(rows[::-1].copy(), words), atol=1e-5)


def test_no_features_give_a_vector_of_zeros():
    assert vlad(np.zeros((0, 64), np.float32), descriptors(4, 1)).tolist() == [0.0] * 256


def test_a_descriptor_that_is_a_word_adds_nothing():
    words = descriptors(4, 1)
    assert np.abs(vlad(words[:1], words)).max() == 0.0


def test_words_are_the_clusters_there_are():
    centres = unit(np.random.default_rng(4).standard_normal((6, 64)))
    words = learn_words(descriptors(3000, 5, centres), VladConfig(num_words=24))
    assert words.shape == (24, 64)
    assert (unit(words) @ centres.T).max(axis=0).min() > 0.95  # every cluster has a word


def test_few_descriptors_give_few_words():
    config = VladConfig(num_words=32)
    assert len(learn_words(descriptors(100, 1), config)) == 2
    assert len(learn_words(descriptors(3, 1), config)) == 1


def test_words_are_the_same_each_time():
    rows = descriptors(3000, 6)
    once, again = (
        learn_words_from_parts([3000], lambda _: rows, VladConfig(num_words=16), 2000)
        for _ in range(2)
    )
    np.testing.assert_array_equal(once, again)


@pytest.mark.parametrize("limit", [40, 10_000])
def test_words_of_parts_are_those_of_all(limit: int):
    parts = [descriptors(count, seed=count) for count in (50, 1, 200)]
    config, every = VladConfig(num_words=2), np.concatenate(parts)
    words = learn_words_from_parts([len(part) for part in parts], lambda k: parts[k], config, limit)
    whole = learn_words_from_parts([len(every)], lambda _: every, config, limit)
    np.testing.assert_array_equal(words, whole)


@pytest.mark.parametrize("dimension", [128, 4])
def test_a_place_seen_again_comes_first(dimension: int):
    localizer, rows = fitted(24, dimension=dimension)
    assert isinstance(localizer, CoarseLocalizer)
    for k, image_rows in enumerate(rows):
        ranking = localizer.rank(NO_IMAGE, feature_config_for(image_rows[::2]), 5)
        assert ranking[0].row == k // 2
        assert len({score.row for score in ranking}) == 5
        assert sorted((score.score for score in ranking), reverse=True) == [
            score.score for score in ranking
        ]


def things(order: np.ndarray) -> Features:
    """Return sixty objects side by side in an image 200 pixels wide. Images differ only
    in their order."""
    things_seen = descriptors(60, 11)
    zero = np.zeros(60, np.float32)
    columns = np.stack([3.0 + 3.25 * np.arange(60), np.full(60, 50.0)], axis=1).astype(np.float32)
    return Features(columns, zero, zero, zero, things_seen[order])


@pytest.mark.parametrize("weight", [0.0, 0.9])
def test_the_same_things_elsewhere_in_the_picture_are_another_place(weight: float):
    orders = [np.random.default_rng(k).permutation(60) for k in range(12)]
    config = VladConfig(num_words=4, position_weight=weight)
    seen = [append_positions(things(order), 200, 100, config) for order in orders]
    words = learn_words(np.concatenate(seen), config)
    localizer = SurfVlad.fit(words, np.stack([vlad(s, words) for s in seen]), np.arange(12), config)
    again = SurfVlad.from_model(localizer.to_model())
    picture = np.zeros((100, 200), np.uint8)
    named = [
        again.rank(picture, things(order).select(np.arange(3, 60)), 1)[0].row for order in orders
    ]
    num_right = sum(node_id == k for k, node_id in enumerate(named))
    assert num_right == 12 if weight > 0.0 else num_right < 6


def test_positions_are_relative_to_the_image_size():
    features = things(np.arange(60))
    small = append_positions(features, 200, 100, VladConfig(position_weight=0.5))
    assert small.shape == (60, 66)
    np.testing.assert_allclose(
        small[[0, -1], 64], [0.5 * (3.5 / 200 - 0.5), 0.5 * (195.25 / 200 - 0.5)], atol=1e-6
    )
    large = append_positions(
        replace(features, points_img=2.0 * features.points_img + 0.5),
        400,
        200,
        VladConfig(position_weight=0.5),
    )
    np.testing.assert_allclose(small, large, atol=1e-6)


def test_maps_without_places_in_their_words_are_read():
    localizer, rows = fitted(6)
    model = localizer.to_model()
    old = replace(
        model,
        settings={key: value for key, value in model.settings.items() if key != "position_weight"},
    )
    assert SurfVlad.from_model(old).rank(NO_IMAGE, feature_config_for(rows[3]), 1)[0].row == 1


def test_more_images_than_dimensions():
    localizer, rows = fitted(150, images_a_node=10, num_words=2)
    assert len(rows) > 2 * 64
    assert localizer.rank(NO_IMAGE, feature_config_for(rows[37][::2]), 1)[0].row == 3


@pytest.mark.parametrize("num_images", [1, 2])
def test_maps_of_one_or_two_images(num_images: int):
    localizer, rows = fitted(num_images, images_a_node=1)
    ranking = localizer.rank(NO_IMAGE, feature_config_for(rows[-1]), 5)
    assert len(ranking) == num_images
    assert ranking[0].row == num_images - 1
    assert ranking[0].score == pytest.approx(1.0, abs=1e-4)


def test_images_all_alike_are_ranked_all_the_same():
    rows, config = descriptors(400, 1), VladConfig(num_words=4, position_weight=0.0)
    words = learn_words(rows, config)
    localizer = SurfVlad.fit(words, np.tile(vlad(rows, words), (5, 1)), np.arange(5), config)
    ranking = localizer.rank(NO_IMAGE, feature_config_for(rows), 5)
    assert [score.row for score in ranking] == [0, 1, 2, 3, 4]
    assert [score.score for score in ranking] == pytest.approx([1.0] * 5, abs=1e-5)


def test_an_image_without_features_is_ranked_somehow():
    localizer, _ = fitted(6)
    ranking = localizer.rank(NO_IMAGE, Features.empty(64), 3)
    assert len(ranking) == 3
    assert np.isfinite([score.score for score in ranking]).all()


def test_the_stored_model_ranks_alike():
    localizer, rows = fitted(30)
    model = localizer.to_model()
    assert model.name == "surf-vlad"
    reopened = open_coarse_localizer(model)
    for image_rows in rows:
        one, other = (
            c.rank(NO_IMAGE, feature_config_for(image_rows[:60]), 3) for c in (localizer, reopened)
        )
        assert one[0].row == other[0].row
        np.testing.assert_allclose([s.score for s in one], [s.score for s in other], atol=5e-3)


def share_of_near_candidates(map_part: str, query_part: str, config: BuildConfig) -> float:
    """Return the share of queries with a node within 2 D_thresh (Eq. 1) among the five best."""
    topomap = build_node_map(topoloc.open_sequence(map_part), config)
    nodes = NodePoses.from_poses([summary.world_from_cam for summary in topomap.summaries])
    coarse = open_coarse_localizer(topomap.first_layer.coarse_models["surf-vlad"])
    queries = topoloc.open_sequence(query_part)
    near = []
    for frame, pose in zip((queries[k] for k in range(len(queries))), queries.poses, strict=True):
        assert pose is not None
        features = extract_features(to_grey(frame.image), FeatureConfig())
        candidates = [score.row for score in coarse.rank(frame.image, features, 5)]
        distances = node_distances(pose, nodes, topomap.config.lambda_rot)
        near.append(distances[candidates].min() <= 2 * topomap.config.d_thresh)
    return float(np.mean(near))


def test_the_right_node_is_found_in_a_kitchen(shared: Path):
    folder = shared / "data" / "seven_scenes" / "kitchen" / "seq-01"
    config = BuildConfig(nodes=NodeConfig(d_thresh=0.25, lambda_rot=1.0))
    assert share_of_near_candidates(f"{folder}@0:250:10", f"{folder}@3:250:13", config) >= 0.95


def test_the_right_node_is_found_in_the_rendered_room(tiny_recording: Path):
    assert tiny_world.NUM_FRAMES == 14
    config = BuildConfig(nodes=NodeConfig(d_thresh=0.2, lambda_rot=1.0))
    assert (
        share_of_near_candidates(f"{tiny_recording}@0::2", f"{tiny_recording}@1::2", config) == 1.0
    )
