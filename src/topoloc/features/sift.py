"""Extract OpenCV's SIFT (Lowe, 2004) as `Features`, by default with RootSIFT descriptors
(Arandjelovic and Zisserman, 2012)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import UInt8

from topoloc.bounds import Above, AtLeast, Between
from topoloc.features.features import Features


@dataclass(frozen=True)
class SiftConfig:
    """Hold OpenCV's settings under their own names."""

    max_features: Annotated[int, Between(0, 100_000)] = 2000
    """Number of features to keep, strongest first. 0 keeps all."""
    contrast_threshold: Annotated[float, AtLeast(0)] = 0.02
    """Contrast threshold, as in OpenCV."""
    edge_threshold: Annotated[float, Above(0)] = 10.0
    """Edge threshold, as in OpenCV."""
    sigma: Annotated[float, Above(0)] = 1.6
    """Blur of the first image of an octave, pixels, as in OpenCV."""
    num_octave_layers: Annotated[int, Between(1, 16)] = 3
    """Layers per octave, as in OpenCV."""
    root: bool = True
    """Take the square root of L1-normalised descriptors, so that their distance is Hellinger's."""


def extract_sift(image: UInt8[np.ndarray, "h w"], config: SiftConfig) -> Features:
    """Return key points and 128-d descriptors of a grey image, strongest first."""
    detector = cv2.SIFT_create(  # pyright: ignore[reportAttributeAccessIssue]  # missing in the stubs of OpenCV 5
        nfeatures=config.max_features,
        nOctaveLayers=config.num_octave_layers,
        contrastThreshold=config.contrast_threshold,
        edgeThreshold=config.edge_threshold,
        sigma=config.sigma,
    )
    keypoints, descriptors = detector.detectAndCompute(image, None)
    if len(keypoints) == 0:
        return Features.empty(128)
    table = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints], np.float32)
    order = np.argsort(-table[:, 4], kind="stable")
    if config.max_features:
        order = order[: config.max_features]  # OpenCV keeps all features that tie with the last
    table, descriptors = table[order], descriptors[order].astype(np.float32)
    descriptors /= np.maximum(
        np.linalg.norm(descriptors, ord=1 if config.root else 2, axis=1, keepdims=True), 1e-6
    )
    if config.root:
        descriptors = np.sqrt(descriptors)
    return Features(
        table[:, :2].copy(),
        table[:, 2].copy(),
        np.deg2rad(table[:, 3]),
        table[:, 4].copy(),
        descriptors,
    )
