"""Define the settings that a map stores for the networks of its learned coarse localizers. This
module needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from topoloc.bounds import Between

BackboneName = Literal["squeezenet1_1", "vgg11", "vgg16", "efficientnet_lite0", "compact"]


@dataclass(frozen=True)
class NetworkInputConfig:
    """Hold the size of the network's input. An image is cropped to the aspect ratio of the mapping
    images, reduced, and stretched to this size."""

    width_px: Annotated[int, Between(32, 2048)] = 224
    """Width of the network's input."""
    height_px: Annotated[int, Between(32, 2048)] = 168
    """Height of the network's input."""


@dataclass(frozen=True)
class ClassifierNetworkConfig:
    """Hold the settings of cnn-fc's network."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)


@dataclass(frozen=True)
class PooledNetworkConfig:
    """Hold the settings of cnn-nn's network: pooled features of a pretrained network."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)
    depth: Annotated[int | None, Between(1, 100)] = None
    """Number of layers of the backbone's `features` that are used (None: the best measured number
    for each backbone)."""
    grid_rows: Annotated[int, Between(1, 32)] = 2
    """Rows of pooling cells. Cells help because neighbouring nodes see the same objects at other
    image positions."""
    grid_columns: Annotated[int, Between(1, 32)] = 3
    """Columns of pooling cells."""
    power: Annotated[float, Between(1, 100)] = 3.0
    """Exponent of the generalised mean (Radenovic et al. 2018): 1 is the mean, infinity the
    maximum."""


@dataclass(frozen=True)
class VladNetworkConfig:
    """Hold the settings of vlad-nn's network: NetVLAD of a network's features."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)
    depth: Annotated[int | None, Between(1, 100)] = None
    """Number of layers of the backbone's `features` that are used (None: the best measured number
    for each backbone)."""
