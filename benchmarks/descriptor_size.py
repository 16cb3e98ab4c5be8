"""Compare smaller descriptors with fewer landmarks of the same bytes.

    python benchmarks/descriptor_size.py MAP QUERIES [--step 1] [--landmarks 60 120 240 10000]
    [--forms bytes coarse8 pq16 ...]

The map keeps a number of landmarks a node, chosen as by `topoloc prune`. Their descriptors are
quantised and restored in memory, and every `step`-th image of QUERIES (with truth in the map's
world) is localized. Forms:

- `bytes`: signed bytes, 1/200 a step, as map files have them;
- `coarseN`: the same with steps N times as large, packed as map files pack them;
- `pqN`: product quantisation to N bytes (Jegou et al. 2011), 256 words for each of N parts, learned
  from the map's own descriptors; the words are counted, too (256 descriptors in signed bytes a
  feature type);
- `binary`: signs of the numbers less their median over the map, one bit each.

Printed for each: bytes that the map's file would have, the share of descriptors, images localized
and wrong (off by more than 0.5 m or 5 degrees), median errors and inliers.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from jaxtyping import Float32

from topoloc import Localizer, TopoMetricMap, open_sequence
from topoloc.features.feature_types import find_feature_type
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.lifelong.prune import _drop_landmarks
from topoloc.localization.result import Localization
from topoloc.mapping.storage.map_writing import write_map
from topoloc.mapping.storage.point_encoding import compress_array, dequantize_descriptors
from topoloc.mapping.topomap import TopoNode

_WRONG_M, _WRONG_DEG, _WORDS, _LEARNED_FROM = 0.5, 5.0, 256, 40_000

Descriptors = Float32[np.ndarray, "n d"]
Form = Callable[[Descriptors], tuple[Descriptors, float]]
"""Descriptors of a node -> as they are restored, and the bytes that they take."""


@dataclass(frozen=True)
class Args:
    map: tyro.conf.Positional[Path]
    queries: tyro.conf.Positional[str]
    step: int = 1
    landmarks: tuple[int, ...] = (60, 120, 240, 10_000)
    forms: tuple[str, ...] = (
        "bytes",
        "coarse8",
        "coarse16",
        "coarse32",
        "pq8",
        "pq16",
        "pq32",
        "binary",
    )


def coarse(times: int, scale: float) -> Form:
    def form(descriptors: Descriptors) -> tuple[Descriptors, float]:
        stored = np.clip(np.rint(descriptors * scale / times), -127, 127).astype(np.int8)
        return dequantize_descriptors(stored), len(compress_array(stored))

    return form


def product_quantised(learned_from: Descriptors, num_bytes: int) -> Form:
    parts = np.split(np.arange(learned_from.shape[1]), num_bytes)
    ends = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 15, 1e-4)
    cv2.setRNGSeed(0)
    labels = np.zeros((len(learned_from), 1), np.int32)
    words = [
        cv2.kmeans(learned_from[:, p].copy(), _WORDS, labels, ends, 1, cv2.KMEANS_PP_CENTERS)[2]
        for p in parts
    ]

    def form(descriptors: Descriptors) -> tuple[Descriptors, float]:
        restored = np.empty_like(descriptors)
        for columns, of_part in zip(parts, words, strict=True):
            apart = -2.0 * descriptors[:, columns] @ of_part.T + np.square(of_part).sum(axis=1)
            restored[:, columns] = of_part[apart.argmin(axis=1)]
        return _unit(restored), len(descriptors) * num_bytes

    return form


def binary(learned_from: Descriptors) -> Form:
    middle = np.median(learned_from, axis=0)
    high, low = (
        np.array([c[over].mean() for c, over in zip(learned_from.T, o.T, strict=True)])
        for o in (learned_from > middle, learned_from <= middle)
    )
    return lambda descriptors: (
        _unit(np.where(descriptors > middle, high, low).astype(np.float32)),
        descriptors.size / 8,
    )


def _unit(descriptors: np.ndarray) -> Descriptors:
    return (
        descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-6)
    ).astype(np.float32)


def form_of(name: str, kind: str, topomap: TopoMetricMap) -> tuple[Form, int]:
    """How a kind's descriptors are quantised, and the bytes that this takes once a map."""
    scale = find_feature_type(kind).descriptor_scale
    if name == "bytes" or name.startswith("coarse"):
        return coarse(int(name.removeprefix("coarse") or 1) if name != "bytes" else 1, scale), 0
    learned_from = np.concatenate(
        [node.features.descriptors for node in topomap.layers[kind].nodes]
    )
    learned_from = learned_from[:: max(len(learned_from) // _LEARNED_FROM, 1)]
    if name == "binary":
        return binary(learned_from), 3 * learned_from.shape[1] * 4
    return (
        product_quantised(learned_from, int(name.removeprefix("pq"))),
        _WORDS * learned_from.shape[1],
    )


def with_descriptors(
    topomap: TopoMetricMap, name: str, whole: TopoMetricMap
) -> tuple[TopoMetricMap, float]:
    """The map with its descriptors restored from this form (learned from those of the whole map),
    and their bytes."""
    num_bytes, nodes = 0.0, dict[str, list[TopoNode]]()
    for kind in topomap.kinds:
        form, once = form_of(name, kind, whole)
        num_bytes, nodes[kind] = num_bytes + once, []
        for node in topomap.layers[kind].nodes:
            restored, of_node = form(node.features.descriptors)
            num_bytes += of_node
            nodes[kind].append(
                replace(
                    node,
                    features=replace(node.features, descriptors=restored),
                    stored_descriptors=None,
                )
            )
    layers = {kind: replace(layer, nodes=nodes[kind]) for kind, layer in topomap.layers.items()}
    return replace(topomap, layers=layers), num_bytes


def written(topomap: TopoMetricMap) -> tuple[int, int]:
    """Bytes of the map's file, and of the descriptors of its nodes in it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "written.topo"
        write_map(topomap, path)
        with closing(sqlite3.connect(path)) as database:
            of_descriptors = database.execute(
                "SELECT total(length(descriptors)) FROM node_points"
            ).fetchone()[0]
        return path.stat().st_size, int(of_descriptors)


def asked(topomap: TopoMetricMap, queries: str, step: int) -> str:
    localizer, sequence = Localizer(topomap), open_sequence(queries)
    metres, degrees, inliers, num = list[float](), list[float](), list[int](), 0
    for index in range(0, len(sequence), step):
        frame = sequence[index]
        result = localizer.localize(frame.image, frame.camera)
        num += 1
        if isinstance(result, Localization) and frame.world_from_cam is not None:
            metres.append(translation_error(frame.world_from_cam, result.world_from_cam))
            degrees.append(
                float(np.degrees(rotation_error(frame.world_from_cam, result.world_from_cam)))
            )
            inliers.append(result.num_inliers)
    wrong = sum(m > _WRONG_M or d > _WRONG_DEG for m, d in zip(metres, degrees, strict=True))
    medians = [np.median(values or [np.nan]) for values in (metres, degrees, inliers)]
    return (
        f"{len(metres)} of {num}, {wrong} wrong, {100 * medians[0]:.2f} cm, {medians[1]:.2f} deg,"
        f" {medians[2]:.0f} inliers"
    )


def main(args: Args) -> None:
    with TopoMetricMap.load(args.map) as whole:
        nothing = {
            kind: [np.zeros(len(node.features), bool) for node in whole.layers[kind].nodes]
            for kind in whole.kinds
        }
        for most in args.landmarks:
            fewer = _drop_landmarks(whole, nothing, most)[0]
            size, of_descriptors = written(fewer)
            for name in args.forms:
                quantised, num_bytes = with_descriptors(fewer, name, whole)
                mb, said = (
                    (size - of_descriptors + num_bytes) / 1e6,
                    asked(quantised, args.queries, args.step),
                )
                print(
                    f"{most:6d} {name:9s} {mb:6.2f} MB ({num_bytes / 1e6:.2f} of descriptors):"
                    f" {said}",
                    flush=True,
                )


if __name__ == "__main__":
    main(tyro.cli(Args))
