"""Export networks of local features to ONNX by one contract, so that one extractor serves every
feature type.

Input `image` (1, 1, h, w) float32, grey in [0, 1], h and w multiples of 32. Outputs `scores` (1, 1,
h, w) in [0, 1] and `descriptors` (1, c, h/s, w/s), not of unit length: pixel (x, y) lies at ((x +
0.5) / s - 0.5, (y + 0.5) / s - 0.5) of it. Instead of descriptors, a network may have the two
levels whose sum they are (`lean.py`). A network may have a third output, `places` (1, c, h/p, w/p),
for place recognition. Its class then names all three as `outputs`.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import onnx
import torch
from torch import Tensor, nn

from topoloc.recordings.atomic import atomic_write
from topoloc_training.networks.edgepoint2 import SIZES, EdgePoint2
from topoloc_training.networks.lean import made_lean
from topoloc_training.networks.xfeat import UNUSED, XFeat

VERSION = 1
_OPSET = 17
FEATURE_TYPES = ("xfeat", *(f"edgepoint2-{size}" for size in SIZES))


def build_network(kind: str, tensors: dict[str, Tensor]) -> nn.Module:
    """The network of a kind with these weights, ready to answer.

    Raises:
        ValueError: unknown kind, or tensors of another network.
    """
    if kind not in FEATURE_TYPES:
        raise ValueError(f"no network {kind!r}: there are {', '.join(FEATURE_TYPES)}")
    network = XFeat() if kind == "xfeat" else EdgePoint2(kind.removeprefix("edgepoint2-"))
    kept = {name: value for name, value in tensors.items() if not name.startswith(UNUSED)}
    try:
        network.load_state_dict(kept)
    except RuntimeError as error:
        raise ValueError(f"these are not the weights of {kind}") from error
    return network.eval()


def export(network: nn.Module, path: Path, properties: dict[str, str]) -> None:
    """Write the network as ONNX, atomically. `properties` join `topoloc_version` in the file's
    metadata."""
    outputs = getattr(network, "outputs", ("scores", "descriptors"))
    axes = {name: {2: f"h_{name}", 3: f"w_{name}"} for name in outputs}
    with atomic_write(path) as part:
        with warnings.catch_warnings():
            # The exporter by tracing is called old, but needs no further package and gives the
            # smaller graph.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                network,
                (torch.rand(1, 1, 64, 96),),
                str(part),
                input_names=["image"],
                output_names=list(outputs),
                dynamic_axes={"image": {2: "h", 3: "w"}, **axes},
                opset_version=_OPSET,
                dynamo=False,
            )
        model = onnx.load(part)
        made_lean(model)
        onnx.helper.set_model_props(model, {"topoloc_version": str(VERSION), **properties})
        onnx.save(model, part)


def convert(kind: str, weights: bytes, target: Path, properties: dict[str, str]) -> None:
    """Published weights (the bytes of their file) to ONNX. Called by `topoloc weights` through an
    entry point.

    Raises:
        ValueError: as `build_network`.
    """
    tensors = torch.load(io.BytesIO(weights), map_location="cpu", weights_only=True)
    export(build_network(kind, tensors), target, properties)
