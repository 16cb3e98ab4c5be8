"""Extract learned local features: one network run on the whole image yields a score per pixel and
coarser descriptors.

All networks are ONNX files of one form and run in ONNX Runtime. The input is grey in [0, 1], with
sides that are multiples of 32. The outputs are a key point score per pixel and descriptors on a
coarser grid. Some networks also return a level for image retrieval. Key points are the local maxima
of the scores. The strongest ones are refined to subpixels with a parabola through the neighbouring
scores.
"""

from __future__ import annotations

import functools
import os
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from topoloc import compiled
from topoloc.errors import WeightsError
from topoloc.features.features import DenseDescriptors, Features
from topoloc.features.learned_kernels import (
    combine_levels,
    find_maxima,
    is_local_best_match,
    normalize_descriptors,
    refine_subpixel,
    sample_descriptors,
    sample_levels,
)
from topoloc.features.network_files import NetworkInfo, open_network

_RADIUS = 4  # grid steps to each side in which the most similar descriptor is searched


class GridDescriptors(DenseDescriptors):
    """Hold one descriptor every `stride_px` pixels. The descriptor of pixel (x, y) lies at column
    (x + 0.5) / stride_px - 0.5, and rows likewise.

    A key point supports a pose only if it is detected again. In rain or at night most key points
    are not. Dense descriptors need no detection. If a pose is right, the most similar descriptor
    around a map point's projection lies at the projection itself.
    """

    @cached_property
    @abstractmethod
    def grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""

    def check_agreement(
        self, points_img: Float[np.ndarray, "n 2"], descriptors: Float32[np.ndarray, "n d"]
    ) -> Bool[np.ndarray, " n"]:
        """Return for each point whether its best match lies at its projection.

        The most similar descriptor is searched within 4 grid steps to each side. It must lie at
        most one grid step from the point.
        """
        points_img, stride_px = points_img.astype(np.float32), np.float32(self.stride_px)
        return is_local_best_match(self.grid, points_img, descriptors, stride_px, _RADIUS)


@dataclass(frozen=True, eq=False)
class SingleLevelDescriptors(GridDescriptors):
    """Hold the output of most networks: one plane per component, not of unit length."""

    planes: Float32[np.ndarray, "d rows columns"]
    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        return self.planes.shape[0]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        return sample_descriptors(self.planes, points_img, np.float32(self.stride_px))

    @cached_property
    def grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""
        return normalize_descriptors(self.planes)


@dataclass(frozen=True, eq=False)
class TwoLevelDescriptors(GridDescriptors):
    """Hold two levels whose sum is the descriptors: `coarse`, enlarged bilinearly to twice its rows
    and columns, and `fine` times `weights`.

    Both operations are linear, and few descriptors of the grid are sampled. So the sum is computed
    only at the sampled points.
    """

    coarse: Float32[np.ndarray, "half_rows half_columns d"]
    fine: Float32[np.ndarray, "rows columns k"]
    weights: Float32[np.ndarray, "k d"]
    stride_px: float

    @property
    def size(self) -> int:
        """Return the length of a descriptor."""
        return self.coarse.shape[2]

    def sample(self, points_img: Float32[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n d"]:
        """Return descriptors of unit length at these pixels, interpolated bilinearly."""
        levels = self.coarse, self.fine, self.weights
        return sample_levels(*levels, points_img, np.float32(self.stride_px))

    @cached_property
    def grid(self) -> Float32[np.ndarray, "rows columns d"]:
        """Return the whole grid with descriptors of unit length."""
        return combine_levels(self.coarse, self.fine, self.weights)


_SIDE_MULTIPLE = 32
_BORDER_PX = 4
_CELLS = (4, 6)  # rows and columns of image cells, for image retrieval
KEY_POINT_SIZE_PX = 16.0
"""Constant size of all learned key points, pixels."""


def extract_learned(
    image: UInt8[np.ndarray, "h w"],
    network: str,
    descriptor_size: int,
    max_features: int = 1000,
    min_score: float = 0.007,
    num_threads: int | None = None,
) -> Features:
    """Return key points and descriptors of a grey image, strongest first. Size and angle are
    constant.

    Args:
        min_score: key points must have a higher score.
        num_threads: threads of the network. Default: the number of `set_num_threads`.

    Raises:
        WeightsError: the network's file is missing, damaged or of another network.
    """
    height, width = image.shape
    network_output = run_network(image, network, num_threads)
    scores, dense = network_output.scores, network_output.dense
    if dense.size != descriptor_size:
        raise WeightsError(
            f"the network {network} gives descriptors of {dense.size} numbers, not"
            f" {descriptor_size}"
        )
    pixels, found = find_maxima(scores, height, width, _BORDER_PX, np.float32(min_score))
    order = np.argsort(-found, kind="stable")[:max_features]
    points_img = refine_subpixel(scores, pixels[order])
    sizes = np.full(len(order), KEY_POINT_SIZE_PX, np.float32)
    angles, cells = np.zeros_like(sizes), None
    if network_output.places is not None:
        fractions = height / scores.shape[0], width / scores.shape[1]
        cells = compute_cell_means(network_output.places, *fractions)
    return Features(points_img, sizes, angles, found[order], dense.sample(points_img), cells, dense)


def compute_cell_means(
    level: Float32[np.ndarray, "c h w"], height_share: float, width_share: float
) -> Float32[np.ndarray, "rows columns c"]:
    """Return the means of a network level over a grid of 4 x 6 cells. Only the fraction of rows and
    columns that the image covers is used, without the padding."""
    for axis, share, count in ((1, height_share, _CELLS[0]), (2, width_share, _CELLS[1])):
        length = max(1, round(level.shape[axis] * share))
        starts = np.arange(count) * length // count
        sizes = np.maximum(np.diff(starts, append=length), 1).astype(np.float32)
        level = np.add.reduceat(level.take(range(length), axis), starts, axis)
        level /= sizes.reshape(-1, 1) if axis == 1 else sizes
    return np.ascontiguousarray(level.transpose(1, 2, 0))


def check_network(network: str) -> None:
    """Check that the network can be opened. Raises the errors of `extract_learned`."""
    _session_for_size(network, NetworkInfo.of_name(network).find_file(), 1, None, os.getpid())


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """Hold the pixel scores, the dense descriptors, and the level for image retrieval if the
    network has one."""

    scores: Float32[np.ndarray, "padded_h padded_w"]
    dense: GridDescriptors
    places: Float32[np.ndarray, "c level_h level_w"] | None


def run_network(
    image: UInt8[np.ndarray, "h w"], network: str, num_threads: int | None = None
) -> NetworkOutput:
    """Run a network on an image. The image is padded with its border pixels to sides that are
    multiples of 32."""
    height, width = image.shape
    padding = np.array([(0, -side % _SIDE_MULTIPLE) for side in (height, width)])
    grey = np.pad(image, padding, mode="edge").astype(np.float32) / np.float32(255.0)
    number, path = num_threads or compiled.num_threads(), NetworkInfo.of_name(network).find_file()
    session = _session_for_size(network, path, number, grey.shape, os.getpid())
    names = [output.name for output in session.get_outputs()]
    outputs = dict(zip(names, session.run(names, {"image": grey[None, None]}), strict=True))
    scores, places = outputs["scores"][0, 0], outputs.get("places")
    if "coarse" in outputs:
        coarse, fine, weights = outputs["coarse"][0], outputs["fine"][0], outputs["fine_weights"]
        dense = TwoLevelDescriptors(coarse, fine, weights, len(scores) / len(fine))
    else:
        planes = outputs["descriptors"][0]
        dense = SingleLevelDescriptors(planes, len(scores) / planes.shape[1])
    return NetworkOutput(scores, dense, None if places is None else places[0])


@functools.lru_cache(maxsize=6)
def _session_for_size(
    network: str, path: Path, num_threads: int, size: tuple[int, int] | None, process_id: int
) -> Any:
    """Return a session prepared for images of one size. The preparation takes some 10 ms, and each
    image then takes 0.8 of the time. A forked child creates its own session.

    Each session holds some 100 bytes per pixel, so only a few are kept.
    """
    known, session = open_network(path, num_threads, size)
    if known.name != network:
        raise WeightsError(f"network {path}: holds {known.name}, not {network}")
    return session


def close_networks() -> None:
    """Close all open networks. They are opened again when needed."""
    _session_for_size.cache_clear()
