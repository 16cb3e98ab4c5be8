"""The part of a report that shows single queries: the worst, and a typical one of each recording,
each beside its node."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

import numpy as np

from topoloc import (
    EvaluatedQuery,
    Image,
    Localization,
    NotLocalized,
    TopoMetricMap,
    TopoNode,
    UnreadableImageError,
)
from topoloc.apps.report.match_images import (
    JPEG_QUALITY,
    NodeMatches,
    decode_template,
    draw_pair,
    match_with_node,
)
from topoloc.plugin import NodeMatcher, encode_jpeg, format_length, group_by_recording

NUM_WORST = 6


def select_worst_queries(
    answers: Sequence[EvaluatedQuery], count: int = NUM_WORST
) -> list[EvaluatedQuery]:
    """False accepts first, then queries without a pose that should have one, then the largest
    errors.

    Where there are several recordings each gets its share of the places, so that a hard one does
    not hide the others.
    """
    groups = group_by_recording(
        [a for a in answers if a.world_from_cam is not None or a.is_false_accept]
    )
    share = max(count // max(len(groups), 1), 1)
    ranked = [
        (rank, answer)
        for group in groups.values()
        for rank, answer in enumerate(sorted(group, key=_error_rank, reverse=True))
    ]
    ranked.sort(key=lambda entry: (entry[0] < share, _error_rank(entry[1])), reverse=True)
    return sorted((answer for _, answer in ranked[:count]), key=_error_rank, reverse=True)


def select_typical_queries(answers: Sequence[EvaluatedQuery]) -> list[EvaluatedQuery]:
    """Of each recording the query with the median error; the middle one where none was
    localized."""
    typical = []
    for group in group_by_recording(answers).values():
        localized = sorted(
            (a for a in group if np.isfinite(a.translation_m)), key=lambda a: a.translation_m
        )
        chosen = localized or group
        typical.append(chosen[(len(chosen) - 1) // 2])
    return typical


def render_gallery(answers: Sequence[EvaluatedQuery], topomap: TopoMetricMap) -> str:
    """HTML of these queries, each with its picture, its node's, the matches between them, and what
    came of it."""
    return (
        '<div class="queries">'
        + "".join(_render_query(answer, topomap) for answer in answers)
        + "</div>"
    )


def _error_rank(answer: EvaluatedQuery) -> tuple[int, float]:
    if answer.world_from_cam is None:
        return 2 * answer.is_false_accept, 0.0
    if isinstance(answer.result, NotLocalized):
        return 1, 0.0
    return 2 * answer.is_false_accept, max(
        answer.translation_m / answer.MAX_TRANSLATION,
        answer.rotation_deg / answer.MAX_ROTATION_DEG,
    )


def _render_query(answer: EvaluatedQuery, topomap: TopoMetricMap) -> str:
    result = answer.result
    node = _select_node(answer, topomap)
    evidence = f"{result.num_inliers} inliers of {result.num_matches} matches"
    if isinstance(result, Localization):
        sigma = float(np.sqrt(max(np.trace(result.camera_covariance[:3, :3]), 0.0)))
        evidence += (
            f", probability {result.probability:.2f}, its own standard deviation"
            f" {format_length(sigma)}"
        )
    if answer.nearest_node_id not in (None, node and node.summary.node_id):
        evidence += f"; nearest to the truth is node {answer.nearest_node_id}"
    kind = (
        "good"
        if result.localized != (answer.world_from_cam is None) and not answer.is_false_accept
        else "bad"
    )
    title = escape(f"{answer.recording}/{answer.query}" if answer.recording else answer.query)
    return (
        f'<article>{_render_images(answer, node, topomap)}<div class="facts"><b>{title}</b>'
        f'<p class="{kind}">{_describe_result(answer)}</p><p>{evidence}</p></div></article>'
    )


def _select_node(answer: EvaluatedQuery, topomap: TopoMetricMap) -> TopoNode | None:
    """Return the node of the pose, without a pose the nearest one or the first candidate."""
    if isinstance(answer.result, Localization):
        node_id = answer.result.node_id
    elif answer.nearest_node_id is not None:
        node_id = answer.nearest_node_id
    elif answer.result.candidates:
        node_id = answer.result.candidates[0].node_id
    else:
        return None
    return topomap.nodes[topomap.row_of(node_id)]


def _describe_result(answer: EvaluatedQuery) -> str:
    if isinstance(answer.result, NotLocalized):
        reason = answer.result.reason.replace("_", " ")
        return (
            f"rightly rejected: {reason}"
            if answer.world_from_cam is None
            else f"not localized: {reason}"
        )
    if answer.world_from_cam is None:
        return "false accept: this image was not taken here"
    error = f"{format_length(answer.translation_m)}, {answer.rotation_deg:.2f}°"
    return f"false accept: off by {error}" if answer.is_false_accept else f"off by {error}"


def _render_images(answer: EvaluatedQuery, node: TopoNode | None, topomap: TopoMetricMap) -> str:
    image = _load_query_image(answer)
    if image is None:
        shown, caption = (
            node.template_jpeg if node else None,
            "the query's picture cannot be read any more",
        )
    elif node is None:
        shown, caption = (
            encode_jpeg(draw_pair(image, None), JPEG_QUALITY),
            "query; no node to compare it with",
        )
    else:
        pair = draw_pair(
            image,
            decode_template(node),
            _find_matches(answer, image, node, topomap),
            node.camera,
        )
        shown = encode_jpeg(pair, JPEG_QUALITY)
        caption = f"left the query, right node {node.summary.node_id}"
    return f"<figure>{_img_tag(shown, caption)}<figcaption>{caption}</figcaption></figure>"


def _find_matches(
    answer: EvaluatedQuery, image: Image, node: TopoNode, topomap: TopoMetricMap
) -> NodeMatches | None:
    """Matches to draw; None where the node has no points or the camera is not known."""
    if answer.camera is None or node.summary.num_points == 0:
        return None
    matcher = NodeMatcher(node, topomap.config.features)
    return match_with_node(answer, image, answer.camera, matcher)


def _load_query_image(answer: EvaluatedQuery) -> Image | None:
    """The query's picture, read again; None where it cannot be had any more."""
    try:
        return answer.read_image() if answer.read_image else None
    except UnreadableImageError:
        return None


def _img_tag(jpeg: bytes | None, alt_text: str) -> str:
    if jpeg is None:
        return ""
    return (
        f'<img loading="lazy" src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode("ascii")}"'
        f' alt="{escape(alt_text)}">'
    )
