"""An evaluation as one self-contained page: numbers, map, error curves, times, single queries."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from topoloc import EvaluatedQuery, Evaluation, TopoMetricMap
from topoloc.apps.report.figures import draw_error_curves, draw_errors_along, draw_stage_times
from topoloc.apps.report.map_figure import draw_map
from topoloc.apps.report.page_template import render_page, render_section
from topoloc.apps.report.query_gallery import (
    render_gallery,
    select_typical_queries,
    select_worst_queries,
)
from topoloc.apps.report.report_tables import (
    ReportTexts,
    explain_shares,
    render_headline_cards,
    render_number_tables,
    render_recordings_table,
)
from topoloc.apps.viewer.document import ResultSet, SceneBudget, create_document
from topoloc.apps.viewer.page import embedded_head, embedded_scene
from topoloc.plugin import write_text

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
    "A curve shows the share of all queries with at most this error. It ends at the share of"
    " queries with a pose."
)
_TYPICAL = (
    "The query with the median error of each recording, and the node of its pose. Matches that"
    " agree with the pose are green, others are red."
)
_WORST = (
    "False accepts first, then queries without a pose, then the largest errors. Each recording has"
    " an equal share of the places. Without a pose, the lines are matches by appearance: green if"
    " they agree with the truth, red if not."
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
    """Write the page atomically. The same results give the same bytes.

    Args:
        evaluation: `Evaluation.to_json`, with `TopoMetricMap.describe` under "map".

    Raises:
        TopolocError: the file cannot be written.
    """
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
    sets = [
        ResultSet(name or "queries", [answer.to_json() for answer in group])
        for name, group in Evaluation(answers).by_recording.items()
    ]
    name = Path(evaluation["map"]["path"]).name
    document = create_document(topomap, name, sets, _SCENE_BUDGET)
    yield render_section("The place", _SCENE, embedded_scene(document))
    yield render_section("The map from above", _MAP, _scrollable(draw_map(answers, topomap)))
    if evaluation["num_localized"]:
        curves = f'<div class="halves">{"".join(draw_error_curves(answers))}</div>'
        yield render_section("Error curves", _CURVES, curves)
    if len(evaluation["recordings"]) > 1:
        gallery = render_gallery(select_typical_queries(answers), topomap)
        yield render_section("Typical queries", _TYPICAL, gallery)
    worst = select_worst_queries(answers)
    gallery = render_gallery(worst, topomap) if worst else ""
    yield render_section("The worst queries", _WORST if worst else _NO_WORST, gallery)
    if evaluation["num_queries"]:
        figure = _scrollable(draw_errors_along(answers))
        yield render_section("Errors along the recordings", _ALONG, figure)
    if evaluation["median_times_ms"]:
        yield render_section("Times", _TIMES, _scrollable(draw_stage_times(answers)))
    yield render_section("All numbers", "", render_number_tables(evaluation))
    config = escape(json.dumps(evaluation["map"]["config"], indent=1, sort_keys=True))
    yield (
        "<section><details><summary>The settings of the map</summary>"
        f"<pre>{config}</pre></details></section>"
    )


def _scrollable(figure: str) -> str:
    """Wrap a figure that scrolls on a narrow screen."""
    return f'<div class="wide">{figure}</div>'
