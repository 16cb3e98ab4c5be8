"""Encode a node's points for the map file.

Descriptors are signed bytes, roots of covariances are half floats, and the rest are single floats.
All are rounded far below their noise, so that their last bits are 0. Each array is compressed
without loss by zlib. Exponents and signs of neighbouring numbers are similar, but their last digits
are noise. So bytes of the same significance and column are stored together. Descriptors have no
repetitions for zlib to find, so `Z_FILTERED` is used.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int8

from topoloc.features.feature_types import find_feature_type
from topoloc.features.features import Features
from topoloc.json_data import decode_json
from topoloc.mapping.storage.entries import TopoNode
from topoloc.mapping.storage.schema import split_layer_name
from topoloc.mapping.validation import (
    MAX_POINTS,
    CorruptDataError,
    array_from_bytes,
    arrays_from_npz,
    check_count,
    decompress_bytes,
    pose_from_bytes,
)
from topoloc.retrieval.coarse import CoarseModel

FIRST_COMPRESSED_SCHEMA = 3
"""The first schema with compressed arrays. Older schemas store raw arrays."""

StoredPoints = tuple[
    Features, Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 6"], Int8[np.ndarray, "n d"]
]
"""Features, positions in the node's camera frame (metres), roots of their covariances, and stored
descriptors."""


def node_to_arrays(node: TopoNode, kind: str) -> list[np.ndarray]:
    """Return the node's arrays for the file, in the order of the table's columns."""
    f = node.features
    sizes_and_responses = round_mantissas(np.stack([f.sizes_px, f.responses], axis=1), 7)
    shapes = np.insert(sizes_and_responses, 1, _round_to(f.angles, 1 / 64), axis=1)
    return [
        _round_to(f.points_img, 1 / 64),
        shapes,
        _stored_or_quantized(node, find_feature_type(kind).descriptor_scale),
        round_mantissas(node.points_cam, 15),
        round_mantissas(node.point_sqrt_covs.astype("<f2"), 7),
    ]


def round_mantissas(numbers: np.ndarray, num_bits: int) -> np.ndarray:
    """Return half or single floats whose mantissas are rounded to `num_bits`. The relative error is
    at most ``2 ** -(num_bits + 1)``."""
    unused = np.finfo(numbers.dtype).nmant - num_bits
    bits = np.ascontiguousarray(numbers).view(f"<u{numbers.itemsize}")
    rounded = (bits + bits.dtype.type(1 << (unused - 1))) >> unused << unused
    return rounded.view(numbers.dtype)


def _round_to(numbers: np.ndarray, step: float) -> np.ndarray:
    return (np.rint(numbers / step) * step).astype("<f4")


def points_from_row(row: Mapping[str, Any], kind: str, schema: int, what: str) -> StoredPoints:
    """Decode the points of a row of `node_points` of this schema. Raises CorruptDataError."""
    n = check_count(row["num_points"], 0, MAX_POINTS, f"the points of {what}")
    size = find_feature_type(kind).descriptor_size
    if row["descriptor_size"] != size:
        raise CorruptDataError(f"the points of {what} are not described as {kind} is")
    shapes = {
        "points_img": ("<f4", 2),
        "shapes": ("<f4", 3),
        "descriptors": ("i1", size),
        "points_cam": ("<f4", 3),
        "sqrt_covs": ("<f2", 6),
    }
    read = decompress_array if schema >= FIRST_COMPRESSED_SCHEMA else array_from_bytes
    arrays = {
        name: read(row[name], dtype, (n, width), what) for name, (dtype, width) in shapes.items()
    }
    sizes, angles, responses = np.ascontiguousarray(arrays["shapes"].T)
    stored = arrays["descriptors"]
    features = Features(
        arrays["points_img"], sizes, angles, responses, dequantize_descriptors(stored)
    )
    return features, arrays["points_cam"], arrays["sqrt_covs"].astype(np.float32), stored


def compress_array(array: np.ndarray) -> bytes:
    """Compress an array (n, columns) by zlib. For each column, all first bytes of its numbers come
    first, then all second ones, and so on."""
    n, width = array.shape
    planes = (
        np.frombuffer(array.tobytes(), np.uint8)
        .reshape(n, width, array.itemsize)
        .transpose(1, 2, 0)
    )
    packer = zlib.compressobj(6, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_FILTERED)
    return packer.compress(planes.tobytes()) + packer.flush()


def decompress_array(data: bytes, dtype: str, shape: tuple[int, int], what: str) -> np.ndarray:
    """Decode the bytes of `compress_array` with the checks of `array_from_bytes`. Raises
    CorruptDataError."""
    (n, width), num_bytes = shape, np.dtype(dtype).itemsize
    planes = np.frombuffer(
        decompress_bytes(data, math.prod(shape) * num_bytes, what), np.uint8
    ).reshape(width, num_bytes, n)
    return array_from_bytes(planes.transpose(2, 0, 1).tobytes(), dtype, shape, what)


def dequantize_descriptors(stored: Int8[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    """Return descriptors of length 1 from the file's signed bytes."""
    descriptors = stored.astype(np.float32)
    lengths = np.sqrt(np.einsum("nd,nd->n", descriptors, descriptors))  # exact for bytes
    descriptors /= np.maximum(lengths, np.float32(1e-6))[:, None]
    return descriptors


def quantize_descriptors(
    descriptors: Float32[np.ndarray, "n d"], scale: float
) -> Int8[np.ndarray, "n d"]:
    """Return descriptors of length 1, times `scale`, as signed bytes."""
    return np.clip(np.rint(descriptors * scale), -127, 127).astype(np.int8)


def _stored_or_quantized(node: TopoNode, scale: float) -> Int8[np.ndarray, "n d"]:
    """Return the descriptors as signed bytes. A node read from a file keeps the bytes of the
    file."""
    descriptors, stored = node.features.descriptors, node.stored_descriptors
    if (
        stored is not None
        and stored.shape == descriptors.shape
        and np.array_equal(dequantize_descriptors(stored), descriptors)
    ):
        return stored
    return quantize_descriptors(descriptors, scale)


def model_from_row(row: Mapping[str, Any]) -> CoarseModel:
    """Decode a row of `coarse_models`. Raises CorruptDataError."""
    what = f"coarse localizer {row['name']}"
    settings = decode_json(row["settings"], dict[str, Any], CorruptDataError, what)
    name = split_layer_name(row["name"])[0]
    return CoarseModel(name, settings, arrays_from_npz(row["arrays"], what))


def moves_from_row(row: Mapping[str, Any]) -> Float[np.ndarray, "k 4 4"]:
    """Decode a row of `repetitions`. Raises CorruptDataError."""
    max_moves = 1000
    what = f"the repetitions of node {row['node_id']}"
    count, data = check_count(row["num_moves"], 1, max_moves, what), row["moves"]
    size = len(data) // count
    poses = [pose_from_bytes(data[k * size : (k + 1) * size]) for k in range(count)]
    return np.array([pose.matrix() for pose in poses])
