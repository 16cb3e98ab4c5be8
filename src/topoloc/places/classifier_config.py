"""Settings of the learned coarse localizers. They stand apart from their steps so that reading them needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, TypeVar, get_args

from topoloc.places.stored_settings import settings_from

T = TypeVar("T")

BackboneName = Literal["squeezenet1_1", "vgg11", "vgg16", "compact"]
BACKBONES: tuple[BackboneName, ...] = get_args(BackboneName)


@dataclass(frozen=True)
class PictureConfig:
    """How a picture is brought to the network: cut to the mapping pictures' shape, reduced, and stretched to one size."""

    width_px: int = 224
    height_px: int = 168


@dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained."""

    max_epochs: int = 60
    """Times that every image is shown, at most."""
    patience: int = 12
    """Training stops after this many epochs without gain on the held-out images, and the best epoch is kept."""
    batch_size: int = 32
    learning_rate: float = 1e-3
    """Of layers that begin at random; at its height, in a cosine schedule with a short rise."""
    backbone_rate: float = 0.1
    """Learning rate of layers that begin with weights from elsewhere, as a share of `learning_rate`."""
    weight_decay: float = 1e-2
    held_out: float = 0.12
    """Share of the images that are held out; never the only image of a node."""
    seed: int = 0
    num_threads: int | None = None
    """Threads (None: as many as there are cores). Runs are the same to the bit with the same number of threads."""


@dataclass(frozen=True)
class AugmentationConfig:
    """How much the pictures are varied while training; 0 switches a kind off."""

    crop: float = 0.06
    """Up to this share is cut from each side: more would show another node's view."""
    rotation_deg: float = 2.0
    brightness: float = 0.35
    contrast: float = 0.35
    gamma: float = 0.5
    """Up to this power of e, either way."""
    colour_cast: float = 0.15
    blur: float = 0.2
    """Share of the pictures that are blurred."""
    occlusion: float = 0.3
    """Share of the pictures that have a rectangle hidden."""


@dataclass(frozen=True)
class CnnFcConfig:
    """Settings of cnn-fc: a network whose outputs are the nodes."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    label_spread: float = 1.0
    """An image belongs to its nearest node and, by a bell curve of D_total - D_nearest over this share of D_thresh, to those
    about as near; 0 is the paper's single label."""


@dataclass(frozen=True)
class CnnNnConfig:
    """Settings of cnn-nn: features of a pretrained network, pooled, whitened; nearest neighbours."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    depth: int | None = None
    """Layers of the backbone's `features` that are used (None: what measured best for each backbone)."""
    grid_rows: int = 2
    """Features are pooled in cells, since neighbouring nodes see the same things at other places of the picture."""
    grid_columns: int = 3
    power: float = 3.0
    """Exponent of the generalised mean (Radenovic et al. 2018): 1 is the mean, infinity the maximum."""
    dimension: int = 256
    """Length of a place vector after whitening, at most."""


@dataclass(frozen=True)
class TripletConfig:
    """How NetVLAD is tuned to the place by the triplet loss."""

    num_epochs: int = 0
    """0: not at all."""
    learning_rate: float = 2e-5
    margin: float = 0.1
    num_negatives: int = 5
    """The most similar images from elsewhere that each image is compared with."""
    num_tuned: int = 2
    """Layers of the backbone that are tuned, the last ones, with NetVLAD itself."""
    near: float = 1.0
    """Images within this share of D_thresh by Eq. 1 show the same place."""
    far: float = 3.0
    """Images further apart than this share of D_thresh do not."""
    seed: int = 0


@dataclass(frozen=True)
class VladNnConfig:
    """Settings of vlad-nn: NetVLAD of a network's features; nearest neighbours."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    depth: int | None = None
    """Layers of the backbone's `features` that are used (None: what measured best for each backbone)."""
    num_clusters: int = 64
    """Words of the vocabulary, where none come with the weights."""
    num_sampled_features: int = 100
    """Features of each mapping picture that the vocabulary is learnt from."""
    dimension: int = 256
    """Length of a place vector after whitening, at most."""
    tuning: TripletConfig = field(default_factory=TripletConfig)
    seed: int = 0


_NESTED = {"picture": PictureConfig, "training": TrainingConfig, "augmentation": AugmentationConfig, "tuning": TripletConfig}


def settings_of(kind: type[T], stored: Mapping[str, Any]) -> T:
    """A configuration from the JSON that a map keeps of it. Raises SettingsError."""
    return settings_from(kind, _known_of(kind, stored))


def _known_of(kind: type[Any], stored: Any) -> Any:
    """Without the keys of other versions."""
    if not isinstance(stored, Mapping):
        return stored
    known = {item.name for item in fields(kind)}
    return {name: _known_of(_NESTED[name], value) if name in _NESTED else value for name, value in stored.items() if name in known}
