"""The kinds of local features that a map may be made of, in one table: all that differs between
them stands here.

A kind is added by one entry in `FEATURE_TYPES`: how a picture gives its features, and the
thresholds with which they are matched. What makes its answers honest is fitted and kept beside the
code that uses it (`localization/fitted_weights.py`); until then its answers say that their
probability is not calibrated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import UInt8

from topoloc.bounds import AtLeast, Between
from topoloc.errors import FeatureTypeError
from topoloc.features.features import Features
from topoloc.features.learned import LearnedConfig, check_network, extract_learned
from topoloc.features.sift import SiftConfig, extract_sift
from topoloc.features.surf import DESCRIPTOR_LENGTH, SurfConfig, extract_surf

Normalization = Literal["none", "paper", "wide"]


@dataclass(frozen=True)
class FeatureConfig:
    """Which features an image gives. Plain values only: it is stored in the map and built again
    from them."""

    kind: str = "surf"
    """Local features of the map, and of every query to it: a name in `FEATURE_TYPES`."""
    normalization: Normalization | None = None
    """`none`. `paper`: 17x17 windows and no noise floor. `wide`: 65x65 windows and a floor of 24
    grey levels, which keeps what the paper's form gains when the light changes and loses little
    where it does not. Unset: what suits the kind."""
    max_features: Annotated[int, Between(1, 100_000)] = 1000
    """The strongest are kept."""
    hessian_threshold: Annotated[float, AtLeast(0)] = 20.0
    """Of SURF, for images of 0..255. Low on purpose: a fixed one is a threshold on contrast, and
    finds next to nothing in a dark picture."""
    contrast_threshold: Annotated[float, AtLeast(0)] = 0.01
    """The same of SIFT, as OpenCV's."""


@dataclass(frozen=True)
class GuidedThresholds:
    """Which key point near the place where a map point must be seen is that point.

    min_similarity: least scalar product of the two descriptors; min_margin: by how much the best
    key point must lead the next one. max_scale: largest ratio of a key point's size to the one
    expected, or the other way round; max_turn: largest difference of its orientation from the one
    expected, radians.
    """

    min_similarity: float
    min_margin: float
    max_scale: float = float("inf")
    max_turn: float = float("inf")


@dataclass(frozen=True)
class FeatureType:
    """A kind of local feature.

    extract: gives the features of a grey uint8 picture, strongest first, with these settings on so
    many threads. Descriptors must have unit length: they are compared by their scalar product.
    normalization: what is done to the picture first, unless the settings say otherwise.
    descriptor_scale: a map file keeps a descriptor's numbers times this as signed bytes; what
    exceeds 127 (at 200: 0.63) is clipped. has_scale, has_angle: do `Features.sizes_px` and `angles`
    follow the picture? Where they do not, all are the same, and matching does not look at them.
    sigma_px: standard deviation (pixels) of a matched key point along x and along y. ratio: a match
    must be nearer than this times its nearest rival; wall_ratio, of walls seen from the side, which
    repeat themselves. position_weight: how much a feature's place in the picture counts beside its
    descriptor where pictures are ranked (`places/vlad.py`). network: what gives the features, if a
    network does (`network_files.py`). sides: the kind that describes views to the sides
    (`virtual_views.py`) of a map of this one, if that is another. guided: thresholds for key points
    near their projection; distant: far from it, where the pose is only that of a node nearby.
    """

    name: str
    extract: Callable[[UInt8[np.ndarray, "h w"], FeatureConfig, int | None], Features]
    descriptor_size: int
    guided: GuidedThresholds
    distant: GuidedThresholds
    normalization: Normalization = "wide"
    descriptor_scale: float = 200.0
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
        """The kind by which views to the sides are described in maps of this one."""
        return self.sides or self.name


def _extract_surf(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None
) -> Features:
    settings = SurfConfig(
        hessian_threshold=config.hessian_threshold,
        max_features=config.max_features,
        num_threads=num_threads,
    )
    return extract_surf(image, settings)


def _extract_sift(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None
) -> Features:
    return extract_sift(
        image,
        SiftConfig(max_features=config.max_features, contrast_threshold=config.contrast_threshold),
    )


def _learned_feature_type(
    network: str, descriptor_size: int, min_score: float, sides: str | None = None
) -> FeatureType:
    """A kind whose features a network gives: no size, no angle, and the picture as it is."""

    def extract(
        image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None
    ) -> Features:
        return extract_learned(
            image,
            LearnedConfig(network, descriptor_size, config.max_features, min_score, num_threads),
        )

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
    DESCRIPTOR_LENGTH,
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
"""The first one is what is meant by learned features where none are named."""

FEATURE_TYPES: dict[str, FeatureType] = {kind.name: kind for kind in (SURF, SIFT, *LEARNED_TYPES)}

_VIRTUAL_VIEW_TYPES = {
    "topoloc-net-sides": _learned_feature_type("topoloc-net-sides", 64, min_score=0.0067)
}
"""Those of side views alone, which no map is made of: `topoloc-net`, taught further on walls that
are seen from their two ends."""


def find_feature_type(name: str) -> FeatureType:
    """The kind of this name, also one of side views.

    Raises:
        FeatureKindError: there is none.
    """
    kind = FEATURE_TYPES.get(name) or _VIRTUAL_VIEW_TYPES.get(name)
    if kind is None:
        raise FeatureTypeError(
            f"no features of kind {name!r}; there are {', '.join(FEATURE_TYPES)}"
        )
    return kind


def default_learned_type() -> str:
    """The learned features that are taken where the user names none: those whose answers are
    calibrated.

    Raises:
        MissingExtraError, WeightsError: what their network needs is not here.
    """
    check_available(LEARNED_TYPES[0].name)
    return LEARNED_TYPES[0].name


def parse_feature_types(text: str) -> list[str]:
    """Return the feature types that a text names, such as `surf,sift`, `learned` or `both` (SURF,
    then the default learned type).

    Raises:
        FeatureTypeError: one is unknown, or is named twice.
        MissingExtraError, WeightsError: the network of the default learned type is missing.
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
    found = [
        name
        for name in stored
        if name in named or (text == "learned" and FEATURE_TYPES[name].network is not None)
    ]
    missing = [name for name in named if name not in found] if text != "learned" else []
    if missing or not found:
        raise FeatureTypeError(
            f"the map holds no features {(missing or [text])[0]} (it holds: {', '.join(stored)})"
        )
    return tuple(found)


def check_available(name: str) -> None:
    """Can features of this kind be had here?

    Raises:
        FeatureKindError: there is no such kind.
        MissingExtraError, WeightsError: what its network needs is not there.
    """
    network = find_feature_type(name).network
    if network is not None:
        check_network(network)
