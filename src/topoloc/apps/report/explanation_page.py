"""An explanation as one self-contained page."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from topoloc import Image, Localization, TopoMetricMap
from topoloc.apps.report.explanation import EvaluatedPose, Explanation
from topoloc.apps.report.match_images import JPEG_QUALITY, NodeMatches, decode_template, draw_pair
from topoloc.apps.report.page_template import render_page
from topoloc.plugin import encode_jpeg, write_text

_POSES_TEXT = (
    "Of each first pose: points were sought where the map expects them, and weighed. Found counts"
    " those of all that must be in view."
)
_MAX_SHOWN, MAX_MATCHES = 3, 300
_COLUMNS = (
    "tried",
    "features",
    "near node",
    "first inliers",
    "found",
    "by chance",
    "unguided",
    "probability",
    "what became of it",
)


def write_explanation(
    path: Path, name: str, image: Image, explanation: Explanation, topomap: TopoMetricMap
) -> None:
    """Write the page, at once or not at all. Raises TopolocError where the file cannot be
    written."""
    write_text(path, explanation_page(name, image, explanation, topomap))


def explanation_page(
    name: str, image: Image, explanation: Explanation, topomap: TopoMetricMap
) -> str:
    """The page, HTML."""
    title = f"Why {name} {'is here' if explanation.result.localized else 'was not localized'}"
    advice = (
        "".join(f"<li>{escape(line)}</li>" for line in explanation.advice)
        or "<li>Nothing is amiss.</li>"
    )
    table = (
        '<div class="wide" tabindex="0" role="region" aria-label="What was'
        f' tried">{_render_table(explanation)}</div>'
    )
    sections = (
        '<section style="margin-top:-48px"><h2>What would'
        f" help</h2><ul>{advice}</ul></section><section><h2>What it was compared"
        f" with</h2><p>{_shown_text(explanation)}</p>{_render_pairs(image, explanation, topomap)}</section><section><h2>What"  # noqa: E501
        f" was tried</h2><p>{_POSES_TEXT}</p>{table}</section>"
    )
    return render_page(title, verdict(explanation), sections)


def verdict(explanation: Explanation) -> str:
    """The result in one sentence."""
    result = explanation.result
    if not isinstance(result, Localization):
        return (
            f"Not localized: {result.reason.replace('_', ' ')}. {len(explanation.poses)} poses were"
            " looked into."
        )
    x, y, z = result.world_from_cam.translation
    sigmas = f"{100.0 * result.position_sigma_m:.1f} cm, {result.rotation_sigma_deg:.2f} deg"
    return (
        f"At ({x:.2f}, {y:.2f}, {z:.2f}) m near node {result.node_id}, probability"
        f" {result.probability:.2f}, standard deviations {sigmas}."
    )


def _rank_poses(explanation: Explanation) -> list[EvaluatedPose]:
    """The poses that are shown, the likeliest first, each node once."""
    with_pose = [pose for pose in explanation.poses if pose.tried.fit.node_id >= 0]
    with_pose.sort(
        key=lambda pose: (pose.probability or 0.0, pose.tried.fit.num_inliers), reverse=True
    )
    return list({pose.tried.fit.node_id: pose for pose in reversed(with_pose)}.values())[::-1][
        :_MAX_SHOWN
    ]


def _shown_text(explanation: Explanation) -> str:
    if not _rank_poses(explanation):
        return (
            "No pose came of any part of the map; beside it stands the node that looks most"
            " like it."
        )
    return "Left the picture, right the node of the map. Lines join what the pose explains."


def _render_pairs(image: Image, explanation: Explanation, topomap: TopoMetricMap) -> str:
    articles = [_render_pose(image, pose, topomap) for pose in _rank_poses(explanation)]
    if not articles and explanation.result.candidates:
        node = topomap.nodes[topomap.row_of(explanation.result.candidates[0].node_id)]
        pair = draw_pair(image, decode_template(node))
        articles = [_render_figure(pair, f"left the picture, right node {node.summary.node_id}")]
    return '<div class="queries">' + "".join(articles) + "</div>"


def compared_to_json(
    image: Image, explanation: Explanation, topomap: TopoMetricMap
) -> list[dict[str, Any]]:
    """The likeliest poses as the page shows them; rows of `matches` are a pixel of the picture and
    one of the node's camera."""
    compared = list[dict[str, Any]]()
    for pose in _rank_poses(explanation):
        node, matches = (
            topomap.nodes[topomap.row_of(pose.tried.fit.node_id)],
            _find_explained_matches(image, pose, topomap),
        )
        pixels = np.column_stack([matches.points_query, matches.points_node]).round(1)[:MAX_MATCHES]
        facts = {
            "node": pose.tried.fit.node_id,
            "node_size": [node.camera.width, node.camera.height],
            "verdict": pose.verdict,
        }
        compared.append(
            facts | {"num_inliers": pose.tried.fit.num_inliers, "matches": pixels.tolist()}
        )
    return compared


def _find_explained_matches(
    image: Image, pose: EvaluatedPose, topomap: TopoMetricMap
) -> NodeMatches:
    """What the pose explains, as far as its node would see it."""
    node, fit = topomap.nodes[topomap.row_of(pose.tried.fit.node_id)], pose.tried.fit
    scale = image.shape[1] / fit.camera.width
    query = (fit.features.points_img[fit.inlier_query_idx].astype(np.float64) + 0.5) * scale - 0.5
    points = fit.local_map.points_world[fit.inlier_point_idx]
    seen = node.camera.img_from_cam(node.summary.world_from_cam.inverse().apply(points))
    inside = (
        np.isfinite(seen).all(axis=1)
        & (seen >= 0).all(axis=1)
        & (seen < [node.camera.width, node.camera.height]).all(axis=1)
    )
    return NodeMatches(
        query[inside], seen[inside], np.full(int(inside.sum()), pose.verdict == "the answer")
    )


def _render_pose(image: Image, pose: EvaluatedPose, topomap: TopoMetricMap) -> str:
    node = topomap.nodes[topomap.row_of(pose.tried.fit.node_id)]
    pair = draw_pair(
        image,
        decode_template(node),
        _find_explained_matches(image, pose, topomap),
        node.camera,
    )
    kind = "good" if pose.verdict == "the answer" else "bad"
    node_id = node.summary.node_id
    facts = (
        f'<div class="facts"><b>node {node_id}, {pose.tried.fit.num_inliers} inliers</b><p'
        f' class="{kind}">{escape(pose.verdict)}</p></div>'
    )
    figure = _render_figure(pair, f"left the image, right node {node_id}")
    return f"<article>{figure}{facts}</article>"


def _render_figure(pair: Image, caption: str) -> str:
    data = base64.b64encode(encode_jpeg(pair, JPEG_QUALITY)).decode("ascii")
    return (
        f'<figure><img alt="{caption}"'
        f' src="data:image/jpeg;base64,{data}"><figcaption>{caption}</figcaption></figure>'
    )


def _render_table(explanation: Explanation) -> str:
    head = "".join(f"<th>{name}</th>" for name in _COLUMNS)
    rows = [zip(_COLUMNS, row_of(pose), strict=True) for pose in explanation.poses]
    body = "".join(
        "<tr>"
        + "".join(f'<td data-column="{name}">{escape(cell)}</td>' for name, cell in row)
        + "</tr>"
        for row in rows
    )
    return f'<table class="tried folds"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def row_of(pose: EvaluatedPose) -> tuple[str, ...]:
    """What `_COLUMNS` name, as text."""
    evidence = pose.tried.hypothesis.evidence if pose.tried.hypothesis is not None else None
    node = str(pose.tried.fit.node_id) if pose.tried.fit.node_id >= 0 else ""
    first = f"{pose.tried.first.num_inliers} of {len(pose.tried.first.matches)}"
    if evidence is None:
        return pose.tried.source, pose.tried.features, node, first, "", "", "", "", pose.verdict
    found, unguided = (
        f"{evidence.num_found} of {evidence.num_visible}",
        f"{evidence.num_inliers} of {evidence.num_matches}",
    )
    probability = "" if pose.probability is None else f"{pose.probability:.2f}"
    return (
        pose.tried.source,
        pose.tried.features,
        node,
        first,
        found,
        str(evidence.num_by_chance),
        unguided,
        probability,
        pose.verdict,
    )
