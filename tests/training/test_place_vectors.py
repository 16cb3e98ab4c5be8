"""Test cnn-nn and vlad-nn, trained on the rendered room and stored as in a map, with mapping images
and new images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_weights import netvlad_tensors

from built_room import unseen_views
from topoloc.errors import MapError, TrainingError
from topoloc.features.features import Features
from topoloc.recordings.stored_images import decode_stored_image
from topoloc.retrieval.coarse import CoarseLocalizer, CoarseModel, open_coarse_localizer
from topoloc_training import cnn_nn, vlad_nn
from topoloc_training.classifier_config import (
    CnnNnConfig,
    NetworkInputConfig,
    TripletConfig,
    VladNnConfig,
)
from topoloc_training.place_vectors import NetworkDescriptorLocalizer
from topoloc_training.training_set import TrainingSet
from topoloc_training.vlad_nn import VladNetwork, tune
from topoloc_training.weights import read_weights

SMALL = NetworkInputConfig(112, 84)
NO_FEATURES = Features(
    *(np.zeros(shape, np.float32) for shape in ((0, 2), (0,), (0,), (0,), (0, 64)))
)


def silent(stage: str, done: int, total: int) -> None:
    assert 0 < done <= total


def learnt(name: str, room_set: TrainingSet, weights_file: Path) -> CoarseModel:
    weights = read_weights(weights_file, "squeezenet1_1")
    if name == "cnn-nn":
        return cnn_nn.train(room_set, "squeezenet1_1", weights, CnnNnConfig(picture=SMALL), silent)
    return vlad_nn.train(
        room_set, "squeezenet1_1", weights, VladNnConfig(picture=SMALL, num_clusters=8), silent
    )


@pytest.mark.parametrize("name", ["cnn-nn", "vlad-nn"])
def test_mapping_images_are_found_and_unseen_ones_lead_near(
    name: str, room_set: TrainingSet, squeezenet_file: Path
):
    localizer = open_coarse_localizer(learnt(name, room_set, squeezenet_file))
    assert isinstance(localizer, NetworkDescriptorLocalizer)
    assert isinstance(localizer, CoarseLocalizer)
    pictures = [decode_stored_image(jpeg) for jpeg in room_set.jpegs]
    rankings = localizer.rank_batch(pictures, 3)
    assert [ranking[0].row for ranking in rankings] == room_set.node_ids.tolist()
    assert min(ranking[0].score for ranking in rankings) > 0.95
    for image, world_from_cam in unseen_views():
        (best, *_) = localizer.rank(image, NO_FEATURES, 3)
        node_images = [
            p
            for p, node in zip(room_set.world_from_cams, room_set.node_ids, strict=True)
            if node == best.row
        ]
        nearest = min(
            np.linalg.norm(p.translation - world_from_cam.translation) for p in node_images
        )
        assert nearest < 3 * room_set.d_thresh


def test_one_picture_and_a_batch_get_the_same_vectors(room_set: TrainingSet, random_file: Path):
    localizer = open_coarse_localizer(learnt("cnn-nn", room_set, random_file))
    assert isinstance(localizer, NetworkDescriptorLocalizer)
    images = [image for image, _ in unseen_views()][:3]
    single = np.concatenate([localizer.vectors([image]) for image in images])
    np.testing.assert_allclose(
        single, localizer.vectors(images), atol=2e-3
    )  # frozen, its sums are in another order


@pytest.mark.parametrize("name", ["cnn-nn", "vlad-nn"])
def test_training_twice_gives_the_same_bytes(name: str, room_set: TrainingSet, random_file: Path):
    first, second = (learnt(name, room_set, random_file) for _ in range(2))
    assert first.settings == second.settings
    assert all(np.array_equal(first.arrays[key], second.arrays[key]) for key in first.arrays)


def test_a_map_with_one_node_answers_with_it(two_images: TrainingSet, random_file: Path):
    for name in ("cnn-nn", "vlad-nn"):
        localizer = open_coarse_localizer(learnt(name, two_images, random_file))
        ranking = localizer.rank(unseen_views()[0][0], NO_FEATURES, 4)
        assert [score.row for score in ranking] == [0]


def test_colour_size_and_shape_of_the_query_matter_little(
    room_set: TrainingSet, squeezenet_file: Path
):
    localizer = open_coarse_localizer(learnt("cnn-nn", room_set, squeezenet_file))
    image = unseen_views()[3][0]
    wider = np.pad(image, ((0, 0), (40, 40)))
    variants = [
        image,
        np.repeat(image[..., None], 3, axis=2),
        image.repeat(2, axis=0).repeat(2, axis=1),
        wider,
    ]
    assert len({localizer.rank(variant, NO_FEATURES, 1)[0].row for variant in variants}) == 1


def test_a_model_whose_arrays_do_not_fit_is_damaged(room_set: TrainingSet, random_file: Path):
    model = learnt("cnn-nn", room_set, random_file)
    lacking = {name: value for name, value in model.arrays.items() if "features.4" not in name}
    with pytest.raises(MapError, match=r"'cnn-nn' is damaged: .*features\.4"):
        open_coarse_localizer(replace(model, arrays=lacking))
    with pytest.raises(MapError, match="damaged"):
        open_coarse_localizer(
            replace(
                model, settings={"backbone": "squeezenet1_1", "config": model.settings["config"]}
            )
        )


def test_netvlads_own_vocabulary_is_taken_from_its_checkpoint(
    two_images: TrainingSet, tmp_path: Path
):
    torch.save({"state_dict": netvlad_tensors(num_clusters=3)}, tmp_path / "netvlad.pth")
    weights = read_weights(tmp_path / "netvlad.pth", "vgg16")
    model = vlad_nn.train(
        two_images, "vgg16", weights, VladNnConfig(picture=NetworkInputConfig(40, 32)), silent
    )
    assert model.arrays["network.pool.centroids"].shape == (3, 512)
    assert model.settings["weights"] == {"file": "netvlad.pth", "sha256": weights.sha256}
    assert open_coarse_localizer(model).rank(unseen_views()[0][0], NO_FEATURES, 1)[0].row == 0


def test_triplets_bring_near_images_together(room_set: TrainingSet):
    torch.manual_seed(0)
    tuning = TripletConfig(num_epochs=3, learning_rate=1e-3, near=3.0, far=4.0, margin=0.3)
    network = VladNetwork("squeezenet1_1", 5, 8)
    pictures = np.stack(
        [np.ascontiguousarray(decode_stored_image(jpeg)[:64, :64]) for jpeg in room_set.jpegs]
    )
    losses = tune(network, pictures, room_set, tuning, silent)
    assert losses[-1] < losses[0]


def test_there_are_no_triplets_in_one_spot(two_images: TrainingSet, random_file: Path):
    config = VladNnConfig(picture=SMALL, num_clusters=2, tuning=TripletConfig(num_epochs=1))
    with pytest.raises(TrainingError, match="no triplets"):
        vlad_nn.train(
            two_images, "squeezenet1_1", read_weights(random_file, "squeezenet1_1"), config, silent
        )
