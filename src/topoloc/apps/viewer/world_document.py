"""Tiles of an atlas that share a world as one document of the viewer: each tile's own
(`document.py`), moved to where it lies."""

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
    path_to_json,
    results_to_json,
)

_POSE_KEYS = ("world_from_cam", "true_world_from_cam", "smoothed")
Document = dict[str, Any]


def create_world_document(
    atlas: Atlas,
    world: SharedWorld,
    name: str,
    results: Sequence[ResultSet] = (),
    budget: SceneBudget | None = None,
    warn: Callable[[str], None] = lambda text: None,
) -> Document:
    """As `create_document`, of all tiles of a world together. Nodes name their tile, sessions are
    numbered anew, points and pictures are shared out by nodes. Answers stand where their tile lies;
    those of tiles of other worlds are left out.

    Raises:
        AtlasError: none of the tiles can be read.
        ObjectStoreError: the store does not answer.
    """
    budget, parts, first_session = budget or SceneBudget(), list[Document](), 0
    for placed, topomap in world.open_tiles(atlas, warn):
        share = placed.tile.num_nodes / max(1, world.num_nodes)
        its_budget = SceneBudget(
            int(share * budget.max_points), int(share * budget.max_image_bytes)
        )
        part = _transform_document(
            create_document(topomap, placed.tile.tile_id, budget=its_budget),
            placed.world_from_map,
            first_session,
        )
        first_session = (
            max((session["id"] for session in part["map"]["sessions"]), default=first_session - 1)
            + 1
        )
        parts.append(part)
    paths = [
        path_to_json(one.name, [pose.translation for pose in one.path])
        for one in results
        if one.path
    ]
    shown = [
        replace(one, answers=transform_answers(world, one.answers))
        for one in results
        if one.answers
    ]
    joined = _merge_documents(parts, name)
    return joined | {
        "paths": joined["paths"] + paths,
        "results": [results_to_json(one) for one in shown],
    }


def transform_answers(
    world: SharedWorld, answers: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Answers of an atlas, as JSON, in the coordinates of a world that tiles share; those of other
    tiles are left out."""
    moved = list[dict[str, Any]]()
    for answer in answers:
        alternatives = list(answer.get("alternatives", []))
        named = answer.get("tile") or next((one.get("tile") for one in alternatives), None)
        pose = world.world_from_map_of(named)
        if pose is None:
            continue
        its = dict(answer) | {
            key: _transform_pose(pose, answer[key])
            for key in _POSE_KEYS
            if answer.get(key) is not None
        }
        if "covariance" in its:
            covariance = np.array(its["covariance"], np.float64)
            its["covariance"] = (pose.adjoint() @ covariance @ pose.adjoint().T).tolist()
        if alternatives:
            placed = [
                (one, world.world_from_map_of(one.get("tile") or named)) for one in alternatives
            ]
            its["alternatives"] = [
                one | {"world_from_cam": _transform_pose(there, one["world_from_cam"])}
                for one, there in placed
                if there is not None
            ]
        moved.append(its)
    return moved


def _transform_pose(world_from_map: Rigid3, pose: Any) -> dict[str, Any]:
    return (world_from_map @ Rigid3.from_json(pose)).to_json()


def _transform_document(document: Document, world_from_map: Rigid3, first_session: int) -> Document:
    """The document of one tile where that lies, its sessions counted on from others'."""
    tile_id = document["name"]
    points = np.frombuffer(base64.b64decode(document["points"]["world"]), "<f4").reshape(-1, 3)
    moved = world_from_map.apply(points.astype(np.float64)).astype("<f4")
    corners = np.array(np.meshgrid(*np.array(document["focus"]).T)).reshape(3, -1).T
    numbers = {
        session["id"]: first_session + k for k, session in enumerate(document["map"]["sessions"])
    }
    sessions = [
        one | {"id": numbers[one["id"]], "name": f"{tile_id}: {one['name']}"}
        for one in document["map"]["sessions"]
    ]
    nodes = [
        node
        | {"tile": tile_id, "session": numbers.get(node["session"], first_session)}
        | {"world_from_cam": _transform_pose(world_from_map, node["world_from_cam"])}
        for node in document["nodes"]
    ]
    return document | {
        "up": world_from_map.rotation @ np.array(document["up"]),
        "focus": world_from_map.apply(corners),
        "map": document["map"] | {"sessions": sessions},
        "points": {"world": moved, "rgb": base64.b64decode(document["points"]["rgb"])},
        "nodes": nodes,
        "paths": [
            _transform_path(path, world_from_map, tile_id, numbers) for path in document["paths"]
        ],
    }


def _transform_path(
    path: Document, world_from_map: Rigid3, tile_id: str, numbers: Mapping[int, int]
) -> Document:
    lines = [
        world_from_map.apply(np.array(line, np.float64).reshape(-1, 3)).round(4).tolist()
        for line in path["lines"]
    ]
    return {
        "name": f"{tile_id}: {path['name']}",
        "lines": lines,
        "session": numbers[path["session"]],
    }


def _merge_documents(parts: Sequence[Document], name: str) -> Document:
    """One document of several that lie in one world."""
    facts = [part["map"] for part in parts]
    sums = {
        key: sum(one[key] for one in facts)
        for key in ("num_nodes", "num_points", "num_points_shown", "length_m")
    }
    focus = np.concatenate([part["focus"] for part in parts])
    up = np.sum([part["map"]["num_nodes"] * part["up"] for part in parts], axis=0)
    world, rgb = (
        b"".join(bytes(part["points"][key]) for part in parts) for key in ("world", "rgb")
    )
    return parts[0] | {
        "name": name,
        "up": (up / max(float(np.linalg.norm(up)), 1e-9)).round(6).tolist(),
        "focus": [focus.min(axis=0).round(3).tolist(), focus.max(axis=0).round(3).tolist()],
        "map": sums
        | {
            "id": None,
            "version": None,
            "tiles": [part["name"] for part in parts],
            "sessions": [one for f in facts for one in f["sessions"]],
        },
        "points": {
            "world": base64.b64encode(world).decode("ascii"),
            "rgb": base64.b64encode(rgb).decode("ascii"),
        },
        "nodes": [node for part in parts for node in part["nodes"]],
        "paths": [path for part in parts for path in part["paths"]],
        "results": [],
    }
