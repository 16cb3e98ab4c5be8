"""The part of a report with single queries: the worst and the typical ones, beside their nodes."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from topoloc import (
    EvaluatedQuery,
    Evaluation,
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
from topoloc.apps.report.page_template import render_figure, render_gallery_items
from topoloc.plugin import NodeMatcher, encode_jpeg, format_length

NUM_WORST = 6


def select_worst_queries(
    answers: Sequence[EvaluatedQuery], count: int = NUM_WORST
) -> list[EvaluatedQuery]:
    """Return false accepts first, then queries without a pose, then the largest errors.

    Each recording has an equal share of the places.
    """
    groups = Evaluation(
        [a for a in answers if a.world_from_cam is not None or a.is_false_accept]
    ).by_recording
    share = max(count // max(len(groups), 1), 1)
    ranked = [
        (rank, answer)
        for group in groups.values()
        for rank, answer in enumerate(sorted(group, key=_error_rank, reverse=True))
    ]
    ranked.sort(key=lambda entry: (entry[0] < share, _error_rank(entry[1])), reverse=True)
    return sorted((answer for _, answer in ranked[:count]), key=_error_rank, reverse=True)


def select_typical_queries(answers: Sequence[EvaluatedQuery]) -> list[EvaluatedQuery]:
    """Return the query with the median error of each recording; without poses the middle one."""
    typical = []
    for group in Evaluation(list(answers)).by_recording.values():
        localized = [a for a in group if np.isfinite(a.translation_m)]
        chosen = sorted(localized, key=lambda a: a.translation_m) or group
        typical.append(chosen[(len(chosen) - 1) // 2])
    return typical


def render_gallery(answers: Sequence[EvaluatedQuery], topomap: TopoMetricMap) -> str:
    """Return the queries as HTML, each with its image, its node, their matches and the result."""
    return render_gallery_items(_render_query(answer, topomap) for answer in answers)


def _error_rank(answer: EvaluatedQuery) -> tuple[int, float]:
    if answer.world_from_cam is None:
        return 2 * answer.is_false_accept, 0.0
    if isinstance(answer.result, NotLocalized):
        return 1, 0.0
    errors = (
        answer.translation_m / answer.MAX_TRANSLATION,
        answer.rotation_deg / answer.MAX_ROTATION_DEG,
    )
    return 2 * answer.is_false_accept, max(errors)


def _render_query(answer: EvaluatedQuery, topomap: TopoMetricMap) -> tuple[str, str]:
    """Return the figure and the facts of a query."""
    result = answer.result
    node = _select_node(answer, topomap)
    evidence = f"{result.num_inliers} inliers of {result.num_matches} matches"
    if isinstance(result, Localization):
        sigma = float(np.sqrt(max(np.trace(result.camera_covariance[:3, :3]), 0.0)))
        evidence += (
            f", probability {result.probability:.2f}, reported standard deviation"
            f" {format_length(sigma)}"
        )
    if answer.nearest_node_id not in (None, node and node.summary.node_id):
        evidence += f"; nearest to the truth is node {answer.nearest_node_id}"
    is_right = result.localized == (answer.world_from_cam is not None)
    kind = "good" if is_right and not answer.is_false_accept else "bad"
    title = escape(f"{answer.recording}/{answer.query}" if answer.recording else answer.query)
    description = _describe_result(answer)
    facts = f'<b>{title}</b><p class="{kind}">{description}</p><p>{evidence}</p>'
    return _render_images(answer, node, topomap), facts


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
        outcome = "rightly rejected" if answer.world_from_cam is None else "not localized"
        return f"{outcome}: {answer.result.reason.replace('_', ' ')}"
    if answer.world_from_cam is None:
        return "false accept: this image is out of the map"
    error = f"{format_length(answer.translation_m)}, {answer.rotation_deg:.2f}°"
    return f"false accept: off by {error}" if answer.is_false_accept else f"off by {error}"


def _render_images(answer: EvaluatedQuery, node: TopoNode | None, topomap: TopoMetricMap) -> str:
    try:
        image = answer.read_image() if answer.read_image else None
    except UnreadableImageError:
        image = None
    if image is None:
        jpeg = node.template_jpeg if node else None
        return render_figure(jpeg, "the query's image cannot be read any more")
    if node is None:
        pair = draw_pair(image, None)
        return render_figure(encode_jpeg(pair, JPEG_QUALITY), "query, without a node to compare")
    matches = _find_matches(answer, image, node, topomap)
    pair = draw_pair(image, decode_template(node), matches, node.camera)
    caption = f"left the query, right node {node.summary.node_id}"
    return render_figure(encode_jpeg(pair, JPEG_QUALITY), caption)


def _find_matches(
    answer: EvaluatedQuery, image: Image, node: TopoNode, topomap: TopoMetricMap
) -> NodeMatches | None:
    """Return matches to draw; None if the node has no points or the camera is unknown."""
    if answer.camera is None or node.summary.num_points == 0:
        return None
    matcher = NodeMatcher(node, topomap.config.features)
    return match_with_node(answer, image, answer.camera, matcher)
