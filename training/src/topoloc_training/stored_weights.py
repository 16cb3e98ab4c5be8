"""A network's weights as a map keeps them: half floats."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn


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
