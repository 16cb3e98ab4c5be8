"""Compare the backbones with torchvision's, name by name and value by value."""

from __future__ import annotations

import pytest
import torch

from topoloc_training.backbones import Backbone, normalize_images
from topoloc_training.classifier_config import BackboneName


# Parameters as torchvision's documentation of each model states them; 4.65 million of
# EfficientNet-lite0, 42,016 numbers of its batch normalisations less and 21,008 biases of its
# convolutions more.
@pytest.mark.parametrize(
    ("name", "num_parameters"),
    [
        ("squeezenet1_1", 1_235_496),
        ("vgg11", 132_863_336),
        ("vgg16", 138_357_544),
        ("efficientnet_lite0", 4_652_008 - 42_016 + 21_008),
    ],
)
def test_number_of_parameters_is_torchvisions(name: BackboneName, num_parameters: int):
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in Backbone(name).parameters()) == num_parameters


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "squeezenet1_1",
            {
                "features.12.expand3x3.weight": (256, 64, 3, 3),
                "classifier.1.weight": (1000, 512, 1, 1),
            },
        ),
        (
            "vgg11",
            {
                "features.18.weight": (512, 512, 3, 3),
                "classifier.0.weight": (4096, 25088),
                "classifier.6.bias": (1000,),
            },
        ),
        ("vgg16", {"features.28.weight": (512, 512, 3, 3), "classifier.3.weight": (4096, 4096)}),
    ],
)
def test_names_and_shapes_are_torchvisions(
    name: BackboneName, expected: dict[str, tuple[int, ...]]
):
    with torch.device("meta"):
        state = Backbone(name).state_dict()
    assert {key: tuple(state[key].shape) for key in expected} == expected


@pytest.mark.parametrize(("name", "side"), [("squeezenet1_1", 13), ("vgg11", 7), ("vgg16", 7)])
def test_feature_maps_of_a_224_picture_are_as_large_as_published(name: BackboneName, side: int):
    with torch.device("meta"):
        maps = Backbone(name, num_outputs=None)(torch.zeros(1, 3, 224, 224))
    assert tuple(maps.shape) == (1, 512, side, side)


def test_a_shallower_backbone_gives_an_intermediate_map_of_the_whole_one():
    torch.manual_seed(0)
    whole = Backbone("squeezenet1_1", num_outputs=None).eval()
    part = Backbone("squeezenet1_1", num_outputs=None, depth=5).eval()
    part.load_state_dict(
        {name: value for name, value in whole.state_dict().items() if name in part.state_dict()}
    )
    image = torch.randn(1, 3, 64, 64)
    assert torch.equal(part(image), whole.features[:5](image))
    assert part.num_channels == part(image).shape[1] == 128


def test_pictures_are_normalised_by_imagenets_mean_and_deviation():
    white = torch.full((1, 2, 2, 3), 255, dtype=torch.uint8)
    expected = [(1 - 0.485) / 0.229, (1 - 0.456) / 0.224, (1 - 0.406) / 0.225]
    assert normalize_images(white)[0, :, 0, 0].tolist() == pytest.approx(expected, abs=1e-5)
