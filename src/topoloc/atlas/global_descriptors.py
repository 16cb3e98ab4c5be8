"""Compute the global descriptors of a tile's nodes from their stored features.

They use the shared vocabularies.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from topoloc.errors import AtlasError
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.retrieval.shared_vocabulary import shared_vocabulary

GlobalDescriptors = Mapping[str, Float32[np.ndarray, "_ _"]]
"""Unit vectors of a tile's nodes, by feature type."""


def compute_global_descriptors(topomap: TopoMetricMap) -> dict[str, Float32[np.ndarray, "_ _"]]:
    """Compute the global descriptors of all nodes of a map, in order, by feature type.

    Feature types without a shared vocabulary are skipped.

    Raises:
        AtlasError: no feature type of the map has one.
    """
    vectors = {}
    for kind, layer in topomap.layers.items():
        vocabulary = shared_vocabulary(kind)
        if vocabulary is None:
            continue
        rows = [
            vocabulary.global_descriptor(node.features, node.camera.width, node.camera.height)
            for node in layer.nodes
        ]
        vectors[kind] = np.stack(rows)
    if not vectors:
        raise AtlasError(
            f"there is no shared vocabulary for features {', '.join(topomap.kinds)}, so that no"
            " place of the map can be ranked"
        )
    return vectors


def save_global_descriptors(path: Path, vectors: GlobalDescriptors) -> None:
    """Write the descriptors as half floats, one array for each feature type.

    Raises:
        OSError: the file cannot be written.
    """
    arrays: dict[str, Any] = {kind: rows.astype(np.float16) for kind, rows in vectors.items()}
    with path.open("wb") as file:
        np.savez(file, **arrays)


def load_global_descriptors(
    path: Path, versions: Mapping[str, str]
) -> dict[str, Float32[np.ndarray, "_ _"]]:
    """Read the output of `save_global_descriptors`.

    `versions` holds the vocabulary versions of the vectors by feature type. Vectors of versions
    other than the installed ones are skipped.

    Raises:
        AtlasError: the file is missing or damaged, or no version matches.
    """
    vectors = {}
    try:
        with np.load(path, allow_pickle=False) as stored:
            for kind in stored.files:
                vocabulary, rows = shared_vocabulary(kind), stored[kind]
                if rows.ndim != 2 or rows.dtype != np.float16 or not np.isfinite(rows).all():
                    raise AtlasError(f"{path} is damaged: the vectors of {kind} are none")
                if (
                    vocabulary is not None
                    and vocabulary.version == versions.get(kind)
                    and rows.shape[1] == vocabulary.dimension
                ):
                    vectors[kind] = rows.astype(np.float32)
    except (OSError, ValueError, KeyError, EOFError, SyntaxError, zipfile.BadZipFile) as error:
        raise AtlasError(
            f"{path} is missing or damaged: {' '.join(str(error).split())[:120]}"
        ) from None
    if not vectors:
        raise AtlasError(
            f"{path} holds place vectors of another version of topoloc: `topoloc atlas add"
            " --replace` makes them anew"
        )
    return vectors
