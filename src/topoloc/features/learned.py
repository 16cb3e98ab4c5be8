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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.compiled import kernel, num_threads as default_num_threads
from topoloc.errors import WeightsError
from topoloc.features.dense import GridDescriptors, SingleLevelDescriptors, TwoLevelDescriptors
from topoloc.features.features import Features
from topoloc.features.network_files import NetworkInfo, open_network

_RADIUS = 2  # pixels to each side that a maximum exceeds
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
    number, path = num_threads or default_num_threads(), NetworkInfo.of_name(network).find_file()
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


@kernel()
def find_maxima(scores, height, width, border, min_score):
    """Return the local maxima of the scores as pixels (x, y), row by row, and their scores.

    A maximum exceeds `min_score` and all other scores within two pixels. Of equal scores the first
    one counts. The image has `height` rows and `width` columns. The padded scores may have more.
    """
    most = height * width // 9 + 1
    pixels, found = np.empty((most, 2), np.int32), np.empty(most, np.float32)
    border = max(border, _RADIUS)
    count, num_columns = 0, max(width - 2 * border, 0)
    # Maxima along the window of each row, for as many rows as a window has.
    along = np.empty((2 * _RADIUS + 1, num_columns), np.float32)
    around = np.empty(num_columns, np.float32)
    for y in range(border - _RADIUS, min(height - border + _RADIUS, height) if num_columns else 0):
        _max_along_windows(scores[y], border, along[y % len(along)])
        middle = y - _RADIUS
        if middle < border:
            continue
        _max_over_rows(along, around)
        row = scores[middle][border : border + num_columns]
        for x in range(num_columns):
            is_maximum = row[x] >= around[x] and row[x] > min_score
            if is_maximum and _is_first_maximum(scores, middle, border + x):
                pixels[count, 0], pixels[count, 1], found[count] = border + x, middle, row[x]
                count += 1
    return pixels[:count].copy(), found[:count].copy()


@kernel()
def _max_along_windows(row, border, out):
    """Write the maximum score within two pixels along a row, for each pixel from `border` on."""
    n = len(out)
    a, b = row[border - 2 : border - 2 + n], row[border - 1 : border - 1 + n]
    c = row[border : border + n]
    d, e = row[border + 1 : border + 1 + n], row[border + 2 : border + 2 + n]
    for x in range(n):  # without branches, so that the loop vectorises
        left = a[x] if a[x] > b[x] else b[x]
        right = d[x] if d[x] > e[x] else e[x]
        beside = left if left > right else right
        out[x] = c[x] if c[x] > beside else beside


@kernel()
def _max_over_rows(rows, out):
    a, b, c, d, e = rows[0], rows[1], rows[2], rows[3], rows[4]
    for x in range(len(out)):
        above = a[x] if a[x] > b[x] else b[x]
        below = c[x] if c[x] > d[x] else d[x]
        both = above if above > below else below
        out[x] = e[x] if e[x] > both else both


@kernel()
def _is_first_maximum(scores, y, x):
    """Return whether no earlier pixel within two pixels has an equal score. No pixel in this window
    may exceed the score."""
    score = scores[y, x]
    for v in range(y - _RADIUS, y + 1):
        for u in range(x - _RADIUS, x + _RADIUS + 1):
            if scores[v, u] == score and (v < y or u < x):
                return False
    return True


@kernel()
def refine_subpixel(scores, pixels):
    """Return pixels (x, y) moved to the vertex of a parabola through the scores of each pixel and
    its neighbours."""
    points = np.empty((len(pixels), 2), np.float32)
    for k in range(len(pixels)):
        x, y = pixels[k, 0], pixels[k, 1]
        points[k, 0] = x + _parabola_vertex(scores[y, x - 1], scores[y, x], scores[y, x + 1])
        points[k, 1] = y + _parabola_vertex(scores[y - 1, x], scores[y, x], scores[y + 1, x])
    return points


@kernel()
def _parabola_vertex(before, here, after):
    """Return the vertex of the parabola through the logarithms of three scores at -1, 0 and 1. It
    is limited to half a pixel."""
    least = np.float32(1e-6)
    a, b, c = np.log(before + least), np.log(here + least), np.log(after + least)
    bend = a - 2 * b + c
    if bend > -1e-6:
        return np.float32(0.0)
    return np.float32(min(max(0.5 * (a - c) / bend, -0.5), 0.5))
