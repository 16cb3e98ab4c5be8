"""Extract the features of an image with a feature type and a normalisation, both chosen by name.

A map and its queries must use the same `FeatureConfig`. Each map stores its own.
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
    # The window is wider than most key points, so that it keeps their shape. The noise floor keeps
    # textureless walls plain.
    "wide": PatchNormalizationConfig(window_px=65, epsilon=24.0),
}


def extract_features(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> Features:
    """Return the features of a grey image, strongest first. They are the same for any
    `num_threads`.

    Dense descriptors are dropped: they would fill the memory if features of many images are held.

    Raises:
        FeatureTypeError: the feature type is unknown.
    """
    return replace(
        extract_from_normalized(normalize_image(image, config, num_threads), config, num_threads),
        dense=None,
    )


def normalize_image(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> UInt8[np.ndarray, "h w"]:
    """Return the normalised image in which key points are detected. This is the first step of
    `extract_features`."""
    normalization = NORMALIZATIONS[
        config.normalization or find_feature_type(config.kind).normalization
    ]
    return image if normalization is None else patch_normalize(image, normalization, num_threads)


def extract_from_normalized(
    normalized: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> Features:
    """Return the features of an image from `normalize_image`, with dense descriptors if the feature
    type has them. This is the second step of `extract_features`."""
    return find_feature_type(config.kind).extract(normalized, config, num_threads)
