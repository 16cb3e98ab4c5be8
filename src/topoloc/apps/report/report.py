"""An evaluation as one self-contained page: numbers, the map from above, error curves, times, and
single queries to look at."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from topoloc import EvaluatedQuery, TopoMetricMap
from topoloc.apps.report.figures import draw_error_curves, draw_errors_along, draw_stage_times
from topoloc.apps.report.map_figure import draw_map
from topoloc.apps.report.page_template import render_page
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
from topoloc.plugin import group_by_recording, write_text

_SCENE_BUDGET = SceneBudget(max_points=60_000, max_image_bytes=1_500_000)
_SCENE = (
    "Turn it by mouse, finger or arrow keys. Each recording's pictures stand where they were found;"
    " of one that is chosen the ellipsoid holds its position in 95 of 100 cases, and what is dashed"
    " is the truth."
)
_MAP = (
    "Seen from above. A tick at a node shows where its camera looked; lines lead from true to"
    " estimated positions."
)
_CURVES = (
    "The height of a curve is the share of all queries whose error is at most that much; it ends"
    " where no more queries have a pose."
)
_TYPICAL = (
    "Of each recording the query with the median error, and the node of the map that its pose comes"
    " from. Lines join what was matched: green what the pose explains, red what it does not."
)
_WORST = (
    "False accepts first, then queries without a pose, then the largest errors; each recording has"
    " its share of the places. Where there is no pose, lines show what looks alike: green what is"
    " right by the truth, red what is wrong."
)
_NO_WORST = "There are none: no image from elsewhere was given a pose."
_ALONG = "Every query in the order of its recording; errors on a logarithmic scale."
_TIMES = (
    "Bars are medians; the line ends where 95 % of the queries are done. The total includes what"
    " lies between the stages."
)


def write_report(
    path: Path,
    evaluation: dict[str, Any],
    answers: list[EvaluatedQuery],
    topomap: TopoMetricMap,
    texts: ReportTexts | None = None,
) -> None:
    """Write the page, at once or not at all; the same answers give the same bytes.

    Args:
        evaluation: what `summarize` says of the answers, with what `topoloc info` says of the map
            under "map".

    Raises:
        TopolocError: the file cannot be written.
    """
    write_text(path, _render_page(evaluation, answers, topomap, texts or ReportTexts()))


def _render_page(
    evaluation: dict[str, Any],
    answers: list[EvaluatedQuery],
    topomap: TopoMetricMap,
    texts: ReportTexts,
) -> str:
    recordings = (
        ", ".join(row["name"] for row in evaluation["recordings"] if row["name"]) or "no recordings"
    )
    title = texts.title or f"Localization in {Path(evaluation['map']['path']).name}"
    body = "\n".join(
        [render_headline_cards(evaluation), *_render_sections(evaluation, answers, topomap, texts)]
    )
    return render_page(title, texts.subtitle or f"Asked about: {recordings}", body, embedded_head())


def _render_sections(
    evaluation: dict[str, Any],
    answers: list[EvaluatedQuery],
    topomap: TopoMetricMap,
    texts: ReportTexts,
) -> Iterator[str]:
    paragraphs = "".join(
        f'<p class="lead">{escape(paragraph)}</p>' for paragraph in texts.paragraphs
    )
    yield _render_section(
        "Results",
        explain_shares(evaluation),
        render_recordings_table(evaluation, texts) + paragraphs,
    )
    yield _render_section(
        "The place", _SCENE, embedded_scene(_scene_document(evaluation, answers, topomap))
    )
    yield _render_section("The map from above", _MAP, _scrollable(draw_map(answers, topomap)))
    if evaluation["num_localized"]:
        yield _render_section(
            "How large are the errors?",
            _CURVES,
            f'<div class="halves">{"".join(draw_error_curves(answers))}</div>',
        )
    if len(evaluation["recordings"]) > 1:
        yield _render_section(
            "What the queries look like",
            _TYPICAL,
            render_gallery(select_typical_queries(answers), topomap),
        )
    worst = select_worst_queries(answers)
    yield _render_section(
        "The worst queries",
        _WORST if worst else _NO_WORST,
        render_gallery(worst, topomap) if worst else "",
    )
    if evaluation["num_queries"]:
        yield _render_section(
            "Where do errors occur?", _ALONG, _scrollable(draw_errors_along(answers))
        )
    if evaluation["median_times_ms"]:
        yield _render_section(
            "Where does the time go?", _TIMES, _scrollable(draw_stage_times(answers))
        )
    yield _render_section("All the numbers", "", render_number_tables(evaluation))
    config = escape(json.dumps(evaluation["map"]["config"], indent=1, sort_keys=True))
    yield (
        "<section><details><summary>The configuration that the map was built"
        f" with</summary><pre>{config}</pre></details></section>"
    )


def _scene_document(
    evaluation: dict[str, Any], answers: list[EvaluatedQuery], topomap: TopoMetricMap
) -> dict[str, Any]:
    """The map, and the answers of each recording."""
    sets = [
        ResultSet(name or "queries", [answer.to_json() for answer in group])
        for name, group in group_by_recording(answers).items()
    ]
    return create_document(topomap, Path(evaluation["map"]["path"]).name, sets, _SCENE_BUDGET)


def _render_section(title: str, explanation: str, content: str) -> str:
    return (
        f"<section><h2>{title}</h2>"
        + (f"<p>{explanation}</p>" if explanation else "")
        + f"{content}</section>"
    )


def _scrollable(figure: str) -> str:
    """A figure that is scrolled, not shrunk beyond reading, on a narrow screen."""
    return f'<div class="wide">{figure}</div>'
