"""Test cnn-fc: it learns with equal results in each run, and handles interruptions and damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_place_vectors import NO_FEATURES, silent

from built_room import unseen_views
from topoloc.errors import MapError, TrainingError
from topoloc.recordings.stored_images import decode_stored_image
from topoloc.retrieval.coarse import CoarseModel, open_coarse_localizer
from topoloc_training import cnn_fc, frozen_maps, training
from topoloc_training.backbones import Backbone
from topoloc_training.classifier_config import (
    AugmentationConfig,
    CnnFcConfig,
    NetworkInputConfig,
    TrainingConfig,
)
from topoloc_training.cnn_fc import CnnFc, calibrated_temperature, soft_labels
from topoloc_training.training_set import TrainingSet
from topoloc_training.weights import Weights, read_weights

TINY = NetworkInputConfig(64, 48)


def config(num_epochs: int, **settings: float) -> CnnFcConfig:
    how = TrainingConfig(
        max_epochs=num_epochs, patience=num_epochs, batch_size=7, held_out=0.0, num_threads=1
    )
    return CnnFcConfig(
        TINY, replace(how, **settings), AugmentationConfig(occlusion=0.0), label_spread=0.0
    )


def train(room_set: TrainingSet, how: CnnFcConfig, checkpoint: Path | None = None) -> CoarseModel:
    return cnn_fc.train(room_set, "compact", None, how, silent, checkpoint)


def test_from_nothing_it_learns_the_room(room_set: TrainingSet):
    model = train(room_set, config(110, learning_rate=3e-3))
    localizer = open_coarse_localizer(model)
    assert isinstance(localizer, CnnFc)
    pictures = [decode_stored_image(jpeg) for jpeg in room_set.jpegs]
    answers = [ranking[0].row for ranking in localizer.rank_batch(pictures, 1)]
    assert np.mean(np.array(answers) == room_set.node_ids) > 0.9
    probabilities = localizer.probabilities([unseen_views()[0][0]])
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-5)
    ranking = localizer.rank(unseen_views()[0][0], NO_FEATURES, 3)
    assert [score.score for score in ranking] == sorted(
        (float(p) for p in probabilities[0]), reverse=True
    )[:3]


def same(first: CoarseModel, second: CoarseModel) -> bool:
    return all(np.array_equal(first.arrays[key], second.arrays[key]) for key in first.arrays)


def test_an_interrupted_training_goes_on_to_the_same_bytes(
    room_set: TrainingSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    whole = train(room_set, config(4))
    assert same(whole, train(room_set, config(4)))
    assert not same(whole, train(room_set, config(4, seed=1)))
    epochs = 0

    def interrupted(*args: object) -> str:
        nonlocal epochs
        epochs += 1
        if epochs == 3:
            raise KeyboardInterrupt
        return train_epoch(*args)  # pyright: ignore[reportArgumentType]

    train_epoch = training._train_epoch
    monkeypatch.setattr(training, "_train_epoch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(room_set, config(4), tmp_path / "training.ckpt")
    monkeypatch.undo()
    resumed = train(room_set, config(4), tmp_path / "training.ckpt")
    assert same(whole, resumed)
    assert resumed.settings["trained"] == whole.settings["trained"]


def test_a_checkpoint_of_another_training_or_a_broken_one_is_refused(
    room_set: TrainingSet, tmp_path: Path
):
    path = tmp_path / "training.ckpt"
    train(room_set, config(1), path)
    with pytest.raises(TrainingError, match="is of another training"):
        train(room_set, config(2), path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(TrainingError, match="truncated, damaged or no checkpoint"):
        train(room_set, config(1), path)


def test_a_loss_that_is_not_finite_ends_with_the_last_good_state(
    room_set: TrainingSet, monkeypatch: pytest.MonkeyPatch
):
    augment = frozen_maps.augment
    calls = 0

    def spoilt(pictures: torch.Tensor, *args: object) -> torch.Tensor:
        nonlocal calls
        calls += 1
        return augment(pictures, *args) * (torch.nan if calls > after else 1.0)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(frozen_maps, "augment", spoilt)
    after = 4  # two batches an epoch
    model = train(room_set, config(6))
    assert model.settings["trained"]["stopped_by"] == "the loss was not finite in epoch 3"
    assert all(np.isfinite(value).all() for value in model.arrays.values())
    after, calls = 0, 0
    with pytest.raises(TrainingError, match="not finite in epoch 1"):
        train(room_set, config(6))


def test_one_node_and_nodes_with_one_image(two_images: TrainingSet, room_set: TrainingSet):
    localizer = open_coarse_localizer(train(two_images, config(1)))
    assert [(s.row, s.score) for s in localizer.rank(unseen_views()[0][0], NO_FEATURES, 5)] == [
        (0, 1.0)
    ]
    rows = [
        int(np.flatnonzero(room_set.node_ids == node)[0]) for node in np.unique(room_set.node_ids)
    ]
    lonely = replace(
        room_set,
        jpegs=[room_set.jpegs[row] for row in rows],
        world_from_cams=[room_set.world_from_cams[row] for row in rows],
        node_ids=room_set.node_ids[rows],
        node_distances=room_set.node_distances[rows],
    )
    model = train(lonely, config(1, held_out=0.5))
    assert model.settings["trained"]["num_held_out"] == 0
    assert model.settings["temperature"] == 1.0


def test_training_begins_with_given_weights(two_images: TrainingSet, random_file: Path):
    weights = read_weights(random_file, "squeezenet1_1")
    still = config(1, learning_rate=0.0)
    model = cnn_fc.train(two_images, "squeezenet1_1", weights, still, silent)
    kept = torch.from_numpy(model.arrays["network.backbone.features.0.weight"])
    assert torch.equal(kept, weights.tensors["features.0.weight"].half())
    assert model.settings["weights"]["sha256"] == weights.sha256


def learned(model: CoarseModel, weights: Weights) -> set[int]:
    """Return the backbone layers whose weights differ from the file."""
    names = [name for name in weights.tensors if name.startswith("features.")]
    changed = [
        name
        for name in names
        if not np.array_equal(
            model.arrays[f"network.backbone.{name}"], weights.tensors[name].half().numpy()
        )
    ]
    return {int(name.split(".")[1]) for name in changed}


def test_the_last_layers_learn_and_those_before_keep_their_weights(
    room_set: TrainingSet, random_file: Path, monkeypatch: pytest.MonkeyPatch
):
    weights = read_weights(random_file, "squeezenet1_1")
    few = replace(config(1), num_tuned=2, num_copies=3)
    assert learned(cnn_fc.train(room_set, "squeezenet1_1", weights, few, silent), weights) == {
        11,
        12,
    }
    assert (
        learned(
            cnn_fc.train(room_set, "squeezenet1_1", weights, replace(few, num_tuned=0), silent),
            weights,
        )
        == set()
    )
    monkeypatch.setattr(
        frozen_maps, "MAX_BYTES", 0
    )  # no room for a single copy: varied anew whenever shown
    assert learned(cnn_fc.train(room_set, "squeezenet1_1", weights, few, silent), weights) == {
        11,
        12,
    }


def test_copies_are_made_once_and_as_many_as_there_is_room_for(
    room_set: TrainingSet, random_file: Path, monkeypatch: pytest.MonkeyPatch
):
    weights, shown, made = read_weights(random_file, "squeezenet1_1"), 0, frozen_maps.augment

    def counted(pictures: torch.Tensor, *args: Any) -> torch.Tensor:
        nonlocal shown
        shown += len(pictures)
        return made(pictures, *args)

    monkeypatch.setattr(frozen_maps, "augment", counted)
    cnn_fc.train(room_set, "squeezenet1_1", weights, replace(config(4), num_copies=3), silent)
    assert shown == 3 * len(room_set.jpegs)
    shown = 0
    one = frozen_maps.plain_maps(
        torch.nn.Sequential(*list(Backbone("squeezenet1_1").features)[:11]),
        torch.zeros(1, 48, 64, 3, dtype=torch.uint8),
    ).nbytes
    monkeypatch.setattr(frozen_maps, "MAX_BYTES", int(2.5 * one * len(room_set.jpegs)))
    cnn_fc.train(room_set, "squeezenet1_1", weights, replace(config(4), num_copies=3), silent)
    assert shown == 2 * len(room_set.jpegs)


def test_a_model_that_lacks_a_part_is_damaged(two_images: TrainingSet):
    model = train(two_images, config(1))
    with pytest.raises(MapError, match=r"'cnn-fc' is damaged"):
        open_coarse_localizer(replace(model, settings={**model.settings, "num_nodes": 5}))


def test_labels_are_single_or_spread_over_nodes_about_as_near(room_set: TrainingSet):
    hard = soft_labels(room_set, 0.0)
    assert np.array_equal(hard.argmax(axis=1), room_set.node_ids)
    assert set(np.unique(hard)) == {0.0, 1.0}
    soft = soft_labels(room_set, 1.0)
    np.testing.assert_allclose(soft.sum(axis=1), 1.0, atol=1e-6)
    assert np.array_equal(np.argsort(-soft, axis=1)[:, 0], room_set.node_distances.argmin(axis=1))


def test_the_temperature_undoes_too_much_confidence():
    rng = np.random.default_rng(0)
    outputs = 2.0 * rng.standard_normal((4000, 6))
    powers = np.exp(outputs)
    labels = np.array([rng.choice(6, p=row / row.sum()) for row in powers])
    temperature = calibrated_temperature(torch.from_numpy(5.0 * outputs), torch.from_numpy(labels))
    assert temperature == pytest.approx(5.0, rel=0.1)
