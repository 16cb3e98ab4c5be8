"""An explanation as one self-contained page."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from topoloc import Finding, Image, Localization, TopoMetricMap
from topoloc.apps.core_names import encode_jpeg
from topoloc.apps.report.explanation import EvaluatedPose, Explanation
from topoloc.apps.report.match_images import JPEG_QUALITY, NodeMatches, draw_pair, read_template
from topoloc.apps.report.page_template import (
    render_figure,
    render_gallery_items,
    render_page,
    render_section,
    render_table,
)

_POSES_TEXT = (
    "Each row is a pose proposal. Found counts the map points that were found again, of all that"
    " must be visible from the pose."
)
_CHECKS_TEXT = (
    "Each check may change the likeliest pose or refuse it. The factor multiplies its probability."
)
_PAIRS_TEXT = "Left the image, right the node. Lines are matches that agree with the pose."
_NO_PAIRS_TEXT = "No part of the map gave a pose. The node is the most similar one."
_MAX_SHOWN, MAX_MATCHES = 3, 300
_COLUMNS = (
    "proposal",
    "features",
    "near node",
    "first inliers",
    "found",
    "by chance",
    "unguided",
    "probability",
    "verdict",
)


_CHECK_COLUMNS = ("check", "finding", "factor")


def explanation_page(
    name: str, image: Image, explanation: Explanation, topomap: TopoMetricMap
) -> str:
    """Return the page as HTML."""
    advice = "".join(f"<li>{escape(line)}</li>" for line in explanation.advice)
    shown = _rank_poses(explanation)
    items = [_render_pose(image, pose, topomap) for pose in shown]
    if not items and explanation.result.candidates:
        node = topomap.nodes[topomap.row_of(explanation.result.candidates[0].node_id)]
        template, words = read_template(node)
        pair = encode_jpeg(draw_pair(image, template), JPEG_QUALITY)
        items = [(render_figure(pair, f"left the image, {words}"), "")]
    rows = [[escape(cell) for cell in row_of(pose)] for pose in explanation.poses]
    table = render_table(_COLUMNS, rows, "tried", "What was tried")
    checks = [[escape(cell) for cell in check_row(finding)] for finding in explanation.findings]
    checks_table = render_table(_CHECK_COLUMNS, checks, "checks", "What was checked")
    pairs_text = _PAIRS_TEXT if shown else _NO_PAIRS_TEXT
    sections = [
        render_section("Advice", "", f"<ul>{advice or '<li>No problem was found.</li>'}</ul>"),
        render_section("Comparison with the map", pairs_text, render_gallery_items(items)),
        render_section("What was tried", _POSES_TEXT, table),
        render_section("What was checked", _CHECKS_TEXT, checks_table),
    ]
    outcome = "was localized" if explanation.result.localized else "was not localized"
    return render_page(f"Why {name} {outcome}", verdict(explanation), "".join(sections))


def verdict(explanation: Explanation) -> str:
    """Return the result in one or two sentences."""
    result = explanation.result
    if not isinstance(result, Localization):
        reason = result.reason.replace("_", " ")
        return f"Not localized: {reason}. {len(explanation.poses)} pose proposals were tried."
    x, y, z = result.world_from_cam.translation
    unit = "m" if result.provenance.has_scale else "units"
    sigmas = f"{result.position_sigma_text}, {result.rotation_sigma_deg:.2f} deg"
    return (
        f"At ({x:.2f}, {y:.2f}, {z:.2f}) {unit} near node {result.node_id}, probability"
        f" {result.probability:.2f}, standard deviations {sigmas}."
    )


def _rank_poses(explanation: Explanation) -> list[EvaluatedPose]:
    """Return the poses to show, the most probable first, one for each node."""
    ranked = sorted(
        (pose for pose in explanation.poses if pose.num_inliers and pose.tried.fit.node_id >= 0),
        key=lambda pose: (pose.probability or 0.0, pose.tried.fit.num_inliers),
        reverse=True,
    )
    best = dict[int, EvaluatedPose]()
    for pose in ranked:
        best.setdefault(pose.tried.fit.node_id, pose)
    return list(best.values())[:_MAX_SHOWN]


def compared_to_json(
    image: Image, explanation: Explanation, topomap: TopoMetricMap
) -> list[dict[str, Any]]:
    """Return the poses that the page shows. A row of `matches` is a pixel of the image and one of
    the node's camera."""
    compared = list[dict[str, Any]]()
    for pose in _rank_poses(explanation):
        camera = topomap.nodes[topomap.row_of(pose.tried.fit.node_id)].camera
        matches = _find_explained_matches(image, pose, topomap)
        pixels = np.column_stack([matches.points_query, matches.points_node]).round(1)[:MAX_MATCHES]
        node = {"node": pose.tried.fit.node_id, "node_size": [camera.width, camera.height]}
        facts = {"verdict": pose.verdict, "num_inliers": pose.num_inliers}
        compared.append(node | facts | {"matches": pixels.tolist()})
    return compared


def _find_explained_matches(
    image: Image, pose: EvaluatedPose, topomap: TopoMetricMap
) -> NodeMatches:
    """Return the inliers of the pose that lie inside the image of its node."""
    node, fit = topomap.nodes[topomap.row_of(pose.tried.fit.node_id)], pose.tried.fit
    scale = image.shape[1] / fit.camera.width
    points_img = fit.features.points_img[fit.inlier_query_idx].astype(np.float64)
    query = (points_img + 0.5) * scale - 0.5
    points = fit.local_map.points_world[fit.inlier_point_idx]
    seen = node.camera.img_from_cam(node.summary.world_from_cam.inverse().apply(points))
    size = [node.camera.width, node.camera.height]
    inside = np.isfinite(seen).all(axis=1) & ((seen >= 0) & (seen < size)).all(axis=1)
    is_answer = np.full(int(inside.sum()), pose.verdict == "the answer")
    return NodeMatches(query[inside], seen[inside], is_answer)


def _render_pose(image: Image, pose: EvaluatedPose, topomap: TopoMetricMap) -> tuple[str, str]:
    """Return the figure and the facts of a pose."""
    node = topomap.nodes[topomap.row_of(pose.tried.fit.node_id)]
    matches = _find_explained_matches(image, pose, topomap)
    template, words = read_template(node)
    pair = draw_pair(image, template, matches, node.camera)
    kind = "good" if pose.verdict == "the answer" else "bad"
    facts = (
        f"<b>node {pose.tried.fit.node_id}, {pose.num_inliers} inliers</b>"
        f'<p class="{kind}">{escape(pose.verdict)}</p>'
    )
    return render_figure(encode_jpeg(pair, JPEG_QUALITY), f"left the image, {words}"), facts


def row_of(pose: EvaluatedPose) -> tuple[str, ...]:
    """Return the cells of a pose in the order of `_COLUMNS`."""
    node = str(pose.tried.fit.node_id) if pose.tried.fit.node_id >= 0 else ""
    first = f"{pose.tried.first.num_inliers} of {len(pose.tried.first.matches)}"
    refined = pose.tried.refined  # of a rejected pose; what must be visible was not counted
    evidence = ("" if refined is None else str(refined.num_inliers), "", "", "")
    if pose.tried.hypothesis is not None:
        e = pose.tried.hypothesis.evidence
        found, unguided = f"{e.num_found} of {e.num_visible}", f"{e.num_inliers} of {e.num_matches}"
        probability = "" if pose.probability is None else f"{pose.probability:.2f}"
        evidence = (found, str(e.num_by_chance), unguided, probability)
    return (pose.tried.source, pose.tried.features, node, first, *evidence, pose.verdict)


def check_row(finding: Finding) -> tuple[str, str, str]:
    """Return the cells of a check in the order of `_CHECK_COLUMNS`."""
    text = f"refused: {finding.text}" if finding.refusal else finding.text
    return finding.check, text, f"{finding.factor:.2g}"
