"""PCA whitening of place vectors (Jegou & Chum 2012), learnt from the mapping images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

# The axes of this many images are those of all; beyond it only the time grows.
MAX_LEARNING_IMAGES = 2000


@dataclass(frozen=True, eq=False)
class Whitening:
    """``projection @ (vector - mean)``, then brought to unit length."""

    mean: Float32[np.ndarray, " d"]
    projection: Float32[np.ndarray, "p d"]

    def apply(self, raw: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n p"]:
        """Unit vectors."""
        projected = (raw - self.mean) @ self.projection.T
        return np.ascontiguousarray(projected / np.maximum(np.linalg.norm(projected, axis=1, keepdims=True), 1e-6), np.float32)


def learn_whitening(raw: Float32[np.ndarray, "n d"], dimension: int) -> Whitening:
    """Mean and projection to at most `dimension` whitened components, from unit vectors of images.

    The variances are softened by the mean one, since the trailing components of few images are noise, which plain
    whitening would blow up.
    """
    raw = raw[np.unique(np.linspace(0, len(raw) - 1, MAX_LEARNING_IMAGES).astype(int))]
    mean = raw.mean(axis=0)
    centred = raw - mean
    by_image = len(raw) < raw.shape[1]  # whichever is smaller: the products of images, or those of dimensions
    eigenvalues, vectors = np.linalg.eigh(centred @ centred.T if by_image else centred.T @ centred)
    order = np.argsort(-eigenvalues, kind="stable")[:dimension]
    # Vectors are of unit length: below a millionth of that is rounding.
    keep = order[eigenvalues[order] > 1e-6 * max(float(eigenvalues.max()), len(raw) * 1e-6)]
    if len(keep) == 0:  # one image, or all alike
        direction = mean / max(float(np.linalg.norm(mean)), 1e-6)
        return Whitening(np.zeros_like(mean), direction[None].astype(np.float32))
    axes = centred.T @ vectors[:, keep] / np.sqrt(eigenvalues[keep]) if by_image else vectors[:, keep]
    softened = np.sqrt(eigenvalues[keep] + eigenvalues[keep].mean())
    return Whitening(mean.astype(np.float32), np.ascontiguousarray((axes / softened).T, np.float32))
