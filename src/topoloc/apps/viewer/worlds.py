"""Tiles of an atlas that share a world as one scene, or as one document: those of the tiles,
transformed."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from topoloc import Atlas, Rigid3, SharedWorld
from topoloc.apps.viewer.document import (
    ResultSet,
    SceneBudget,
    create_document,
    result_paths,
    results_to_json,
    to_base64,
)
from topoloc.apps.viewer.map_scene import create_map_scene
from topoloc.apps.viewer.scene import Points, Progress, Scene, View

_POSE_KEYS = ("world_from_cam", "true_world_from_cam", "smoothed")
Document = dict[str, Any]


def create_world_scene(
    atlas: Atlas,
    world: SharedWorld,
    name: str,
    with_points: bool = True,
    progress: Progress | None = None,
    warn: Callable[[str], None] = lambda text: None,
) -> Scene:
    """Return the scene of all tiles of a world.

    With several tiles, image names begin with the tile. Sessions are numbered again. Points of
    different tiles are not merged. Raises AtlasError: none of the tiles can be read;
    ObjectStoreError: the store does not answer.
    """
    views, trajectory, points = list[View](), list[Rigid3](), list[Points]()
    junctions = list[Mapping[str, Any]]()
    first_session = first_row = 0
    for placed, topomap in world.open_tiles(atlas, warn):
        scene = create_map_scene(topomap, name, None, with_points, progress)
        ids = [session.session_id for session in topomap.sessions]
        numbers = {session_id: first_session + k for k, session_id in enumerate(ids)}
        first_session += len(numbers)
        prefix = f"{placed.tile.tile_id}/" if len(world.tiles) > 1 else ""
        views += [
            replace(
                view,
                name=prefix + view.name,
                world_from_cam=placed.world_from_map @ view.world_from_cam,
                session_id=numbers.get(view.session_id, first_session),
                point_rows=np.where(view.point_rows >= 0, view.point_rows + first_row, -1),
            )
            for view in scene.views
        ]
        trajectory += [placed.world_from_map @ pose for pose in scene.trajectory]
        junctions += [
            _place_junction(one, placed.tile.tile_id, placed.world_from_map)
            for one in scene.junctions
        ]
        points.append(replace(scene.points, world=placed.world_from_map.apply(scene.points.world)))
        first_row += len(scene.points.world)
    if world.georeference is not None:
        views = [
            replace(view, geopose=world.georeference.geopose(view.world_from_cam)) for view in views
        ]
    merged = _merge_points(points)
    return Scene(name, views, merged, trajectory, world.georeference, junctions)


def _place_junction(one: Mapping[str, Any], tile_id: str, world_from_map: Rigid3) -> Document:
    position = world_from_map.apply(np.array(one["position"])).round(4).tolist()
    return dict(one) | {"tile": tile_id, "position": position}


def _merge_points(points: Sequence[Points]) -> Points:
    names = ("world", "rgb", "errors_px")
    return Points(*(np.concatenate([getattr(one, name) for one in points]) for name in names))


def create_world_document(
    atlas: Atlas,
    world: SharedWorld,
    name: str,
    results: Sequence[ResultSet] = (),
    budget: SceneBudget | None = None,
    warn: Callable[[str], None] = lambda text: None,
) -> Document:
    """Return the document of all tiles of a world, as `create_document` for one map.

    Nodes name their tile, and sessions are numbered again. Each tile has a share of the budget by
    its number of nodes. Results are transformed; those of other worlds are left out. Raises
    AtlasError: none of the tiles can be read; ObjectStoreError: the store does not answer.
    """
    budget, parts, first_session = budget or SceneBudget(), list[Document](), 0
    for placed, topomap in world.open_tiles(atlas, warn):
        share = placed.tile.num_nodes / max(1, world.num_nodes)
        its_budget = SceneBudget(
            int(share * budget.max_points), int(share * budget.max_image_bytes)
        )
        part = create_document(topomap, placed.tile.tile_id, budget=its_budget)
        parts.append(_transform_document(part, placed.world_from_map, first_session))
        first_session += len(part["map"]["sessions"])
    shown = [
        replace(one, answers=transform_answers(world, one.answers))
        for one in results
        if one.answers
    ]
    document = _merge_documents(parts, name)
    document["paths"] += result_paths(results)
    return document | {"results": [results_to_json(one) for one in shown]}


def transform_answers(
    world: SharedWorld, answers: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return JSON results of tiles in the coordinates of a shared world, without those of other
    tiles."""
    transformed = list[dict[str, Any]]()
    for answer in answers:
        alternatives = list(answer.get("alternatives", []))
        tile_id = answer.get("tile") or next((one.get("tile") for one in alternatives), None)
        pose = world.world_from_map_of(tile_id)
        if pose is None:
            continue
        moved = dict(answer) | {
            key: _transform_pose(pose, answer[key])
            for key in _POSE_KEYS
            if answer.get(key) is not None
        }
        if "covariance" in moved:
            moved["covariance"] = _transform_covariance(pose, moved["covariance"])
        if alternatives:
            placed = [
                (one, world.world_from_map_of(one.get("tile") or tile_id)) for one in alternatives
            ]
            moved["alternatives"] = [
                _transform_alternative(there, one) for one, there in placed if there is not None
            ]
        transformed.append(moved)
    return transformed


def _transform_alternative(world_from_map: Rigid3, one: Mapping[str, Any]) -> dict[str, Any]:
    moved = dict(one) | {"world_from_cam": _transform_pose(world_from_map, one["world_from_cam"])}
    if "covariance" in moved:
        moved["covariance"] = _transform_covariance(world_from_map, moved["covariance"])
    return moved


def _transform_covariance(world_from_map: Rigid3, covariance: Any) -> Any:
    return world_from_map.transform_covariance(np.array(covariance, np.float64)).tolist()


def _transform_pose(world_from_map: Rigid3, pose: Any) -> dict[str, Any]:
    return (world_from_map @ Rigid3.from_json(pose)).to_json()


def _transform_document(document: Document, world_from_map: Rigid3, first_session: int) -> Document:
    """Transform the document of a tile. Points, focus and up become arrays."""
    tile_id, sessions = document["name"], document["map"]["sessions"]
    points = np.frombuffer(base64.b64decode(document["points"]["world"]), "<f4").reshape(-1, 3)
    corners = np.array(np.meshgrid(*np.array(document["focus"]).T)).reshape(3, -1).T
    numbers = {session["id"]: first_session + k for k, session in enumerate(sessions)}

    def transform_path(path: Document) -> Document:
        lines = [np.array(line, np.float64).reshape(-1, 3) for line in path["lines"]]
        return {
            "name": f"{tile_id}: {path['name']}",
            "lines": [world_from_map.apply(line).round(4).tolist() for line in lines],
            "session": numbers[path["session"]],
        }

    return document | {
        "up": world_from_map.rotation @ np.array(document["up"]),
        "focus": world_from_map.apply(corners),
        "map": document["map"]
        | {
            "sessions": [
                one | {"id": numbers[one["id"]], "name": f"{tile_id}: {one['name']}"}
                for one in sessions
            ]
        },
        "points": {
            "world": world_from_map.apply(points.astype(np.float64)).astype("<f4"),
            "rgb": base64.b64decode(document["points"]["rgb"]),
        },
        "nodes": [
            node
            | {
                "tile": tile_id,
                "session": numbers.get(node["session"], first_session),
                "world_from_cam": _transform_pose(world_from_map, node["world_from_cam"]),
            }
            for node in document["nodes"]
        ],
        "junctions": [
            _place_junction(one, tile_id, world_from_map) for one in document["junctions"]
        ],
        "paths": [transform_path(path) for path in document["paths"]],
    }


def _merge_documents(parts: Sequence[Document], name: str) -> Document:
    """Merge documents in the same world."""
    facts = [part["map"] for part in parts]
    keys = ("num_nodes", "num_points", "num_points_shown", "length_m")
    focus = np.concatenate([part["focus"] for part in parts])
    up = np.sum([part["map"]["num_nodes"] * part["up"] for part in parts], axis=0)
    return parts[0] | {
        "name": name,
        "up": (up / max(float(np.linalg.norm(up)), 1e-9)).round(6).tolist(),
        "focus": [focus.min(axis=0).round(3).tolist(), focus.max(axis=0).round(3).tolist()],
        "map": {key: sum(one[key] for one in facts) for key in keys}
        | {
            "id": None,
            "version": None,
            "tiles": [part["name"] for part in parts],
            "sessions": [session for one in facts for session in one["sessions"]],
        },
        "points": {
            key: to_base64(b"".join(bytes(part["points"][key]) for part in parts))
            for key in ("world", "rgb")
        },
        "nodes": [node for part in parts for node in part["nodes"]],
        "junctions": [one for part in parts for one in part["junctions"]],
        "paths": [path for part in parts for path in part["paths"]],
        "results": [],
    }
