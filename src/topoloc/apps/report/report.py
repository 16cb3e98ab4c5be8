"""An evaluation as one self-contained page: numbers, map, error curves, times, single queries."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

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
from topoloc.apps.core_names import NodeMatcher, encode_jpeg, format_length
from topoloc.apps.report.figures import draw_error_curves, draw_errors_along, draw_stage_times
from topoloc.apps.report.map_figure import draw_map
from topoloc.apps.report.match_images import (
    JPEG_QUALITY,
    NodeMatches,
    draw_pair,
    match_with_node,
    read_template,
)
from topoloc.apps.report.page_template import (
    render_figure,
    render_gallery_items,
    render_page,
    render_section,
    render_wide,
)
from topoloc.apps.report.report_tables import (
    ReportTexts,
    explain_shares,
    render_headline_cards,
    render_number_tables,
    render_quarters,
    render_recordings_table,
)
from topoloc.apps.viewer.document import ResultSet, SceneBudget, create_document
from topoloc.apps.viewer.page import embedded_head, embedded_scene
from topoloc.plugin import write_text

NUM_WORST = 6


def select_worst_queries(
    answers: Sequence[EvaluatedQuery], count: int = NUM_WORST
) -> list[EvaluatedQuery]:
    """Return false accepts first, then queries without a pose, then the largest errors over their
    standard deviations.

    Each recording has an equal share of the places.
    """
    judged = [a for a in answers if a.world_from_cam is not None or a.is_false_accept]
    groups = Evaluation(judged).by_recording
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
    return 2 * answer.is_false_accept, answer.error_over_sigma


def _render_query(answer: EvaluatedQuery, topomap: TopoMetricMap) -> tuple[str, str]:
    """Return the figure and the facts of a query."""
    result, node = answer.result, _select_node(answer, topomap)
    evidence = f"{result.num_inliers} inliers of {result.num_matches} matches"
    if isinstance(result, Localization):
        evidence += f", probability {result.probability:.2f}"
        evidence += f", reported standard deviation {format_length(result.position_sigma_m)}"
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
    error += f", {answer.error_over_sigma:.1f} standard deviations"
    return f"false accept: off by {error}" if answer.is_false_accept else f"off by {error}"


def _render_images(answer: EvaluatedQuery, node: TopoNode | None, topomap: TopoMetricMap) -> str:
    try:
        image = answer.read_image() if answer.read_image else None
    except UnreadableImageError:
        image = None
    if image is None:
        encoded = node.template_image if node else None
        return render_figure(encoded, "the query's image cannot be read any more")
    if node is None:
        pair = draw_pair(image, None)
        return render_figure(encode_jpeg(pair, JPEG_QUALITY), "query, without a node to compare")
    matches = _find_matches(answer, image, node, topomap)
    template, words = read_template(node)
    pair = draw_pair(image, template, matches, node.camera)
    return render_figure(encode_jpeg(pair, JPEG_QUALITY), f"left the query, {words}")


def _find_matches(
    answer: EvaluatedQuery, image: Image, node: TopoNode, topomap: TopoMetricMap
) -> NodeMatches | None:
    """Return matches to draw; None if the node has no points or the camera is unknown."""
    if answer.camera is None or node.summary.num_points == 0:
        return None
    matcher = NodeMatcher(node, topomap.config.features)
    return match_with_node(answer, image, answer.camera, matcher)


_SCENE_BUDGET = SceneBudget(max_points=60_000, max_image_bytes=1_500_000)
_SCENE = (
    "Turn the map with mouse, finger or arrow keys. The images of each recording stand at their"
    " estimated poses. The ellipsoid of a selected image contains its position with a probability"
    " of 95 %. Dashed lines show the truth."
)
_MAP = (
    "Seen from above. A tick shows the viewing direction of a node. Lines lead from true to"
    " estimated positions."
)
_CURVES = (
    "A curve shows the share of all queries with at most this error, up to the largest one. It ends"
    " at the share of queries with a pose. The axis of the errors is logarithmic."
)
_TYPICAL = (
    "The query with the median error of each recording, and the node of its pose. Matches that"
    " agree with the pose are green, others are red."
)
_WORST = (
    "False accepts first, then queries without a pose, then the largest errors over their reported"
    " standard deviations. Each recording has an equal share of the places. Without a pose, the"
    " lines are matches by appearance: green if they agree with the truth, red if not."
)
_NO_WORST = "There are none: no out-of-map image has a pose."
_ALONG = "Every query in the order of its recording. The axis of the errors is logarithmic."
_TIMES = (
    "Bars are medians. The line ends at the 95 % quantile. The total includes the time between the"
    " stages."
)


def write_report(
    path: Path,
    evaluation: dict[str, Any],
    answers: list[EvaluatedQuery],
    topomap: TopoMetricMap,
    texts: ReportTexts | None = None,
) -> None:
    """Write the page atomically. The same results give the same bytes. `evaluation`:
    `Evaluation.to_json`, with `TopoMetricMap.describe` under "map". Raises TopolocError: the file
    cannot be written."""
    texts = texts or ReportTexts()
    names = [row["name"] for row in evaluation["recordings"] if row["name"]]
    title = texts.title or f"Localization in {Path(evaluation['map']['path']).name}"
    subtitle = texts.subtitle or f"Queries: {', '.join(names) or 'no recordings'}"
    body = "\n".join(_render_sections(evaluation, answers, topomap, texts))
    write_text(path, render_page(title, subtitle, body, embedded_head()))


def _render_sections(
    evaluation: dict[str, Any],
    answers: list[EvaluatedQuery],
    topomap: TopoMetricMap,
    texts: ReportTexts,
) -> Iterator[str]:
    yield render_headline_cards(evaluation)
    paragraphs = "".join(f'<p class="lead">{escape(text)}</p>' for text in texts.paragraphs)
    table = render_recordings_table(evaluation, texts)
    yield render_section("Results", explain_shares(evaluation), table + paragraphs)
    evaluated = Evaluation(answers)
    yield render_quarters(evaluated.quarters)
    sets = [
        ResultSet(name or "queries", [answer.to_json() for answer in group])
        for name, group in evaluated.by_recording.items()
    ]
    name = Path(evaluation["map"]["path"]).name
    document = create_document(topomap, name, sets, _SCENE_BUDGET)
    yield render_section("The place", _SCENE, embedded_scene(document))
    yield render_section(
        "The map from above", _MAP, render_wide(draw_map(answers, topomap), "The map from above")
    )
    if evaluation["num_localized"]:
        curves = f'<div class="halves">{"".join(draw_error_curves(answers))}</div>'
        yield render_section("Error curves", _CURVES, curves)
    if len(evaluation["recordings"]) > 1:
        gallery = render_gallery(select_typical_queries(answers), topomap)
        yield render_section("Typical queries", _TYPICAL, gallery)
    worst = select_worst_queries(answers)
    gallery = render_gallery(worst, topomap) if worst else ""
    yield render_section("The worst answers", _WORST if worst else _NO_WORST, gallery)
    if evaluation["num_queries"]:
        figure = render_wide(draw_errors_along(answers), "Errors along the recordings")
        yield render_section("Errors along the recordings", _ALONG, figure)
    if evaluation["median_times_ms"]:
        yield render_section("Times", _TIMES, render_wide(draw_stage_times(answers), "Times"))
    yield render_section("All numbers", "", render_number_tables(evaluation))
    config = escape(json.dumps(evaluation["map"]["config"], indent=1, sort_keys=True))
    yield (
        "<section><details><summary>The settings of the map</summary>"
        f"<pre>{config}</pre></details></section>"
    )
