"""List the local feature types of maps in one table, with everything in which they differ.

One entry in `FEATURE_TYPES` adds a type: its extraction function and its matching thresholds. The
weights that calibrate its probabilities are fitted separately and stored with the code that uses
them (`localization/fitted_weights.py`). Without them, results are marked as not calibrated.

The extraction code of a type is loaded when it is used: OpenCV, Numba or ONNX Runtime with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import UInt8

from topoloc.bounds import AtLeast, Between
from topoloc.errors import FeatureTypeError, WeightsError
from topoloc.features.features import Features

Normalization = Literal["none", "paper", "wide"]


@dataclass(frozen=True)
class FeatureConfig:
    """Hold the settings of feature extraction. A map stores these plain values and creates the
    configuration from them again."""

    kind: str = "surf"
    """Feature type of the map and of its queries: a name in `FEATURE_TYPES`."""
    normalization: Normalization | None = None
    """Patch normalisation of the image. `none`: no normalisation. `paper`: 17x17 windows without a
    noise floor. `wide`: 65x65 windows and a floor of 24 grey levels. `wide` keeps the gain of
    `paper` under changed light and loses little under unchanged light. Unset: the default of the
    feature type."""
    max_features: Annotated[int, Between(1, 100_000)] = 1000
    """Number of features to keep, strongest first."""
    contrast_threshold: Annotated[float, AtLeast(0)] = 0.01
    """Detection threshold of SIFT, as in OpenCV."""


@dataclass(frozen=True)
class GuidedThresholds:
    """Hold the thresholds for matching a map point to a key point near its projection.

    Args:
        min_similarity: minimum scalar product of the two descriptors.
        min_margin: minimum lead of the best key point over the next one.
        max_scale: maximum ratio of a key point's size to the expected size, or its inverse.
        max_turn: maximum difference of its orientation from the expected one, radians.
    """

    min_similarity: float
    min_margin: float
    max_scale: float = float("inf")
    max_turn: float = float("inf")


@dataclass(frozen=True)
class FeatureType:
    """Describe a local feature type.

    Args:
        extract: function that returns the features of a grey uint8 image, strongest first, for
            given settings and number of threads. Descriptors must have unit length, because they
            are compared by their scalar product.
        guided: thresholds for key points near their projection.
        distant: thresholds for key points far from it, if the pose is only that of a nearby node.
        normalization: default normalisation of the image, see `FeatureConfig`.
        descriptor_scale: a map file stores each component times this number as a signed byte.
            At 25 a step is a third of a component's root mean square of 64 components.
        has_scale, has_angle: whether `Features.sizes_px` and `angles` vary with the image. If not,
            they are constant and matching ignores them.
        sigma_px: standard deviation of a matched key point along x and along y, pixels.
        ratio: threshold of the ratio test against the nearest rival.
        virtual_view_ratio: the same for virtual views, whose features repeat more often.
        position_weight: weight of a feature's image position beside its descriptor in image
            retrieval (`retrieval/vlad.py`).
        network: name of the network that computes the features, if any (`network_files.py`).
        sides: feature type of the virtual views of a map (`extraction.py`), if it differs from
            this one.
    """

    name: str
    extract: Callable[[UInt8[np.ndarray, "h w"], FeatureConfig, int | None], Features]
    descriptor_size: int
    guided: GuidedThresholds
    distant: GuidedThresholds
    normalization: Normalization = "wide"
    descriptor_scale: float = 25.0
    has_scale: bool = True
    has_angle: bool = True
    sigma_px: float = 1.0
    ratio: float = 0.8
    virtual_view_ratio: float = 0.9
    position_weight: float = 0.9
    network: str | None = None
    sides: str | None = None

    @property
    def virtual_view_type(self) -> str:
        """Return the name of the feature type for virtual views in maps of this type."""
        return self.sides or self.name


def _extract_surf(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None
) -> Features:
    # Detection threshold of SURF for images of 0..255. The default is low on purpose: a fixed
    # threshold depends on contrast, and a high one finds almost nothing in a dark image.
    hessian_threshold = 20.0
    from topoloc.features.surf import extract_surf

    return extract_surf(image, hessian_threshold, config.max_features, num_threads)


def _extract_sift(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None
) -> Features:
    from topoloc.features.sift import extract_sift

    return extract_sift(image, config.max_features, config.contrast_threshold)


def _learned_feature_type(
    network: str, descriptor_size: int, min_score: float, sides: str | None = None
) -> FeatureType:
    """Return a feature type computed by a network: without size and angle, on the image without
    normalisation."""

    def extract(
        image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None
    ) -> Features:
        from topoloc.features.learned import extract_learned

        numbers = descriptor_size, config.max_features, min_score, num_threads
        return extract_learned(image, network, *numbers)

    return FeatureType(
        network,
        extract,
        descriptor_size,
        guided=GuidedThresholds(min_similarity=0.7, min_margin=0.02),
        distant=GuidedThresholds(min_similarity=0.75, min_margin=0.02),
        normalization="none",
        has_scale=False,
        has_angle=False,
        ratio=0.92,
        position_weight=1.5,
        network=network,
        sides=sides,
    )


SURF = FeatureType(
    "surf",
    _extract_surf,
    64,
    guided=GuidedThresholds(min_similarity=0.75, min_margin=0.03, max_scale=1.6, max_turn=0.6),
    distant=GuidedThresholds(min_similarity=0.8, min_margin=0.02, max_scale=1.5, max_turn=0.35),
)
SIFT = FeatureType("sift", _extract_sift, 128, guided=SURF.guided, distant=SURF.distant)

LEARNED_TYPES = (
    _learned_feature_type("topoloc-net", 64, min_score=0.0067, sides="topoloc-net-sides"),
    _learned_feature_type("edgepoint2-s64", 64, min_score=0.0067),
    _learned_feature_type("edgepoint2-t32", 32, min_score=0.0067),
    _learned_feature_type("edgepoint2-e64", 64, min_score=0.0067),
    _learned_feature_type("xfeat", 64, min_score=0.05),
)
"""Learned feature types. The first one is the default."""

FEATURE_TYPES: dict[str, FeatureType] = {kind.name: kind for kind in (SURF, SIFT, *LEARNED_TYPES)}

_VIRTUAL_VIEW_TYPES = {
    "topoloc-net-sides": _learned_feature_type("topoloc-net-sides", 64, min_score=0.0067)
}
"""Feature types for virtual views only. `topoloc-net-sides` is `topoloc-net`, trained further on
walls seen from both directions. No map is made of them."""


def register_feature_type(kind: FeatureType) -> None:
    """Add a feature type to those that maps may have, in this process. A map of it is opened after
    its registration only. Raises FeatureTypeError if topoloc has features of this name."""
    if kind.name in (SURF.name, SIFT.name, *(learned.name for learned in LEARNED_TYPES)):
        raise FeatureTypeError(f"features {kind.name!r} are topoloc's; give yours another name")
    FEATURE_TYPES[kind.name] = kind


def find_feature_type(name: str) -> FeatureType:
    """Return the feature type of this name, including types for virtual views. Raises
    FeatureTypeError: the name is unknown."""
    kind = FEATURE_TYPES.get(name) or _VIRTUAL_VIEW_TYPES.get(name)
    if kind is None:
        raise FeatureTypeError(
            f"no features of kind {name!r}; there are {', '.join(FEATURE_TYPES)};"
            " topoloc.plugin.register_feature_type adds others, in each process"
        )
    return kind


def default_learned_type() -> str:
    """Return the default learned feature type, whose results are calibrated and whose network is in
    the package."""
    return LEARNED_TYPES[0].name


def parse_feature_types(text: str) -> list[str]:
    """Return the feature types that a text names, such as `surf,sift`, `learned` or `both` (SURF,
    then the default learned type).

    Raises:
        FeatureTypeError: one is unknown, or is named twice.
    """
    if text == "both":
        names = [SURF.name, default_learned_type()]
    else:
        names = [default_learned_type()] if text == "learned" else text.split(",")
    if unknown := [name for name in names if name not in FEATURE_TYPES]:
        raise FeatureTypeError(f"no features {unknown[0]!r}; there are {', '.join(FEATURE_TYPES)}")
    if len(set(names)) < len(names):
        raise FeatureTypeError(f"--features {text}: a kind is named twice")
    return names


def select_stored_types(stored: Sequence[str], text: str) -> tuple[str, ...]:
    """Return those of the stored feature types, in their order, that a text names: `learned`,
    `both` (all), or names such as `surf,topoloc-net`.

    Raises:
        FeatureTypeError: the map does not store one of them.
    """
    if text == "both":
        return tuple(stored)
    named = text.split(",")
    if text == "learned":
        named = [name for name in stored if FEATURE_TYPES[name].network is not None] or [text]
    for name in named:
        if name not in stored:
            held = ", ".join(stored)
            raise FeatureTypeError(f"the map holds no features {name} (it holds: {held})")
    return tuple(name for name in stored if name in named)


def check_available(name: str) -> None:
    """Check that features of this type can be computed on this installation.

    Raises:
        FeatureTypeError: the feature type is unknown.
        WeightsError: its network is missing.
    """
    network = find_feature_type(name).network
    if network is not None:
        from topoloc.features.learned import check_network

        check_network(network)


def find_available_types(kinds: Iterable[str]) -> list[str]:
    """Return those of the feature types that can be computed on this installation."""

    def is_available(kind: str) -> bool:
        try:
            check_available(kind)
        except WeightsError:
            return False
        return True

    return [kind for kind in kinds if is_available(kind)]
