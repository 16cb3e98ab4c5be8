"""Learned local features: a network reads the whole picture once and gives a score for every pixel and a descriptor for every few.

All networks come as ONNX files of one form and run in ONNX Runtime: grey in [0, 1] goes in, its sides multiples of 32; out come the score
of each pixel being a key point, and descriptors on a coarser grid; of some networks also a level by which places are known again. Key
points are the maxima of the scores, to a fraction of a pixel by a parabola through each and its neighbours.
"""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from topoloc import compiled
from topoloc.errors import WeightsError
from topoloc.features.dense import DenseDescriptors
from topoloc.features.features import Features
from topoloc.features.learned_kernels import find_maxima, sample_descriptors
from topoloc.features.network_files import find_network, open_network

_SIDE_MULTIPLE = 32
_BORDER_PX = 4
_CELLS = (4, 6)  # rows and columns of the picture that places are known by
SIZE_PX = 16.0
"""The size that all these key points are said to have."""


@dataclass(frozen=True)
class LearnedConfig:
    """Which network, and how many of its key points.

    min_score: key points score more than this.
    """

    network: str
    descriptor_size: int
    max_features: int = 1000
    min_score: float = 0.007
    num_threads: int | None = None


def extract_learned(image: UInt8[np.ndarray, "h w"], config: LearnedConfig) -> Features:
    """Key points and descriptors of a grey image, strongest first; without size and angle.

    Raises:
        MissingExtraError: ONNX Runtime is not installed.
        WeightsError: the network's file is missing, damaged or another network's.
    """
    height, width = image.shape
    scores, dense, places = run_network(image, config.network, config.num_threads)
    if dense.shape[0] != config.descriptor_size:
        raise WeightsError(f"the network {config.network} gives descriptors of {dense.shape[0]} numbers, not {config.descriptor_size}")
    points_img, found = find_maxima(scores, height, width, _BORDER_PX, np.float32(config.min_score))
    order = np.argsort(-found, kind="stable")[: config.max_features]
    points_img = points_img[order]
    stride_px = scores.shape[0] / dense.shape[1]
    descriptors = sample_descriptors(dense, points_img, np.float32(stride_px))
    sizes, angles = np.full(len(order), SIZE_PX, np.float32), np.zeros(len(order), np.float32)
    cells = None if places is None else mean_cells(places, height / scores.shape[0], width / scores.shape[1])
    return Features(points_img, sizes, angles, found[order], descriptors, cells, DenseDescriptors(dense, stride_px))


def mean_cells(level: Float32[np.ndarray, "c h w"], height_share: float, width_share: float) -> Float32[np.ndarray, "rows columns c"]:
    """Means of a network's level over a grid of cells, of that share of its rows and columns that the picture fills."""
    for axis, share, count in ((1, height_share, _CELLS[0]), (2, width_share, _CELLS[1])):
        length = max(1, round(level.shape[axis] * share))
        starts = np.arange(count) * length // count
        sizes = np.maximum(np.diff(starts, append=length), 1).astype(np.float32)
        level = np.add.reduceat(level.take(range(length), axis), starts, axis)
        level /= sizes.reshape(-1, 1) if axis == 1 else sizes
    return np.ascontiguousarray(level.transpose(1, 2, 0))


def check_network(network: str) -> None:
    """Is the network there? Raises as `extract_learned`."""
    _session(network, find_network(network), compiled.num_threads(), os.getpid())


def run_network(
    image: UInt8[np.ndarray, "h w"], network: str, num_threads: int | None = None
) -> tuple[
    Float32[np.ndarray, "padded_h padded_w"], Float32[np.ndarray, "d grid_h grid_w"], Float32[np.ndarray, "c level_h level_w"] | None
]:
    """The scores and the dense descriptors (not normalised) of a picture, which is continued by its border to the sides asked; and the
    level by which places are known again, where the network has one."""
    height, width = image.shape
    padding = [(0, -side % _SIDE_MULTIPLE) for side in (height, width)]
    grey = np.pad(image, padding, mode="edge").astype(np.float32) / np.float32(255.0)
    session = _session(network, find_network(network), num_threads or compiled.num_threads(), os.getpid())
    scores, dense, *places = session.run(None, {"image": grey[None, None]})
    return scores[0, 0], dense[0], places[0][0] if places else None


@functools.lru_cache(maxsize=8)
def _session(network: str, path: Path, num_threads: int, process_id: int) -> Any:
    """The network made ready; a forked child makes its own."""
    known, session = open_network(path, num_threads)
    if known.name != network:
        raise WeightsError(f"network {path}: holds {known.name}, not {network}")
    return session
