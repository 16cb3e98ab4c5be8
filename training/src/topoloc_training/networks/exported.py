"""A network that was exported, to learn on: its file's weights in the modules that they came
from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

_OUTPUT = "/Conv_output_0"


def load_exported(network: nn.Module, path: Path) -> None:
    """Load the weights of an exported file into its network.

    The export folded batch norms into the convolutions before them. Here they only add the bias of
    these, and must stay fixed while the network continues to learn.

    Raises:
        ValueError: the file holds another network.
    """
    graph = onnx.load(path).graph
    values = {value.name: numpy_helper.to_array(value) for value in graph.initializer}
    modules = dict(network.named_modules())
    for norm in (module for module in modules.values() if isinstance(module, nn.BatchNorm2d)):
        _do_nothing(norm)
    for node in (node for node in graph.node if node.op_type == "Conv"):
        name = _module_name(node.output[0].removesuffix(_OUTPUT))
        module = modules.get(name)
        weight, bias = (values[one] for one in node.input[1:3])
        if not isinstance(module, nn.Conv2d) or tuple(module.weight.shape) != weight.shape:
            raise ValueError(f"{path}: holds another network ({name})")
        _set(module.weight, weight)
        after, _, number = name.rpartition(".")
        norm = modules.get(f"{after}.{int(number) + 1}") if number.isdigit() else None
        _set(getattr(module if module.bias is not None else norm, "bias", None), bias)
    if "fine_of_both" in values:  # whose bias the coarse level has
        fine = modules["fine_descriptor"]
        assert isinstance(fine, nn.Conv2d)
        _set(fine.weight, values["fine_of_both"].T[:, :, None, None])
        _set(fine.bias, np.zeros(len(values["fine_of_both"].T), np.float32))


def freeze_norms(network: nn.Module) -> None:
    """Fix the batch norms, also in training."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def _do_nothing(norm: nn.BatchNorm2d) -> None:
    nn.init.ones_(norm.weight)
    nn.init.zeros_(norm.bias)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    nn.init.zeros_(norm.running_mean)
    nn.init.constant_(norm.running_var, 1.0 - norm.eps)


def _module_name(scope: str) -> str:
    """`/eighth/eighth.1/layer/layer.3` is the module eighth.1.layer.3."""
    name, *parts = scope.strip("/").split("/")
    for part in parts:
        before, _, last = name.rpartition(".")
        is_inside = part.partition(".")[0] == last
        name = ".".join(one for one in (before, part) if one) if is_inside else f"{name}.{part}"
    return name


def _set(parameter: torch.Tensor | None, values: np.ndarray) -> None:
    if parameter is None:
        raise ValueError("a bias that no module has")
    with torch.no_grad():
        parameter.copy_(torch.from_numpy(np.array(values, np.float32)))
