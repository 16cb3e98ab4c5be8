"""Tiles of an atlas that share a world as one scene, to be exported: each tile's own
(`map_scene.py`), moved to where it lies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from topoloc import Atlas, Rigid3, SharedWorld
from topoloc.apps.viewer.map_scene import create_map_scene
from topoloc.apps.viewer.scene import Points, Scene, View

Progress = Callable[[str, int, int], None]


def create_world_scene(
    atlas: Atlas,
    world: SharedWorld,
    name: str,
    with_points: bool = True,
    progress: Progress | None = None,
    warn: Callable[[str], None] = lambda text: None,
) -> Scene:
    """All tiles together. Pictures of several are called by their tile, too; sessions are numbered
    anew; points of tiles stay their own.

    Raises:
        AtlasError: none of the tiles can be read.
        ObjectStoreError: the store does not answer.
    """
    views, trajectory, points = list[View](), list[Rigid3](), list[Points]()
    first_session = 0
    for placed, topomap in world.open_tiles(atlas, warn):
        scene = create_map_scene(topomap, name, None, with_points, progress)
        numbers = {
            session.session_id: first_session + k for k, session in enumerate(topomap.sessions)
        }
        first_row, first_session = (
            sum(len(one.world) for one in points),
            first_session + len(numbers),
        )
        for view in scene.views:
            session_id = numbers.get(view.session_id, first_session)
            called = f"{placed.tile.tile_id}/{view.name}" if len(world.tiles) > 1 else view.name
            views.append(
                _transform_view(view, placed.world_from_map, called, session_id, first_row)
            )
        trajectory += [placed.world_from_map @ pose for pose in scene.trajectory]
        points.append(replace(scene.points, world=placed.world_from_map.apply(scene.points.world)))
    if world.georeference is not None:
        views = [
            replace(view, geopose=world.georeference.geopose(view.world_from_cam)) for view in views
        ]
    return Scene(name, views, _merge_points(points), trajectory, world.georeference)


def _transform_view(
    view: View, world_from_map: Rigid3, name: str, session_id: int, first_row: int
) -> View:
    rows = np.where(view.point_rows >= 0, view.point_rows + first_row, -1)
    return replace(
        view,
        name=name,
        world_from_cam=world_from_map @ view.world_from_cam,
        session_id=session_id,
        point_rows=rows,
    )


def _merge_points(points: Sequence[Points]) -> Points:
    world, rgb, errors = (
        [getattr(one, name) for one in points] for name in ("world", "rgb", "errors_px")
    )
    return Points(np.concatenate(world), np.concatenate(rgb), np.concatenate(errors))
