"""From an image to its features, by name: the one place where a kind of key point meets a normalisation.

Maps and the queries put to them must be made with the same `FeatureConfig`: a map stores its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import UInt8

from topoloc.bounds import AtLeast, Between
from topoloc.features.features import Features
from topoloc.features.patch_normalization import PatchNormalizationConfig, patch_normalize
from topoloc.features.sift import SiftConfig, extract_sift
from topoloc.features.surf import SurfConfig, extract_surf

NORMALIZATIONS: dict[str, PatchNormalizationConfig | None] = {
    "none": None,
    "paper": PatchNormalizationConfig.paper(),
    # Wider than most key points, so that their shape survives; a noise floor, so that plain walls stay plain.
    "wide": PatchNormalizationConfig(window_px=65, epsilon=24.0),
}


@dataclass(frozen=True)
class FeatureConfig:
    """Which features an image gives. Plain values only: it is stored in the map and built again from them."""

    kind: Literal["surf", "sift"] = "surf"
    """Local features of the map, and of every query to it."""
    normalization: Literal["none", "paper", "wide"] = "wide"
    """`paper`: 17x17 windows and no noise floor. `wide`: 65x65 windows and a floor of 24 grey levels, which keeps what the paper's form
    gains when the light changes and loses little where it does not."""
    max_features: Annotated[int, Between(1, 100_000)] = 1000
    """The strongest are kept."""
    hessian_threshold: Annotated[float, AtLeast(0)] = 20.0
    """Of SURF, for images of 0..255. Low on purpose: a fixed one is a threshold on contrast, and finds next to nothing in a dark
    picture."""
    contrast_threshold: Annotated[float, AtLeast(0)] = 0.01
    """The same of SIFT, as OpenCV's."""


def extract_features(image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None) -> Features:
    """The features of a grey image, strongest first; the same for any `num_threads`."""
    return extract_normalized(normalize_image(image, config, num_threads), config, num_threads)


def normalize_image(image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None) -> UInt8[np.ndarray, "h w"]:
    """First step of `extract_features`: the picture that key points are sought in."""
    normalization = NORMALIZATIONS[config.normalization]
    return image if normalization is None else patch_normalize(image, normalization, num_threads)


def extract_normalized(normalized: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None) -> Features:
    """Second step of `extract_features`: the features of what `normalize_image` gave."""
    if config.kind == "sift":
        return extract_sift(normalized, SiftConfig(max_features=config.max_features, contrast_threshold=config.contrast_threshold))
    surf = SurfConfig(hessian_threshold=config.hessian_threshold, max_features=config.max_features, num_threads=num_threads)
    return extract_surf(normalized, surf)
