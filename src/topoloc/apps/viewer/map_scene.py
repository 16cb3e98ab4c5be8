"""A map as a scene. The nodes are the views. Their points, merged to tracks, are the points.

Every node has its own points. Guided matching (`localization/guided.py`) finds those of a node in
the images of its neighbours. Matched points are merged, the most similar first. A track has at most
one key point in each image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from topoloc import MapError, TopoMetricMap, TopoNode
from topoloc.apps.core_names import NodeMatcher
from topoloc.apps.viewer.scene import Points, Progress, Scene, View

NUM_NEIGHBOURS = 8
MAX_ERROR_PX = 3.0
"""Maximum distance of a key point from the projection, for an image with a longer side of 640."""
_NUM_STEPS = 5
_MIN_SIGMA = 1e-4  # metres; no map is more precise


@dataclass(frozen=True, eq=False)
class KeyPointTable:
    """Point k lies at `points_world[k]` (metres).

    Key point i of all nodes, in their order, shows the point `point_rows[i]`, -1 if it agrees with
    none. `errors_px[i]` is its distance from the projection (NaN behind the camera).
    """

    points_world: Float[np.ndarray, "n 3"]
    point_rows: Int[np.ndarray, " m"]
    errors_px: Float[np.ndarray, " m"]


def find_tracks(
    topomap: TopoMetricMap, rows: list[int], progress: Progress | None = None
) -> KeyPointTable:
    """Find the tracks through these nodes. Raises MapError if a node cannot be read."""
    nodes = [topomap.nodes[row] for row in rows]
    counts = [len(node.points_cam) for node in nodes]
    starts = np.cumsum([0, *counts])
    matchers = [NodeMatcher(node, topomap.config.features) for node in nodes]
    pairs = [np.zeros((0, 3))]
    neighbours = topomap.find_neighbours(
        [node.summary.world_from_cam for node in nodes], NUM_NEIGHBOURS
    )
    for a, matcher in enumerate(matchers):
        for b in neighbours[a]:
            cam_from_world = nodes[b].summary.world_from_cam.inverse()
            found = matcher.match_at_pose(
                nodes[b].features, cam_from_world, nodes[b].camera, MAX_ERROR_PX
            )
            pairs.append(
                np.column_stack(
                    [starts[a] + found.train_idx, starts[b] + found.query_idx, found.distances]
                )
            )
        if progress:
            progress("tracks", a + 1, len(nodes))
    labels = _merge_points(np.concatenate(pairs), np.repeat(np.arange(len(nodes)), counts))
    return _triangulate_tracks(labels, matchers)


def _merge_points(
    pairs: Float[np.ndarray, "p 3"], of_node: Int[np.ndarray, " m"]
) -> Int[np.ndarray, " m"]:
    """Return a label for each point; merged points have the same one. A row of `pairs` holds two
    points and their distance in appearance."""
    parents, seen_by = list(range(len(of_node))), [{int(node)} for node in of_node]

    def root(i: int) -> int:
        while parents[i] != i:
            parents[i] = parents[parents[i]]
            i = parents[i]
        return i

    for one, other in pairs[np.argsort(pairs[:, 2], kind="stable"), :2].astype(np.int64).tolist():
        low, high = sorted((root(one), root(other)))
        if low != high and seen_by[low].isdisjoint(seen_by[high]):
            parents[high] = low
            seen_by[low] |= seen_by[high]
    roots = [root(i) for i in range(len(parents))]
    return np.unique(roots, return_inverse=True)[1].astype(np.int64)


@dataclass(frozen=True, eq=False)
class _KeyPoints:
    """All key points of the nodes. Key point i shows the point `labels[i]`, at `normalized[i]` on
    the plane z = 1 of its camera."""

    labels: Int[np.ndarray, " m"]
    normalized: Float[np.ndarray, "m 2"]
    focals: Float[np.ndarray, " m"]
    max_errors_px: Float[np.ndarray, " m"]
    rotations: Float[np.ndarray, "m 3 3"]
    translations: Float[np.ndarray, "m 3"]

    @staticmethod
    def from_nodes(nodes: list[TopoNode], labels: Int[np.ndarray, " m"]) -> _KeyPoints:
        counts = [len(node.points_cam) for node in nodes]
        poses = [node.summary.world_from_cam.inverse() for node in nodes]
        sides = np.array([max(node.camera.width, node.camera.height) for node in nodes], np.float64)
        seen = [
            node.camera.normalized_from_img(node.features.points_img.astype(np.float64))
            for node in nodes
        ]
        return _KeyPoints(
            labels,
            np.concatenate(seen),
            np.repeat([node.camera.fx for node in nodes], counts),
            np.repeat(MAX_ERROR_PX * np.maximum(sides / 640.0, 0.5), counts),
            np.repeat(np.array([pose.rotation for pose in poses]), counts, axis=0),
            np.repeat(np.array([pose.translation for pose in poses]), counts, axis=0),
        )

    def residuals(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 3"]]:
        """Return the distances from the projections, in pixels of an undistorted image, and the
        points in the cameras."""
        points_cam = (
            np.einsum("mij,mj->mi", self.rotations, points[self.labels]) + self.translations
        )
        z = np.where(points_cam[:, 2] > 1e-3, points_cam[:, 2], np.nan)
        return (points_cam[:, :2] / z[:, None] - self.normalized) * self.focals[:, None], points_cam


def _triangulate_tracks(
    labels: Int[np.ndarray, " m"], matchers: list[NodeMatcher]
) -> KeyPointTable:
    """Fit the point of each track to its nodes' points, by their covariances, and to its key
    points."""
    nodes = [matcher.node for matcher in matchers]
    num_points, key_points = int(labels.max(initial=-1)) + 1, _KeyPoints.from_nodes(nodes, labels)
    prior, pull = np.zeros((num_points, 3, 3)), np.zeros((num_points, 3))
    covariances = np.concatenate([part.covariances for part in matchers])
    points_world = np.concatenate([part.points_world for part in matchers])
    information = np.linalg.inv(covariances + _MIN_SIGMA**2 * np.eye(3))
    np.add.at(prior, labels, information)
    np.add.at(pull, labels, np.einsum("mij,mj->mi", information, points_world))
    points = first = np.linalg.solve(prior, pull[:, :, None])[:, :, 0]
    for _ in range(_NUM_STEPS):
        points = points + _gauss_newton_step(points, first, prior, key_points)
    errors = np.linalg.norm(key_points.residuals(points)[0], axis=1)
    kept = errors <= key_points.max_errors_px  # False for NaN
    of_kept, places = np.unique(labels[kept], return_inverse=True)
    point_rows = np.full(len(labels), -1, np.int64)
    point_rows[kept] = places
    return KeyPointTable(points[of_kept], point_rows, errors)


def _gauss_newton_step(
    points: Float[np.ndarray, "n 3"],
    first: Float[np.ndarray, "n 3"],
    prior: Float[np.ndarray, "n 3 3"],
    key_points: _KeyPoints,
) -> Float[np.ndarray, "n 3"]:
    """Return one Gauss-Newton step of each point, with a Huber loss of one pixel."""
    residuals, points_cam = key_points.residuals(points)
    used = np.isfinite(residuals[:, 0])
    labels, residuals, points_cam = key_points.labels[used], residuals[used], points_cam[used]
    by_cam, by_depth = np.zeros((len(labels), 2, 3)), key_points.focals[used] / points_cam[:, 2]
    by_cam[:, 0, 0] = by_cam[:, 1, 1] = by_depth
    by_cam[:, :, 2] = -by_depth[:, None] * points_cam[:, :2] / points_cam[:, 2:]
    jacobians = by_cam @ key_points.rotations[used]
    weighted = (
        jacobians.transpose(0, 2, 1)
        / np.maximum(np.linalg.norm(residuals, axis=1), 1.0)[:, None, None]
    )
    information, gradient = prior.copy(), np.einsum("nij,nj->ni", prior, points - first)
    np.add.at(information, labels, weighted @ jacobians)
    np.add.at(gradient, labels, np.einsum("mij,mj->mi", weighted, residuals))
    return -np.linalg.solve(information, gradient[:, :, None])[:, :, 0]


def create_map_scene(
    topomap: TopoMetricMap,
    name: str,
    session_id: int | None = None,
    with_points: bool = True,
    progress: Progress | None = None,
) -> Scene:
    """Return the scene of a map. Its trajectory contains all mapping images. Raises MapError: the
    map cannot be read, or has no such session.

    Args:
        session_id: only the nodes of this session; default all.
        with_points: include the points, of the map's first feature type.
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
        colours = [sample_node_colours(*pair) for pair in zip(nodes, pixels, strict=True)]
        points = _to_scene_points(tracks, np.concatenate(colours))
    trajectory = [
        image.world_from_cam for image in topomap.place_images if is_shown(image.session_id)
    ]
    junctions = topomap.junctions if session_id is None else ()
    return Scene(name, views, points, trajectory, topomap.georeference, junctions)


def _node_view(topomap: TopoMetricMap, node: TopoNode, name: str) -> View:
    s, georeference = node.summary, topomap.georeference
    picture = read_node_rgb(node)
    return View(
        name,
        s.world_from_cam,
        s.t_ns,
        node.camera,
        s.session_id,
        image=node.template_image,
        image_camera=None if picture is None else node.camera.rescaled(*picture.shape[1::-1]),
        geopose=None if georeference is None else georeference.geopose(s.world_from_cam),
    )


def unique_image_names(topomap: TopoMetricMap) -> list[str]:
    """Return the image name of each node, with the session's number if names are not unique."""
    names = [summary.name for summary in topomap.summaries]
    if len(set(names)) == len(names):
        return names
    return [f"session{summary.session_id}/{summary.name}" for summary in topomap.summaries]


def _to_scene_points(tracks: KeyPointTable, sampled_rgb: Float[np.ndarray, "m 3"]) -> Points:
    """Average colour and error of each point over the images that show it."""
    shown = tracks.point_rows >= 0
    rows, num_points = tracks.point_rows[shown], len(tracks.points_world)
    counts = np.maximum(np.bincount(rows, minlength=num_points), 1)
    rgb, errors = np.zeros((num_points, 3)), np.zeros(num_points)
    np.add.at(rgb, rows, sampled_rgb[shown])
    np.add.at(errors, rows, tracks.errors_px[shown])
    colours = np.rint(rgb / counts[:, None]).astype(np.uint8)
    return Points(tracks.points_world, colours, errors / counts)


def sample_node_colours(
    node: TopoNode, pixels: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "m 3"]:
    """Return the colours of the node's image at pixels of its camera, RGB, 0 to 255. They are black
    without an image. Raises MapError: the image is damaged."""
    picture = read_node_rgb(node)
    if picture is None or len(pixels) == 0:
        return np.zeros((len(pixels), 3))
    scale = np.array([picture.shape[1] / node.camera.width, picture.shape[0] / node.camera.height])
    places = ((pixels + 0.5) * scale - 0.5).astype(np.float32)
    x, y = places[:, None, 0], places[:, None, 1]
    sampled = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled[:, 0].astype(float)


def read_node_rgb(node: TopoNode) -> UInt8[np.ndarray, "h w 3"] | None:
    """Return the image of a node, RGB; None if there is none. Raises MapError: it is damaged."""
    image = node.read_image()
    if image is None or image.ndim == 3:
        return image
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
