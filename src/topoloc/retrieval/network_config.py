"""What a map says of the networks of its learned coarse localizers. It stands apart from them so
that reading it needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from topoloc.bounds import Between

BackboneName = Literal["squeezenet1_1", "vgg11", "vgg16", "efficientnet_lite0", "compact"]


@dataclass(frozen=True)
class NetworkInputConfig:
    """How a picture is brought to the network: cut to the mapping pictures' shape, reduced, and
    stretched to one size."""

    width_px: Annotated[int, Between(32, 2048)] = 224
    """Width that the network sees."""
    height_px: Annotated[int, Between(32, 2048)] = 168
    """Height that the network sees."""


@dataclass(frozen=True)
class ClassifierNetworkConfig:
    """The network of cnn-fc."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)


@dataclass(frozen=True)
class PooledNetworkConfig:
    """The network of cnn-nn: features of a pretrained one, pooled."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)
    depth: Annotated[int | None, Between(1, 100)] = None
    """Layers of the backbone's `features` that are used (None: what measured best for each
    backbone)."""
    grid_rows: Annotated[int, Between(1, 32)] = 2
    """Features are pooled in cells, since neighbouring nodes see the same things at other places of
    the picture."""
    grid_columns: Annotated[int, Between(1, 32)] = 3
    """The same, across."""
    power: Annotated[float, Between(1, 100)] = 3.0
    """Exponent of the generalised mean (Radenovic et al. 2018): 1 is the mean, infinity the
    maximum."""


@dataclass(frozen=True)
class VladNetworkConfig:
    """The network of vlad-nn: NetVLAD of a network's features."""

    picture: NetworkInputConfig = field(default_factory=NetworkInputConfig)
    depth: Annotated[int | None, Between(1, 100)] = None
    """Layers of the backbone's `features` that are used (None: what measured best for each
    backbone)."""
