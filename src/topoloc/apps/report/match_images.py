"""A query beside the map node it belongs to, with lines between what was matched: why a pose was
found, or why not.

The localizer keeps no matches, so they are made once more here, with one node alone: by the guided
step of `localization/guided.py` where there is a pose, and by appearance where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from topoloc import Camera, EvaluatedQuery, Localization, MapError, TopoNode
from topoloc.apps.viewer.map_scene import decode_jpeg
from topoloc.plugin import Image, NodeMatcher

# Pictures are shown, and matched, no wider than this.
IMAGE_WIDTH_PX = 480
MAX_MATCHING_WIDTH_PX = 960
MAX_LINES = 45
MAX_REPROJECTION_ERROR_PX = 8.0
JPEG_QUALITY = 78
# A picture of another size than the one it is made from, or shown beside: names of its own for its
# sides.
ImageArray = UInt8[np.ndarray, "height width"] | UInt8[np.ndarray, "height width 3"]
_GAP_PX = 6
_INLIER_COLOUR, _OUTLIER_COLOUR, _BACKGROUND_COLOUR = (
    (38, 208, 180),
    (219, 72, 102),
    (17, 22, 29),
)  # RGB


@dataclass(frozen=True, eq=False)
class NodeMatches:
    """Row k: pixel in the query, pixel in the node's camera, and whether the pose found (or,
    without one, the truth) explains both."""

    points_query: Float[np.ndarray, "n 2"]
    points_node: Float[np.ndarray, "n 2"]
    is_inlier: Bool[np.ndarray, " n"]


def match_with_node(
    answer: EvaluatedQuery, image: Image, camera: Camera, matcher: NodeMatcher
) -> NodeMatches:
    """Matches of a query's picture (of `camera`) with one node.

    With a pose: those that it explains. Without: all that look alike, told apart by the truth;
    where there is none, all disagree.
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
        is_inlier = (
            np.linalg.norm(seen - points_query, axis=1)
            <= MAX_REPROJECTION_ERROR_PX * scaled.width / 640.0
        )  # NaN does not
    if isinstance(answer.result, Localization):
        points_query, points_node, is_inlier = (
            points_query[is_inlier],
            points_node[is_inlier],
            is_inlier[is_inlier],
        )
    return NodeMatches(points_query / scale, points_node, is_inlier)


def decode_template(node: TopoNode) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image of a node, RGB. Raises MapError if it is damaged."""
    image = decode_jpeg(node.template_jpeg)
    if image is None:
        raise MapError("the map is damaged: a mapping image is no picture")
    return image


def draw_pair(
    query: Image,
    template: ImageArray | None,
    matches: NodeMatches | None = None,
    node_camera: Camera | None = None,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The two pictures side by side, equally high, RGB; lines between matches, at most `MAX_LINES`
    of them.

    Args:
        template: the node's picture; without one the query stands alone.
        node_camera: what the node's pixels are pixels of, where the template is smaller.
    """
    left, left_scale = _resize_to_width(query, IMAGE_WIDTH_PX)
    if template is None:
        return left
    height = left.shape[0]
    width = max(1, round(template.shape[1] * height / template.shape[0]))
    shrinks = height < template.shape[0]
    right = cv2.resize(
        _to_rgb(template),
        (width, height),
        interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC,
    )
    canvas = np.empty((height, left.shape[1] + _GAP_PX + width, 3), np.uint8)
    canvas[:] = _BACKGROUND_COLOUR
    canvas[:, : left.shape[1]] = left
    canvas[:, left.shape[1] + _GAP_PX :] = right
    if matches is not None and node_camera is not None and len(matches.is_inlier):
        chosen = np.unique(
            np.linspace(0, len(matches.is_inlier) - 1, MAX_LINES).round().astype(int)
        )
        starts = left_scale * (matches.points_query[chosen] + 0.5) - 0.5
        to_right = np.array([width / node_camera.width, height / node_camera.height])
        ends = to_right * (matches.points_node[chosen] + 0.5) - 0.5 + [left.shape[1] + _GAP_PX, 0]
        _draw_lines(canvas, starts, ends, matches.is_inlier[chosen])
    return canvas


def _downscale(image: Image, camera: Camera) -> tuple[ImageArray, Camera, float]:
    """The picture and its camera no wider than `MAX_MATCHING_WIDTH_PX`, and the scale."""
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
    """Half-transparent lines, the disagreeing ones below; dots at both ends."""
    lines = canvas.copy()
    order = np.argsort(is_inlier, kind="stable")
    starts_px, ends_px = np.rint(starts).astype(int).tolist(), np.rint(ends).astype(int).tolist()
    pixels = [(starts_px[i], ends_px[i], bool(is_inlier[i])) for i in order]
    for start, end, is_right in pixels:
        cv2.line(lines, start, end, _INLIER_COLOUR if is_right else _OUTLIER_COLOUR, 1, cv2.LINE_AA)
    cv2.addWeighted(lines, 0.5, canvas, 0.5, 0.0, dst=canvas)
    for start, end, is_right in pixels:
        for point in (start, end):
            cv2.circle(
                canvas, point, 2, _INLIER_COLOUR if is_right else _OUTLIER_COLOUR, -1, cv2.LINE_AA
            )
