"""A scene as one JSON document: what `static/` shows in 3-D, in a page of its own, in a report, and
from the service.

Results are in it as they are on the wire (`Localization.to_json`), so that a page shows those of a
file and live ones by one code. Its keys are in docs/viewer.md.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from topoloc import Camera, Rigid3, TopoMetricMap
from topoloc.apps.viewer.map_scene import sample_colours, unique_image_names
from topoloc.plugin import encode_jpeg

GAP_STEPS = 6.0
"""A step so many times the path's median step is a gap, over which no line is drawn."""
MAX_PATH, MAX_RESULTS = 5_000, 10_000
_MAX_POINT_SIGMA = 0.1  # of a point's distance from its node; less certain ones are a haze
_IMAGE_WIDTHS = (320, 240, 160, 120, 96)
_JPEG_QUALITY = 75


@dataclass(frozen=True)
class SceneBudget:
    """How large a document may become: points at 20 bytes each, and bytes of all nodes' pictures as
    they stand in it."""

    max_points: int = 150_000
    max_image_bytes: int = 3_500_000


@dataclass(frozen=True)
class ResultSet:
    """Answers of one file or recording, as JSON (`to_json`), with `true_world_from_cam` where the
    truth is known; or only a path."""

    name: str
    answers: Sequence[Mapping[str, Any]] = ()
    path: Sequence[Rigid3] = ()


def create_document(
    topomap: TopoMetricMap,
    name: str,
    results: Sequence[ResultSet] = (),
    budget: SceneBudget | None = None,
) -> dict[str, Any]:
    """The map and what was found in it.

    Raises:
        MapError: the map cannot be read.
    """
    budget = budget or SceneBudget()
    shown = _read_nodes(topomap, budget.max_points)
    poses = [summary.world_from_cam for summary in topomap.summaries]
    return {
        "format": "topoloc-scene",
        "version": 1,
        "name": name,
        "up": _find_up_axis(topomap, poses).round(6).tolist(),
        "focus": [
            corner.round(3).tolist()
            for corner in _find_focus_box(
                np.array([pose.translation for pose in poses]), shown.points_world
            )
        ],
        "map": _describe_map(topomap, len(shown.points_world)),
        "points": {
            "world": _to_base64(shown.points_world.astype("<f4")),
            "rgb": _to_base64(shown.rgb),
        },
        "nodes": _nodes_to_json(
            topomap, shown.cameras, _encode_images(shown.jpegs, budget.max_image_bytes)
        ),
        "paths": [
            *_mapped_paths(topomap),
            *(
                path_to_json(one.name, [p.translation for p in one.path])
                for one in results
                if one.path
            ),
        ],
        "results": [results_to_json(one) for one in results if one.answers],
    }


def to_script_json(document: Mapping[str, Any]) -> str:
    """The document as text that can stand inside a script element of HTML or XHTML."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _describe_map(topomap: TopoMetricMap, num_shown: int) -> dict[str, Any]:
    sessions = [
        {"id": s.session_id, "name": s.name, "date": s.start_date} for s in topomap.sessions
    ]
    num_points = sum(summary.num_points for summary in topomap.summaries)
    facts = {
        "id": topomap.id,
        "version": topomap.version,
        "num_nodes": len(topomap.summaries),
        "num_points": num_points,
    }
    return facts | {
        "num_points_shown": num_shown,
        "length_m": topomap.length_m,
        "sessions": sessions,
    }


@dataclass(frozen=True, eq=False)
class _NodeContent:
    """What is read of the nodes: of each its camera and picture, of all together the points with
    their colours."""

    cameras: list[Camera]
    jpegs: list[bytes]
    points_world: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


def _read_nodes(topomap: TopoMetricMap, max_points: int) -> _NodeContent:
    """Of the points that a node knows well as many as there is room for, coloured by its
    picture."""
    share = min(1.0, max_points / max(1, sum(summary.num_points for summary in topomap.summaries)))
    cameras, jpegs, points, colours = (
        list[Camera](),
        list[bytes](),
        [np.zeros((0, 3))],
        [np.zeros((0, 3))],
    )
    for node in topomap.nodes:
        sigmas = np.linalg.norm(node.point_sqrt_covs.astype(np.float64), axis=1)
        known = sigmas <= _MAX_POINT_SIGMA * np.linalg.norm(node.points_cam, axis=1)
        rows = np.flatnonzero(known & np.isfinite(node.points_cam).all(axis=1))
        chosen = rows[
            np.linspace(0, len(rows), int(share * len(rows)), endpoint=False).astype(np.int64)
        ]
        points.append(node.summary.world_from_cam.apply(node.points_cam[chosen].astype(np.float64)))
        colours.append(sample_colours(node, node.features.points_img[chosen].astype(np.float64)))
        cameras.append(node.camera)
        jpegs.append(node.template_jpeg)
    return _NodeContent(
        cameras, jpegs, np.concatenate(points), np.concatenate(colours).round().astype(np.uint8)
    )


def _find_up_axis(topomap: TopoMetricMap, poses: Sequence[Rigid3]) -> Float[np.ndarray, "3"]:
    """Up on earth where the map knows it; else what its cameras agree on, an axis of the world
    where that is one of them nearly."""
    if topomap.georeference is not None:
        return topomap.georeference.enu_from_world.rotation.T @ np.array([0.0, 0.0, 1.0])
    up = -np.mean([pose.rotation[:, 1] for pose in poses], axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.3:
        return np.array([0.0, 0.0, 1.0])
    up = up / length
    axis = np.zeros(3)
    axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
    return axis if axis @ up > np.cos(np.deg2rad(25.0)) else up


def _find_focus_box(
    centres: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """(low, high) corners of the box that a first view shows: all nodes, and the points but for the
    outermost."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    if len(points):
        low, high = (
            np.minimum(low, np.quantile(points, 0.03, axis=0)),
            np.maximum(high, np.quantile(points, 0.97, axis=0)),
        )
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


def _encode_images(jpegs: Sequence[bytes], max_bytes: int) -> list[str | None]:
    """The nodes' pictures as base64, all of one width: the largest by which they fit; of very many
    only every k-th."""
    room = max_bytes * 3 // 4
    if sum(map(len, jpegs)) <= room:
        return [_to_base64(np.frombuffer(jpeg, np.uint8)) if jpeg else None for jpeg in jpegs]
    tried = jpegs[:: max(1, len(jpegs) // 12)]
    sizes = {
        width: len(jpegs) * float(np.mean([len(_resize_jpeg(jpeg, width)) for jpeg in tried]))
        for width in _IMAGE_WIDTHS
    }
    width = next((width for width, size in sizes.items() if size <= room), _IMAGE_WIDTHS[-1])
    step = max(1, int(np.ceil(sizes[width] / room)))
    shrunk = (
        _resize_jpeg(jpeg, width) if row % step == 0 else b"" for row, jpeg in enumerate(jpegs)
    )
    return [_to_base64(np.frombuffer(jpeg, np.uint8)) if jpeg else None for jpeg in shrunk]


def _resize_jpeg(jpeg: bytes, width: int) -> bytes:
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    if picture is None:
        return b""
    scale = min(1.0, width / picture.shape[1])
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return encode_jpeg(
        cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB),
        _JPEG_QUALITY,
    )


def _mapped_paths(topomap: TopoMetricMap) -> Iterator[dict[str, Any]]:
    """The way of each session: through all its mapping pictures, or its nodes where the map keeps
    no others."""
    images_of: dict[int, list[Rigid3]] = {}
    for image in topomap.place_images:
        images_of.setdefault(image.session_id, []).append(image.world_from_cam)
    for session in topomap.sessions:
        images = images_of.get(session.session_id, [])
        nodes = [
            summary.world_from_cam
            for summary in topomap.summaries
            if summary.session_id == session.session_id
        ]
        poses = images if len(images) > len(nodes) else nodes
        if poses:
            yield path_to_json(session.name, [pose.translation for pose in poses]) | {
                "session": session.session_id
            }


def path_to_json(name: str, positions: Sequence[Float[np.ndarray, "3"]]) -> dict[str, Any]:
    """A path as lines, a new one wherever the next position is far off; of a long one every k-th
    position."""
    path = np.array(positions).reshape(-1, 3)[:: max(1, -(-len(positions) // MAX_PATH))]
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1 if len(steps) else []
    return {"name": name, "lines": [line.round(4).tolist() for line in np.split(path, gaps)]}


def results_to_json(results: ResultSet) -> dict[str, Any]:
    step = max(1, -(-len(results.answers) // MAX_RESULTS))
    return {
        "name": results.name,
        "num_answers": len(results.answers),
        "answers": [_round_values(dict(one)) for one in results.answers[::step]],
    }


def _round_values(value: Any) -> Any:
    """Numbers with as many digits as a picture shows."""
    if isinstance(value, float):
        return float(f"{value:.8g}") if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _round_values(one) for key, one in value.items()}
    return [_round_values(one) for one in value] if isinstance(value, list | tuple) else value


def _to_base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
