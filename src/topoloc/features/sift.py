"""Extract OpenCV's SIFT (Lowe, 2004) as `Features`, with RootSIFT descriptors, whose distance is
Hellinger's (Arandjelovic and Zisserman, 2012)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.features.features import Features


def extract_sift(
    image: UInt8[np.ndarray, "h w"], max_features: int = 2000, contrast_threshold: float = 0.02
) -> Features:
    """Return key points and 128-d RootSIFT descriptors of a grey image, strongest first.

    Args:
        max_features: number of features to keep.
        contrast_threshold: that of OpenCV, whose other settings keep their defaults.
    """
    opencv: Any = cv2  # the stubs of OpenCV 5 lack SIFT
    detector = opencv.SIFT_create(nfeatures=max_features, contrastThreshold=contrast_threshold)
    keypoints, descriptors = detector.detectAndCompute(image, None)
    if len(keypoints) == 0:
        return Features.empty(128)
    table = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], np.float32)
    # OpenCV keeps all features that tie with the last.
    order = np.argsort(-table[:, 4], kind="stable")[:max_features]
    table, descriptors = table[order], descriptors[order].astype(np.float32)
    descriptors /= np.maximum(np.linalg.norm(descriptors, ord=1, axis=1, keepdims=True), 1e-6)
    points_img, sizes, responses = table[:, :2].copy(), table[:, 2].copy(), table[:, 4].copy()
    return Features(points_img, sizes, np.deg2rad(table[:, 3]), responses, np.sqrt(descriptors))
