"""Provide images of the rendered room as a training set, and initial weights."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from built_room import built_room
from topoloc_training.backbones import Backbone
from topoloc_training.coarse_training import training_set_of
from topoloc_training.training_set import TrainingSet


@pytest.fixture(scope="session")
def room_set(tiny_recording: Path) -> TrainingSet:
    """Return the training set of the map of `tiny_recording`."""
    return training_set_of(built_room(tiny_recording))


@pytest.fixture(scope="session")
def two_images(room_set: TrainingSet) -> TrainingSet:
    """Return a map with one node and two images."""
    distances = room_set.node_distances[:2, :1]
    return replace(
        room_set,
        jpegs=room_set.jpegs[:2],
        world_from_cams=room_set.world_from_cams[:2],
        node_ids=room_set.node_ids[:2] * 0,
        node_distances=distances,
    )


@pytest.fixture(scope="session")
def squeezenet_file(shared: Path) -> Path:
    """Return the weights of SqueezeNet 1.1 trained on ImageNet, features only."""
    return shared / "weights" / "squeezenet1_1-imagenet-features.pth"


@pytest.fixture(scope="session")
def random_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a complete SqueezeNet in torchvision's layout, with random weights."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "squeezenet.pth"
    torch.save(Backbone("squeezenet1_1").state_dict(), path)
    return path
