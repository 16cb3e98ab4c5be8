"""Test PoseNet: its losses against their formulas, and a network that learns the rendered room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from built_room import built_room, unseen_views
from topoloc.errors import WeightsError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.stored_images import decode_stored_image
from topoloc_paper.pose_losses import beta_loss, learnt_loss, reprojection_loss
from topoloc_paper.posenet import PoseNet, PoseNetConfig, train_posenet
from topoloc_training.classifier_config import (
    AugmentationConfig,
    NetworkInputConfig,
    TrainingConfig,
)


def as_tensors(*world_from_cams: Rigid3) -> tuple[torch.Tensor, torch.Tensor]:
    return (
        torch.tensor(np.stack([pose.translation for pose in world_from_cams]), dtype=torch.float64),
        torch.tensor(np.stack([pose.quat_wxyz() for pose in world_from_cams]), dtype=torch.float64),
    )


FOUND, TRUTH = (
    Rigid3.exp(np.array(xi))
    for xi in ([0.3, -0.1, 0.2, 0.1, 0.2, -0.3], [0.0, 0.1, 0.1, 0.2, 0.1, -0.2])
)


def test_the_losses_vanish_at_the_truth_and_treat_q_as_minus_q():
    points = torch.tensor([[[0.5, 0.2, 4.0], [-0.3, 0.1, 3.0]]], dtype=torch.float64)
    truth = as_tensors(TRUTH)
    for translation, quaternion in (truth, (truth[0], -truth[1])):
        assert beta_loss((translation, quaternion), truth, 2.0).item() == pytest.approx(
            0.0, abs=1e-12
        )
        assert learnt_loss(
            (translation, quaternion), truth, torch.zeros(2)
        ).item() == pytest.approx(0.0, abs=1e-12)
        assert reprojection_loss((translation, quaternion), truth, points).item() == pytest.approx(
            0.0, abs=1e-12
        )


def test_beta_weighs_metres_against_quaternions():
    expected = np.linalg.norm(FOUND.translation - TRUTH.translation) + 3.0 * np.linalg.norm(
        FOUND.quat_wxyz() - TRUTH.quat_wxyz()
    )
    assert beta_loss(as_tensors(FOUND), as_tensors(TRUTH), 3.0).item() == pytest.approx(expected)


def test_learnt_variances_weigh_each_error_and_cost_something():
    base = learnt_loss(as_tensors(FOUND), as_tensors(TRUTH), torch.zeros(2)).item()
    apart = np.abs(FOUND.translation - TRUTH.translation).sum()
    turned = np.abs(FOUND.quat_wxyz() - TRUTH.quat_wxyz()).sum()
    assert base == pytest.approx(apart + turned)
    weighed = learnt_loss(as_tensors(FOUND), as_tensors(TRUTH), torch.tensor([1.0, -1.0])).item()
    assert weighed == pytest.approx(apart * np.exp(-1.0) + 1.0 + turned * np.exp(1.0) - 1.0)


def test_reprojection_is_the_distance_between_projections():
    points_world = np.array(
        [[0.5, 0.2, 4.0], [-0.3, 0.1, 3.0], [0.0, 0.0, -5.0]]
    )  # the last lies behind
    expected = []
    for point in points_world[:2]:
        a, b = FOUND.inverse().apply(point), TRUTH.inverse().apply(point)
        expected.append(np.abs(a[:2] / a[2] - b[:2] / b[2]).sum())
    loss = reprojection_loss(as_tensors(FOUND), as_tensors(TRUTH), torch.tensor(points_world[None]))
    assert loss.item() == pytest.approx(np.mean(expected))


@pytest.mark.parametrize("loss", ["beta", "learnt", "reprojection"])
def test_it_learns_the_room_and_is_saved(loss: str, tiny_recording: Path, tmp_path: Path):
    topomap = built_room(tiny_recording)
    still = AugmentationConfig(**dict.fromkeys(AugmentationConfig.__dataclass_fields__, 0.0))
    training = TrainingConfig(
        max_epochs=90, patience=90, learning_rate=4e-3, num_threads=1, held_out=0.0, batch_size=14
    )
    config = PoseNetConfig(
        loss,
        num_hidden=64,
        picture=NetworkInputConfig(48, 36),
        training=training,
        augmentation=still,
    )  # pyright: ignore[reportArgumentType]
    posenet = train_posenet(topomap, "compact", None, config)
    truths = [image.world_from_cam for image in topomap.place_images]
    found = posenet.localize([decode_stored_image(image.jpeg) for image in topomap.place_images])
    errors = [
        np.linalg.norm(a.translation - b.translation) for a, b in zip(found, truths, strict=True)
    ]
    centre = np.mean([pose.translation for pose in truths], axis=0)
    assert np.median(errors) < 0.5 * np.median(
        [np.linalg.norm(pose.translation - centre) for pose in truths]
    )
    posenet.save(tmp_path / "posenet.pth")
    image = unseen_views()[0][0]
    again = PoseNet.load(tmp_path / "posenet.pth").localize([image])[0]
    np.testing.assert_allclose(again.matrix(), posenet.localize([image])[0].matrix(), atol=1e-6)


def test_a_file_without_posenet_is_an_error(tmp_path: Path):
    torch.save({"config": {}}, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match=r"other\.pth is no PoseNet"):
        PoseNet.load(tmp_path / "other.pth")
