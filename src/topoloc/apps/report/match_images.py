"""A query beside its map node, with lines between matches.

The localizer keeps no matches, so they are computed again with one node: by guided matching if
there is a pose, else by appearance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from topoloc import Camera, EvaluatedQuery, Image, Localization, MapError, TopoNode
from topoloc.apps.core_names import NodeMatcher
from topoloc.apps.viewer.map_scene import read_node_rgb

# Images are shown and matched at these widths or less.
IMAGE_WIDTH_PX = 480
MAX_MATCHING_WIDTH_PX = 960
MAX_LINES = 45
MAX_REPROJECTION_ERROR_PX = 8.0
JPEG_QUALITY = 78
# An image with dimensions of its own, independent of `Image` in the same signature.
ImageArray = UInt8[np.ndarray, "height width"] | UInt8[np.ndarray, "height width 3"]
_GAP_PX = 6
# RGB
_INLIER_COLOUR, _OUTLIER_COLOUR, _BACKGROUND_COLOUR = (38, 208, 180), (219, 72, 102), (17, 22, 29)


@dataclass(frozen=True, eq=False)
class NodeMatches:
    """Row k: pixel in the query, pixel in the node's camera, and whether both agree with the pose
    (without a pose, with the truth)."""

    points_query: Float[np.ndarray, "n 2"]
    points_node: Float[np.ndarray, "n 2"]
    is_inlier: Bool[np.ndarray, " n"]


def match_with_node(
    answer: EvaluatedQuery, image: Image, camera: Camera, matcher: NodeMatcher
) -> NodeMatches:
    """Return the matches of a query with one node.

    With a pose: its inliers. Without a pose: all matches by appearance, of which those that agree
    with the truth are inliers.
    """
    image, scaled, scale = _downscale(image, camera)
    query = matcher.extract_features(image)
    if isinstance(answer.result, Localization):
        cam_from_world = answer.result.world_from_cam.inverse()
        matches = matcher.match_at_pose(query, cam_from_world, scaled)
    else:
        cam_from_world = None if answer.world_from_cam is None else answer.world_from_cam.inverse()
        matches = matcher.match(query)
    points_query = query.points_img[matches.query_idx].astype(np.float64)
    points_node = matcher.node.features.points_img[matches.train_idx].astype(np.float64)
    is_inlier = np.zeros(len(points_query), dtype=bool)
    if cam_from_world is not None and len(is_inlier):
        seen = scaled.img_from_cam(cam_from_world.apply(matcher.points_world[matches.train_idx]))
        limit = MAX_REPROJECTION_ERROR_PX * scaled.width / 640.0
        is_inlier = np.linalg.norm(seen - points_query, axis=1) <= limit  # False for NaN
    is_shown = is_inlier if answer.result.localized else slice(None)
    points_query, points_node = points_query[is_shown] / scale, points_node[is_shown]
    return NodeMatches(points_query, points_node, is_inlier[is_shown])


def read_template(node: TopoNode) -> tuple[UInt8[np.ndarray, "h w 3"] | None, str]:
    """Return the image of a node, RGB, and the words for it in a caption, which name damage."""
    try:
        return read_node_rgb(node), f"right node {node.summary.node_id}"
    except MapError as error:
        return None, str(error)


def draw_pair(
    query: Image,
    template: ImageArray | None,
    matches: NodeMatches | None = None,
    node_camera: Camera | None = None,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return both images side by side at one height, RGB, with at most `MAX_LINES` matches.

    Args:
        template: image of the node; without it only the query is drawn.
        node_camera: camera of the node's pixels, as the template may be smaller.
    """
    left, left_scale = _resize_to_width(query, IMAGE_WIDTH_PX)
    if template is None:
        return left
    height = left.shape[0]
    width = max(1, round(template.shape[1] * height / template.shape[0]))
    method = cv2.INTER_AREA if height < template.shape[0] else cv2.INTER_CUBIC
    right = cv2.resize(_to_rgb(template), (width, height), interpolation=method)
    gap = np.full((height, _GAP_PX, 3), _BACKGROUND_COLOUR, np.uint8)
    canvas = np.hstack([left, gap, right])
    if matches is not None and node_camera is not None and len(matches.is_inlier):
        rows = np.linspace(0, len(matches.is_inlier) - 1, MAX_LINES)
        chosen = np.unique(rows.round().astype(int))
        starts = left_scale * (matches.points_query[chosen] + 0.5) - 0.5
        to_right = np.array([width / node_camera.width, height / node_camera.height])
        ends = to_right * (matches.points_node[chosen] + 0.5) - 0.5 + [left.shape[1] + _GAP_PX, 0]
        _draw_lines(canvas, starts, ends, matches.is_inlier[chosen])
    return canvas


def _downscale(image: Image, camera: Camera) -> tuple[ImageArray, Camera, float]:
    """Return the image and its camera at `MAX_MATCHING_WIDTH_PX` or less, and the scale."""
    height, width = image.shape[:2]
    scale = min(1.0, MAX_MATCHING_WIDTH_PX / width)
    if scale == 1.0:
        return image, camera, 1.0
    size = (round(width * scale), max(1, round(height * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA), camera.rescaled(*size), scale


def _resize_to_width(image: Image, width: int) -> tuple[UInt8[np.ndarray, "rows columns 3"], float]:
    scale = min(1.0, width / image.shape[1])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return cv2.resize(_to_rgb(image), size, interpolation=cv2.INTER_AREA), scale


def _to_rgb(image: Image) -> UInt8[np.ndarray, "h w 3"]:
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image


def _draw_lines(
    canvas: UInt8[np.ndarray, "h w 3"],
    starts: Float[np.ndarray, "n 2"],
    ends: Float[np.ndarray, "n 2"],
    is_inlier: Bool[np.ndarray, " n"],
) -> None:
    """Draw half-transparent lines, outliers first, and dots at both ends."""
    lines, order = canvas.copy(), np.argsort(is_inlier, kind="stable")
    starts_px, ends_px = np.rint(starts).astype(int).tolist(), np.rint(ends).astype(int).tolist()
    colours = {True: _INLIER_COLOUR, False: _OUTLIER_COLOUR}
    pixels = [(starts_px[i], ends_px[i], colours[bool(is_inlier[i])]) for i in order]
    for start, end, colour in pixels:
        cv2.line(lines, start, end, colour, 1, cv2.LINE_AA)
    cv2.addWeighted(lines, 0.5, canvas, 0.5, 0.0, dst=canvas)
    for start, end, colour in pixels:
        for point in (start, end):
            cv2.circle(canvas, point, 2, colour, -1, cv2.LINE_AA)
