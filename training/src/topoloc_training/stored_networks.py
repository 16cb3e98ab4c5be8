"""Write and read a network as a map keeps it: settings, and weights as half floats."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from topoloc.bounds import parse_value
from topoloc.retrieval.coarse import CoarseModel


def rounded_to_half(network: nn.Module) -> nn.Module:
    """Round a network to the weights that the map file can hold, so that training and the stored
    map agree."""
    with torch.no_grad():
        for value in network.state_dict().values():
            if value.is_floating_point():
                value.copy_(value.half().float())
    return network


def to_arrays(network: nn.Module) -> dict[str, np.ndarray]:
    """The network's weights as half floats, under names that begin with ``network.``."""
    state = {name: value.detach().cpu() for name, value in network.state_dict().items()}
    return {
        f"network.{name}": (value.half() if value.is_floating_point() else value).numpy()
        for name, value in state.items()
    }


def load_network_weights(network: nn.Module, arrays: Mapping[str, np.ndarray]) -> nn.Module:
    """Load the weights stored in a map into `network`. They are half floats under names that begin
    with ``network.``.

    Raises:
        KeyError, RuntimeError: the weights do not fit the network.
    """
    state = {
        name.removeprefix("network."): torch.from_numpy(value)
        for name, value in arrays.items()
        if name.startswith("network.")
    }
    is_real = {name: value.is_floating_point() for name, value in state.items()}
    network.load_state_dict({k: v.float() if is_real[k] else v for k, v in state.items()})
    return network


def read_setting(model: CoarseModel, name: str, of: Any) -> Any:
    """Return a setting of a stored model, converted to the type `of`. Unknown keys are ignored.
    Raises ConfigError."""
    return parse_value(of, model.settings.get(name), name, is_strict=False)
