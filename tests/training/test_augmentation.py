"""Test the augmentation of training images: no change if off, otherwise in range and equal
for equal seeds."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from topoloc_training.augmentation import augment
from topoloc_training.backbones import normalize_images
from topoloc_training.classifier_config import AugmentationConfig

OFF = AugmentationConfig(**{item.name: 0.0 for item in fields(AugmentationConfig)})


def pictures() -> torch.Tensor:
    return torch.randint(
        20, 235, (4, 24, 32, 3), generator=torch.Generator().manual_seed(1), dtype=torch.uint8
    )


def varied(config: AugmentationConfig, seed: int = 0) -> torch.Tensor:
    return augment(pictures(), config, torch.Generator().manual_seed(seed))


def test_switched_off_nothing_changes():
    torch.testing.assert_close(varied(OFF), normalize_images(pictures()), atol=2e-2, rtol=0)


@pytest.mark.parametrize("kind", [item.name for item in fields(AugmentationConfig)])
def test_each_augmentation_changes_only_the_images(kind: str):
    config = replace(
        OFF, **{kind: 1.0 if kind in ("blur", "occlusion") else getattr(AugmentationConfig(), kind)}
    )
    assert (varied(config) - varied(OFF)).abs().amax(dim=(1, 2, 3)).min() > 0.02


def test_the_same_seed_gives_the_same_pictures_and_another_others():
    assert torch.equal(varied(AugmentationConfig()), varied(AugmentationConfig()))
    assert not torch.equal(varied(AugmentationConfig()), varied(AugmentationConfig(), seed=1))


def test_colours_stay_colours():
    images = varied(AugmentationConfig(brightness=2.0, contrast=2.0, gamma=2.0))
    darkest, brightest = (
        normalize_images(torch.zeros(1, 1, 1, 3)),
        normalize_images(torch.full((1, 1, 1, 3), 255.0)),
    )
    assert (images >= darkest - 1e-4).all()
    assert (images <= brightest + 1e-4).all()
