"""Define a third feature type in one file: FAST corners, described by the 64 grey levels of their
neighbourhood.

It has neither scale nor angle, and locates corners to a pixel only, like many learned feature
types.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.features.feature_types import FeatureConfig, FeatureType, GuidedThresholds
from topoloc.features.features import Features

_PATCH_PX, _CELLS = 24, 8


def extract_corner_patches(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int
) -> Features:
    """Extract corners of a grey image, strongest first. Each patch has zero mean
    and unit length."""
    corners = cv2.FastFeatureDetector_create(threshold=8).detect(image)  # pyright: ignore[reportAttributeAccessIssue]
    table = np.array([(*corner.pt, corner.response) for corner in corners], np.float32).reshape(
        -1, 3
    )
    inside = (table[:, :2] >= _PATCH_PX // 2).all(axis=1) & (
        table[:, :2] < np.array(image.shape[::-1]) - _PATCH_PX // 2
    ).all(axis=1)
    table = table[inside][np.argsort(-table[inside, 2], kind="stable")[: config.max_features]]
    if len(table) == 0:
        return Features.empty(_CELLS**2)
    smooth = cv2.blur(image, (_PATCH_PX // _CELLS,) * 2).astype(np.float32)
    steps = (np.arange(_CELLS) - (_CELLS - 1) / 2.0) * (_PATCH_PX / _CELLS)
    rows = np.rint(table[:, 1, None, None] + steps[:, None]).astype(int)
    columns = np.rint(table[:, 0, None, None] + steps[None, :]).astype(int)
    patches = smooth[rows, columns].reshape(len(table), -1)
    patches -= patches.mean(axis=1, keepdims=True)
    patches /= np.maximum(np.linalg.norm(patches, axis=1, keepdims=True), 1e-6)
    same, zero = np.full(len(table), _PATCH_PX, np.float32), np.zeros(len(table), np.float32)
    return Features(np.ascontiguousarray(table[:, :2]), same, zero, table[:, 2].copy(), patches)


CORNER_PATCHES = FeatureType(
    "corner-patches",
    extract_corner_patches,
    descriptor_size=_CELLS**2,
    guided=GuidedThresholds(min_similarity=0.8, min_margin=0.03),
    distant=GuidedThresholds(min_similarity=0.85, min_margin=0.05),
    normalization="none",
    descriptor_scale=150.0,
    has_scale=False,
    has_angle=False,
    sigma_px=1.5,
)
