"""From an image to its features, by name: the one place where a kind of key point meets a
normalisation.

Maps and the queries put to them must be made with the same `FeatureConfig`: a map stores its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.features import Features
from topoloc.features.patch_normalization import PatchNormalizationConfig, patch_normalize

NORMALIZATIONS: dict[str, PatchNormalizationConfig | None] = {
    "none": None,
    "paper": PatchNormalizationConfig.paper(),
    # Wider than most key points, so that their shape survives; a noise floor, so that plain walls
    # stay plain.
    "wide": PatchNormalizationConfig(window_px=65, epsilon=24.0),
}


def extract_features(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> Features:
    """The features of a grey image, strongest first; the same for any `num_threads`. Without dense
    descriptors, which would fill the memory where features of many images are held.

    Raises:
        FeatureKindError: there is no such kind.
    """
    return replace(
        extract_from_normalized(normalize_image(image, config, num_threads), config, num_threads),
        dense=None,
    )


def normalize_image(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> UInt8[np.ndarray, "h w"]:
    """First step of `extract_features`: the picture that key points are sought in."""
    normalization = NORMALIZATIONS[
        config.normalization or find_feature_type(config.kind).normalization
    ]
    return image if normalization is None else patch_normalize(image, normalization, num_threads)


def extract_from_normalized(
    normalized: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> Features:
    """Second step of `extract_features`: the features of what `normalize_image` gave."""
    return find_feature_type(config.kind).extract(normalized, config, num_threads)
