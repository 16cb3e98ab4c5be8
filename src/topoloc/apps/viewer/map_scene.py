"""A map, or the tiles of an atlas that share a world, as a scene.

The nodes are the views. Their points, merged to tracks, are the points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from topoloc import Atlas, MapError, Rigid3, SharedWorld, TopoMetricMap, TopoNode
from topoloc.apps.viewer.scene import Points, Progress, Scene, View
from topoloc.apps.viewer.tracks import Tracks, find_tracks


def create_map_scene(
    topomap: TopoMetricMap,
    name: str,
    session_id: int | None = None,
    with_points: bool = True,
    progress: Progress | None = None,
) -> Scene:
    """Return the scene of a map. Its trajectory contains all mapping images.

    Args:
        session_id: only the nodes of this session; default all.
        with_points: include the points, of the map's first feature type.

    Raises:
        MapError: the map cannot be read, or has no such session.
    """

    def is_shown(its_session_id: int) -> bool:
        return session_id is None or its_session_id == session_id

    rows = [row for row, s in enumerate(topomap.summaries) if is_shown(s.session_id)]
    if not rows:
        known = ", ".join(f"{session.session_id} ({session.name})" for session in topomap.sessions)
        raise MapError(f"the map has no session {session_id} with nodes; its sessions: {known}")
    names = unique_image_names(topomap)
    views = [_node_view(topomap, topomap.nodes[row], names[row]) for row in rows]
    points = Points.none()
    if with_points:
        tracks = find_tracks(topomap, rows, progress)
        nodes = [topomap.nodes[row] for row in rows]
        pixels = [node.features.points_img.astype(np.float64) for node in nodes]
        rows_of = np.split(tracks.point_rows, np.cumsum([len(one) for one in pixels])[:-1])
        views = [
            replace(view, points_img=its_pixels, point_rows=its_rows)
            for view, its_pixels, its_rows in zip(views, pixels, rows_of, strict=True)
        ]
        colours = [sample_colours(*pair) for pair in zip(nodes, pixels, strict=True)]
        points = _to_scene_points(tracks, np.concatenate(colours))
    trajectory = [
        image.world_from_cam for image in topomap.place_images if is_shown(image.session_id)
    ]
    return Scene(name, views, points, trajectory, topomap.georeference)


def _node_view(topomap: TopoMetricMap, node: TopoNode, name: str) -> View:
    s, georeference = node.summary, topomap.georeference
    picture = decode_jpeg(node.template_jpeg)
    return View(
        name,
        s.world_from_cam,
        s.t_ns,
        node.camera,
        s.session_id,
        jpeg=b"" if picture is None else node.template_jpeg,
        jpeg_camera=None if picture is None else node.camera.rescaled(*picture.shape[1::-1]),
        geopose=None if georeference is None else georeference.geopose(s.world_from_cam),
    )


def unique_image_names(topomap: TopoMetricMap) -> list[str]:
    """Return the image name of each node, with the session's number if names are not unique."""
    names = [summary.name for summary in topomap.summaries]
    if len(set(names)) == len(names):
        return names
    return [f"session{summary.session_id}/{summary.name}" for summary in topomap.summaries]


def _to_scene_points(tracks: Tracks, sampled_rgb: Float[np.ndarray, "m 3"]) -> Points:
    """Average colour and error of each point over the images that show it."""
    shown = tracks.point_rows >= 0
    rows, num_points = tracks.point_rows[shown], len(tracks.points_world)
    counts = np.maximum(np.bincount(rows, minlength=num_points), 1)
    rgb, errors = np.zeros((num_points, 3)), np.zeros(num_points)
    np.add.at(rgb, rows, sampled_rgb[shown])
    np.add.at(errors, rows, tracks.errors_px[shown])
    colours = np.rint(rgb / counts[:, None]).astype(np.uint8)
    return Points(tracks.points_world, colours, errors / counts)


def sample_colours(node: TopoNode, pixels: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    """Return the colours of the node's image at pixels of its camera, RGB, 0 to 255. They are black
    if the image cannot be decoded."""
    picture = decode_jpeg(node.template_jpeg)
    if picture is None or len(pixels) == 0:
        return np.zeros((len(pixels), 3))
    scale = np.array([picture.shape[1] / node.camera.width, picture.shape[0] / node.camera.height])
    places = ((pixels + 0.5) * scale - 0.5).astype(np.float32)
    x, y = places[:, None, 0], places[:, None, 1]
    sampled = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled[:, 0].astype(float)


def decode_jpeg(jpeg: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return a stored image, RGB; None if there is none or it is damaged."""
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    return None if picture is None else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


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
    different tiles are not merged.

    Raises:
        AtlasError: none of the tiles can be read.
        ObjectStoreError: the store does not answer.
    """
    views, trajectory, points = list[View](), list[Rigid3](), list[Points]()
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
        points.append(replace(scene.points, world=placed.world_from_map.apply(scene.points.world)))
        first_row += len(scene.points.world)
    if world.georeference is not None:
        views = [
            replace(view, geopose=world.georeference.geopose(view.world_from_cam)) for view in views
        ]
    return Scene(name, views, _merge_points(points), trajectory, world.georeference)


def _merge_points(points: Sequence[Points]) -> Points:
    names = ("world", "rgb", "errors_px")
    return Points(*(np.concatenate([getattr(one, name) for one in points]) for name in names))
