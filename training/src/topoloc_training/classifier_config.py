"""Settings of the learned coarse localizers. They stand apart from their steps so that reading them
needs no torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from topoloc.bounds import Above, AtLeast, Between

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
class VladNetworkConfig(ClassifierNetworkConfig):
    """Hold the settings of vlad-nn's network: NetVLAD of a network's features."""

    depth: Annotated[int | None, Between(1, 100)] = None
    """Number of layers of the backbone's `features` that are used (None: the best measured number
    for each backbone)."""


@dataclass(frozen=True)
class PooledNetworkConfig(VladNetworkConfig):
    """Hold the settings of cnn-nn's network: pooled features of a pretrained network."""

    grid_rows: Annotated[int, Between(1, 32)] = 2
    """Rows of pooling cells. Cells help because neighbouring nodes see the same objects at other
    image positions."""
    grid_columns: Annotated[int, Between(1, 32)] = 3
    """Columns of pooling cells."""
    power: Annotated[float, Between(1, 100)] = 3.0
    """Exponent of the generalised mean (Radenovic et al. 2018): 1 is the mean, infinity the
    maximum."""


@dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained."""

    max_epochs: Annotated[int, Between(1, 100_000)] = 60
    """Times that every image is shown, at most."""
    patience: Annotated[int, AtLeast(0)] = 12
    """Training stops after this many epochs without gain on the held-out images, and the best epoch
    is kept."""
    batch_size: Annotated[int, Between(1, 4096)] = 32
    """Images that are shown together."""
    learning_rate: Annotated[float, Between(0, 10)] = 1e-3
    """Of layers that begin at random; at its height, in a cosine schedule with a short rise."""
    backbone_rate: Annotated[float, Between(0, 10)] = 0.1
    """Learning rate of layers that begin with weights from elsewhere, as a share of
    `learning_rate`."""
    weight_decay: Annotated[float, Between(0, 10)] = 1e-2
    """Of AdamW."""
    held_out: Annotated[float, Between(0, 0.9)] = 0.12
    """Share of the images that are held out; never the only image of a node."""
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Of the order of the images, how they are varied, and layers that begin at random."""
    num_threads: Annotated[int | None, Between(1, 1024)] = None
    """Threads (None: as many as there are cores). Runs are the same to the bit with the same number
    of threads."""


@dataclass(frozen=True)
class AugmentationConfig:
    """How much the pictures are varied while training; 0 switches a kind off."""

    crop: Annotated[float, Between(0, 0.45)] = 0.06
    """Up to this share is cut from each side: more would show another node's view."""
    rotation_deg: Annotated[float, Between(0, 180)] = 2.0
    """Up to this angle, either way."""
    brightness: Annotated[float, Between(0, 1)] = 0.35
    """Up to this share of the picture's range, either way."""
    contrast: Annotated[float, Between(0, 1)] = 0.35
    """Up to this share, either way."""
    gamma: Annotated[float, Between(0, 5)] = 0.5
    """Up to this power of e, either way."""
    colour_cast: Annotated[float, Between(0, 1)] = 0.15
    """Up to this share in each colour, either way."""
    blur: Annotated[float, Between(0, 1)] = 0.2
    """Share of the pictures that are blurred."""
    occlusion: Annotated[float, Between(0, 1)] = 0.3
    """Share of the pictures that have a rectangle hidden."""


@dataclass(frozen=True)
class CnnFcConfig(ClassifierNetworkConfig):
    """Settings of cnn-fc: a network with one output for each node."""

    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(max_epochs=40))
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    num_tuned: Annotated[int, Between(0, 100)] = 2
    """Layers of the backbone that learn, the last ones with weights; those before stay as they
    begin. A network that begins at random learns as a whole."""
    num_copies: Annotated[int, Between(1, 10_000)] = 8
    """Varied copies of each picture that the layers that do not learn see, once; fewer where what
    they make of them would exceed 1 GB."""
    tuning_epochs: Annotated[int, Between(1, 100_000)] = 8
    """Times that every image is shown where it begins with what the map's own cnn-fc knows."""
    label_spread: Annotated[float, AtLeast(0)] = 1.0
    """An image belongs to its nearest node and, by a bell curve of D_total - D_nearest over this
    share of D_thresh, to those about as near; 0 is the paper's single label."""


@dataclass(frozen=True)
class CnnNnConfig(PooledNetworkConfig):
    """Settings of cnn-nn: features of a pretrained network, pooled, whitened; nearest
    neighbours."""

    dimension: Annotated[int, Between(1, 65_536)] = 256
    """Length of a place vector after whitening, at most."""


@dataclass(frozen=True)
class TripletConfig:
    """How NetVLAD is tuned to the place by the triplet loss."""

    num_epochs: Annotated[int, Between(0, 100_000)] = 0
    """0: not at all."""
    learning_rate: Annotated[float, Between(0, 10)] = 2e-5
    """Of all that is tuned."""
    margin: Annotated[float, AtLeast(0)] = 0.1
    """By how much a picture of the same place must be nearer than one from elsewhere (squared
    distance)."""
    num_negatives: Annotated[int, Between(1, 1000)] = 5
    """The most similar images from elsewhere that each image is compared with."""
    num_tuned: Annotated[int, Between(0, 100)] = 2
    """Layers of the backbone that are tuned, the last ones, with NetVLAD itself."""
    near: Annotated[float, Above(0)] = 1.0
    """Images within this share of D_thresh by Eq. 1 show the same place."""
    far: Annotated[float, Above(0)] = 3.0
    """Images further apart than this share of D_thresh do not."""
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Of the order of the images."""


@dataclass(frozen=True)
class VladNnConfig(VladNetworkConfig):
    """Settings of vlad-nn: NetVLAD of a network's features; nearest neighbours."""

    num_clusters: Annotated[int, Between(1, 4096)] = 64
    """Words of the vocabulary, where none come with the weights."""
    num_sampled_features: Annotated[int, Between(1, 100_000)] = 100
    """Features of each mapping picture that the vocabulary is learnt from."""
    dimension: Annotated[int, Between(1, 65_536)] = 256
    """Length of a place vector after whitening, at most."""
    tuning: TripletConfig = field(default_factory=TripletConfig)
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Of the vocabulary."""
