"""A scene as one JSON document, for a page of its own, a report, or the service.

Results have the format of `Localization.to_json`, so pages show results of files and of the service
with the same code. docs/viewer.md lists the keys.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from topoloc import Camera, Rigid3, TopoMetricMap, read_image
from topoloc.apps.core_names import encode_jpeg
from topoloc.apps.quality.certificate_texts import describe_group
from topoloc.apps.viewer.map_scene import sample_node_colours, unique_image_names
from topoloc.plugin import EncodedImage

GAP_STEPS = 6.0
"""A step longer than this many median steps is a gap, over which no line is drawn."""
MAX_PATH, MAX_RESULTS = 5_000, 10_000
_MAX_POINT_SIGMA = 0.1  # of a point's distance from its node; others are left out
_IMAGE_WIDTHS = (320, 240, 160, 120, 96)
_JPEG_QUALITY = 75


@dataclass(frozen=True)
class SceneBudget:
    """Bounds of a document: points of 20 bytes each, and bytes of all images in base64."""

    max_points: int = 150_000
    max_image_bytes: int = 3_500_000


@dataclass(frozen=True)
class ResultSet:
    """Results of one file or recording, as JSON with `true_world_from_cam` if the truth is known;
    or only a path."""

    name: str
    answers: Sequence[Mapping[str, Any]] = ()
    path: Sequence[Rigid3] = ()


def create_document(
    topomap: TopoMetricMap,
    name: str,
    results: Sequence[ResultSet] = (),
    budget: SceneBudget | None = None,
    on_node: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Return the document of a map and of results in it. `on_node` is called for each node, and its
    errors end the work. Raises MapError: the map cannot be read."""
    budget = budget or SceneBudget()
    shown = _read_nodes(topomap, budget.max_points, on_node)
    poses = [summary.world_from_cam for summary in topomap.summaries]
    centres = np.array([pose.translation for pose in poses])
    focus = _find_focus_box(centres, shown.points_world)
    images = _encode_images(shown.images, budget.max_image_bytes, on_node)
    return {
        "format": "topoloc-scene",
        "version": 1,
        "name": name,
        "up": _find_up_axis(topomap, poses).round(6).tolist(),
        "focus": [corner.round(3).tolist() for corner in focus],
        "map": _describe_map(topomap, len(shown.points_world)),
        "points": {
            "world": to_base64(shown.points_world.astype("<f4")),
            "rgb": to_base64(shown.rgb),
        },
        "nodes": _nodes_to_json(topomap, shown.cameras, images),
        "junctions": topomap.junctions,
        "paths": [*_mapped_paths(topomap), *result_paths(results)],
        "results": [results_to_json(one) for one in results if one.answers],
    }


def to_script_json(document: Mapping[str, Any]) -> str:
    """Return the document as text for a script element of HTML or XHTML."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _describe_map(topomap: TopoMetricMap, num_shown: int) -> dict[str, Any]:
    sessions = [
        {"id": s.session_id, "name": s.name, "date": s.start_date} for s in topomap.sessions
    ]
    return {
        "id": topomap.id,
        "version": topomap.version,
        "num_nodes": len(topomap.summaries),
        "num_points": sum(summary.num_points for summary in topomap.summaries),
        "num_points_shown": num_shown,
        "length_m": topomap.length_m,
        **({} if topomap.config.has_scale else {"scale": "none"}),
        "sessions": sessions,
        "certificate": _describe_certificate(topomap),
    }


def _describe_certificate(topomap: TopoMetricMap) -> dict[str, Any] | None:
    """Return the certificate as JSON, with the promise of each group in words."""
    facts, certificate = topomap.describe_certificate(), topomap.certificate
    if facts is None or certificate is None:
        return None
    return facts | {"group_promises": [": ".join(describe_group(g)) for g in certificate.groups]}


@dataclass(frozen=True, eq=False)
class _NodeContent:
    """The camera and image of each node, and the points of all nodes with their colours."""

    cameras: list[Camera]
    images: list[bytes]
    points_world: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


def _read_nodes(
    topomap: TopoMetricMap, max_points: int, on_node: Callable[[], None]
) -> _NodeContent:
    """Return at most `max_points` precise points, evenly from all nodes, with image colours."""
    share = min(1.0, max_points / max(1, sum(summary.num_points for summary in topomap.summaries)))
    cameras, images = list[Camera](), list[bytes]()
    points, colours = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for node in topomap.nodes:
        on_node()
        sigmas = np.linalg.norm(node.point_sqrt_covs.astype(np.float64), axis=1)
        known = sigmas <= _MAX_POINT_SIGMA * np.linalg.norm(node.points_cam, axis=1)
        rows = np.flatnonzero(known & np.isfinite(node.points_cam).all(axis=1))
        steps = np.linspace(0, len(rows), int(share * len(rows)), endpoint=False)
        chosen = rows[steps.astype(np.int64)]
        points.append(node.summary.world_from_cam.apply(node.points_cam[chosen].astype(np.float64)))
        colours.append(
            sample_node_colours(node, node.features.points_img[chosen].astype(np.float64))
        )
        cameras.append(node.camera)
        images.append(node.template_image)
    rgb = np.concatenate(colours).round().astype(np.uint8)
    return _NodeContent(cameras, images, np.concatenate(points), rgb)


def _find_up_axis(topomap: TopoMetricMap, poses: Sequence[Rigid3]) -> Float[np.ndarray, "3"]:
    """Return up on earth in a georeferenced map, else the mean up of the cameras.

    The mean is replaced by an axis of the world within 25 degrees.
    """
    if topomap.georeference is not None:
        return topomap.georeference.enu_from_world.rotation.T @ np.array([0.0, 0.0, 1.0])
    up = -np.mean([pose.rotation[:, 1] for pose in poses], axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.3:
        return np.array([0.0, 0.0, 1.0])
    up, axis = up / length, np.zeros(3)
    axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
    return axis if axis @ up > np.cos(np.deg2rad(25.0)) else up


def _find_focus_box(
    centres: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (low, high) corners of the first view: all nodes and 94 % of the points."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    if len(points):
        low = np.minimum(low, np.quantile(points, 0.03, axis=0))
        high = np.maximum(high, np.quantile(points, 0.97, axis=0))
    return low, high


def _nodes_to_json(
    topomap: TopoMetricMap, cameras: Sequence[Camera], pictures: Sequence[str | None]
) -> list[dict[str, Any]]:
    return [
        {
            "id": summary.node_id,
            "name": name,
            "session": summary.session_id,
            "num_points": summary.num_points,
            "world_from_cam": _round_values(summary.world_from_cam.to_json()),
            "camera": camera.to_json(),
            "picture": picture,
        }
        for summary, name, camera, picture in zip(
            topomap.summaries, unique_image_names(topomap), cameras, pictures, strict=True
        )
    ]


def _encode_images(
    images: Sequence[bytes], max_bytes: int, on_node: Callable[[], None]
) -> list[str | None]:
    """Return the images as base64, at the largest common width that fits into the budget.

    If the smallest width is too large, only every k-th image is kept.
    """
    room = max_bytes * 3 // 4
    if sum(map(len, images)) <= room:
        return [to_base64(one) if one else None for one in images]
    tried = images[:: max(1, len(images) // 12)]
    sizes = {
        width: len(images) * float(np.mean([len(_resize(one, width)) for one in tried]))
        for width in _IMAGE_WIDTHS
    }
    width = next((width for width, size in sizes.items() if size <= room), _IMAGE_WIDTHS[-1])
    step = max(1, int(np.ceil(sizes[width] / room)))
    found = list[str | None]()
    for row, one in enumerate(images):
        on_node()
        found.append(to_base64(_resize(one, width)) if one and row % step == 0 else None)
    return found


def _resize(encoded: bytes, width: int) -> bytes:
    """Return an image that was read before as a JPEG of at most this width."""
    if not encoded:
        return b""
    picture = read_image(EncodedImage("an image of the map", encoded))
    scale = min(1.0, width / picture.shape[1])
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return encode_jpeg(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), _JPEG_QUALITY)


def _mapped_paths(topomap: TopoMetricMap) -> Iterator[dict[str, Any]]:
    """Yield the trajectory of each session: its mapping images, or its nodes if there are more."""
    for session in topomap.sessions:
        nodes, images = (
            [one.world_from_cam for one in entries if one.session_id == session.session_id]
            for entries in (topomap.summaries, topomap.place_images)
        )
        if poses := max(nodes, images, key=len):
            yield _path_to_json(session.name, poses) | {"session": session.session_id}


def result_paths(results: Sequence[ResultSet]) -> list[dict[str, Any]]:
    """Return the paths of results that are trajectories."""
    return [_path_to_json(one.name, one.path) for one in results if one.path]


def _path_to_json(name: str, poses: Sequence[Rigid3]) -> dict[str, Any]:
    """Return a path as lines, divided at gaps. Long paths are sampled."""
    step = max(1, -(-len(poses) // MAX_PATH))
    path = np.array([pose.translation for pose in poses[::step]])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1 if len(steps) else []
    return {"name": name, "lines": [line.round(4).tolist() for line in np.split(path, gaps)]}


def results_to_json(results: ResultSet) -> dict[str, Any]:
    """Return results for the document. Long lists are sampled."""
    step = max(1, -(-len(results.answers) // MAX_RESULTS))
    return {
        "name": results.name,
        "num_answers": len(results.answers),
        "answers": [_round_values(dict(one)) for one in results.answers[::step]],
    }


def _round_values(value: Any) -> Any:
    """Round all numbers to 8 digits."""
    if isinstance(value, float):
        return float(f"{value:.8g}") if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _round_values(one) for key, one in value.items()}
    return [_round_values(one) for one in value] if isinstance(value, list | tuple) else value


def to_base64(data: np.ndarray | bytes) -> str:
    """Return bytes, or the bytes of an array, in base64."""
    return base64.b64encode(bytes(data)).decode("ascii")
