"""A map as a scene: its nodes are the views, their points, joined to tracks, the points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from topoloc import MapError, TopoMetricMap, TopoNode
from topoloc.apps.viewer.scene import Points, Scene, View
from topoloc.apps.viewer.tracks import Tracks, find_tracks


def create_map_scene(
    topomap: TopoMetricMap,
    name: str,
    session_id: int | None = None,
    with_points: bool = True,
    progress: Callable[[str, int, int], None] | None = None,
) -> Scene:
    """The nodes of all sessions, or of one; their points, where they are wanted, by the map's first
    kind of features.

    The trajectory is that of all mapping pictures.

    Raises:
        MapError: the map cannot be read, or has no such session.
    """
    rows = [
        row
        for row, s in enumerate(topomap.summaries)
        if session_id is None or s.session_id == session_id
    ]
    if not rows:
        known = ", ".join(f"{session.session_id} ({session.name})" for session in topomap.sessions)
        raise MapError(f"the map has no session {session_id} with nodes; its sessions: {known}")
    names = unique_image_names(topomap)
    tracks = find_tracks(topomap, rows, progress) if with_points else None
    views, sampled_rgb, start = list[View](), list[np.ndarray](), 0
    for row in rows:
        node = topomap.nodes[row]
        view = _node_view(topomap, node, names[row])
        if tracks is not None:
            pixels = node.features.points_img.astype(np.float64)
            point_rows = tracks.point_rows[start : start + len(pixels)]
            view, start = (
                replace(view, points_img=pixels, point_rows=point_rows),
                start + len(pixels),
            )
            sampled_rgb.append(sample_colours(node, pixels))
        views.append(view)
    posed = [
        image
        for image in topomap.place_images
        if session_id is None or image.session_id == session_id
    ]
    points = (
        Points.none() if tracks is None else _to_scene_points(tracks, np.concatenate(sampled_rgb))
    )
    return Scene(
        name, views, points, [image.world_from_cam for image in posed], topomap.georeference
    )


def _node_view(topomap: TopoMetricMap, node: TopoNode, name: str) -> View:
    s, georeference = node.summary, topomap.georeference
    geopose = None if georeference is None else georeference.geopose(s.world_from_cam)
    picture = decode_jpeg(node.template_jpeg)
    jpeg_camera = (
        None if picture is None else node.camera.rescaled(picture.shape[1], picture.shape[0])
    )
    jpeg = node.template_jpeg if picture is not None else b""
    return View(
        name,
        s.world_from_cam,
        s.t_ns,
        node.camera,
        s.session_id,
        jpeg=jpeg,
        jpeg_camera=jpeg_camera,
        geopose=geopose,
    )


def unique_image_names(topomap: TopoMetricMap) -> list[str]:
    """Each node's picture; where several sessions call pictures alike, with the session's number
    before it."""
    names = [summary.name for summary in topomap.summaries]
    if len(set(names)) == len(names):
        return names
    return [f"session{summary.session_id}/{summary.name}" for summary in topomap.summaries]


def _to_scene_points(tracks: Tracks, sampled_rgb: Float[np.ndarray, "m 3"]) -> Points:
    """Colour and error of a point are the means over the pictures that show it."""
    shown = tracks.point_rows >= 0
    rows, num_points = tracks.point_rows[shown], len(tracks.points_world)
    counts = np.maximum(np.bincount(rows, minlength=num_points), 1)
    rgb, errors = np.zeros((num_points, 3)), np.zeros(num_points)
    np.add.at(rgb, rows, sampled_rgb[shown])
    np.add.at(errors, rows, tracks.errors_px[shown])
    return Points(
        tracks.points_world, np.rint(rgb / counts[:, None]).astype(np.uint8), errors / counts
    )


def sample_colours(node: TopoNode, pixels: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    """What the node's picture shows at pixels of its camera, RGB, 0 to 255; black where it cannot
    be read."""
    picture = decode_jpeg(node.template_jpeg)
    if picture is None or len(pixels) == 0:
        return np.zeros((len(pixels), 3))
    scale = np.array([picture.shape[1] / node.camera.width, picture.shape[0] / node.camera.height])
    places = ((pixels + 0.5) * scale - 0.5).astype(np.float32)
    return cv2.remap(
        picture,
        places[:, None, 0],
        places[:, None, 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )[:, 0].astype(float)


def decode_jpeg(jpeg: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return a stored image, RGB; None if there is none or it is damaged."""
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    return None if picture is None else cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
