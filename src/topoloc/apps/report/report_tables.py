"""The numbers of a report as HTML: the headline cards, a row for each recording, all numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from topoloc import EvaluatedQuery
from topoloc.apps.core_names import format_length
from topoloc.apps.quality.certificate_texts import QUARTER_COLUMNS, quarter_cells
from topoloc.apps.report.page_template import (
    recording_colours,
    render_cards,
    render_section,
    render_table,
)

_COLUMNS = (
    "recording",
    "localized",
    "median error",
    "in 5 cm, 5°",
    "in 25 cm, 2°",
    "false accepts",
    "ms",
)


_QUARTERS = (
    "The poses with known truth, in quarters of difficulty, the hardest first: by inliers, by the"
    " angle between the image and the nearest mapped frame, and by light (largest ratio of their"
    " mean grey levels and colours). Right is within 25 cm and 2°. If p and the covariance are"
    " honest, mean p is the share right in each quarter, and 95 % of the true poses are inside the"
    " 95 % ellipsoid."
)


@dataclass(frozen=True)
class PublishedResult:
    """A published result for comparison: median errors in metres and degrees."""

    name: str
    median_translation_m: float
    median_rotation_deg: float


@dataclass(frozen=True)
class ReportTexts:
    """Texts of a page beside its numbers.

    `about` describes recordings by name. `paragraphs` stand between the table of the recordings and
    the figures.
    """

    title: str = ""
    subtitle: str = ""
    paragraphs: Sequence[str] = ()
    about: Mapping[str, str] = field(default_factory=dict)
    published: Sequence[PublishedResult] = ()


def render_headline_cards(evaluation: dict[str, Any]) -> str:
    """Return the headline: the first recording with truth, then the one with the lowest recall."""
    rows = [row for row in evaluation["recordings"] if row["num_queries"]]
    e = rows[0] if len(rows) > 1 else evaluation
    name = f", {escape(e['name'])}" if len(rows) > 1 else ""
    cards = []
    if e["num_queries"]:
        text = f"localized, {e['num_localized']} of {e['num_queries']} queries{name}"
        cards.append(("", _localized_percent(e), text))
    else:
        cards.append(("", str(e["num_elsewhere"]), "out-of-map images"))
    if e["num_localized"]:
        cards.append(("", format_length(e["median_translation_m"]), f"median position error{name}"))
        cards.append(("", f"{e['median_rotation_deg']:.2f}°", f"median rotation error{name}"))
    if len(rows) > 1:
        hardest = min(rows[1:], key=lambda row: row["num_localized"] / row["num_queries"])
        text = f"localized, {escape(hardest['name'])}, the hardest of the others"
        cards.append(("", _localized_percent(hardest), text))
    false = evaluation["false_accepts"]
    num_images = evaluation["num_queries"] + evaluation["num_elsewhere"]
    text = f"false accept{'' if false == 1 else 's'}, of {num_images} images"
    cards.append(("bad" if false else "good", str(false), text))
    if "total" in evaluation["median_times_ms"]:
        cards.append(("", f"{evaluation['median_times_ms']['total']:.0f} ms", "a query, median"))
    return render_cards(cards)


def _localized_percent(row: dict[str, Any]) -> str:
    return f"{100 * row['num_localized'] / row['num_queries']:.1f} %"


def render_recordings_table(evaluation: dict[str, Any], texts: ReportTexts) -> str:
    """Return a table with a row for each recording, and the published results below."""
    names = [row["name"] for row in evaluation["recordings"] if row["num_queries"]]
    colours = recording_colours(names)
    about, recordings = texts.about, evaluation["recordings"]
    rows = [_recording_cells(row, colours, about.get(row["name"], "")) for row in recordings]
    for other in texts.published:
        median = f"{format_length(other.median_translation_m)}, {other.median_rotation_deg:.2f}°"
        rows.append([f"<em>{escape(other.name)}</em>", "", f"<em>{median}</em>", "", "", "", ""])
    return render_table(_COLUMNS, rows, "recordings")


def render_number_tables(evaluation: dict[str, Any]) -> str:
    """Return all numbers in two columns: the queries and the map."""
    e, m = evaluation, evaluation["map"]
    rows = []
    if e["num_queries"]:
        rows.append(("Queries with truth", f"{e['num_queries']}, localized {e['num_localized']}"))
    for name, share in e["recall"].items():
        if share is not None:
            metres, degrees = name.removesuffix("deg").split("m_")
            limit = f"Within {format_length(float(metres), digits=0)} and {degrees}°"
            rows.append((limit, f"{100 * share:.1f} % of all queries"))
    if e["topological_accuracy"] is not None:
        rows.append(("Nearest node ranked first", f"{100 * e['topological_accuracy']:.1f} %"))
    if e["num_elsewhere"]:
        rows.append(("Out-of-map images", str(e["num_elsewhere"])))
    if e["num_localized"]:
        largest = f"{format_length(e['max_translation_m'])}, {e['max_rotation_deg']:.2f}°"
        rows.append(("Largest error", largest))
        rows.append(("Poses off by more than 25 cm or 2°", str(e["num_inaccurate"])))
        rows.append(("Poses outside their 95 % ellipsoid", str(e["num_outside_ellipsoid"])))
    rows.append(("False accepts", str(e["false_accepts"])))
    reasons = e["not_localized"].items()
    refused = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in reasons)
    rows.append(("Reasons of refusals", refused or "none"))
    about_map = [
        ("Map", f"{m['num_nodes']} nodes, {m['num_points']:,} points"),
        ("Size", f"{m['bytes'] / 1e6:.2f} MB"),
        ("Mapped", f"{m['length_m']:.1f} m of trajectory"),
        ("Extent", " × ".join(f"{extent:.1f}" for extent in m["extent_m"]) + " m"),
        ("Recordings", ", ".join(m["recordings"])),
        ("Coarse localizers", ", ".join(m["coarse"])),
    ]
    if "total" in e["median_times_ms"]:
        about_map.append(("Median of a query", f"{e['median_times_ms']['total']:.1f} ms"))
    return f'<div class="columns">{_render_facts(rows)}{_render_facts(about_map)}</div>'


def render_quarters(quarters: Sequence[Any]) -> str:
    """Return `Evaluation.quarters`, or those of a certificate, as a section; nothing if empty."""
    if not quarters:
        return ""
    rows = [[escape(cell) for cell in quarter_cells(one)] for one in quarters]
    table = render_table(QUARTER_COLUMNS, rows, "tried", "Quarters of difficulty")
    return render_section("Where it is hard", _QUARTERS, table)


def explain_shares(evaluation: dict[str, Any]) -> str:
    """Return the definitions of the shares in one or two sentences."""
    false = (
        "A false accept is a pose for an out-of-map image, or a pose with an error of more than"
        f" {EvaluatedQuery.MAX_TRANSLATION:g} m or {EvaluatedQuery.MAX_ROTATION_DEG:g}°."
    )
    if not evaluation["num_queries"]:
        return false
    return "Shares are of all queries with a known pose, with or without a result. " + false


def _recording_cells(row: dict[str, Any], colours: Mapping[str, str], about: str) -> list[str]:
    if not about and row["num_elsewhere"] and not row["num_queries"]:
        about = "out-of-map images"
    colour = colours.get(row["name"])
    mark = f'<i style="background:{colour}"></i>' if colour else "<i></i>"
    name = f"{mark}<b>{escape(row['name'] or 'queries')}</b>"
    name += f"<span>{escape(about)}</span>" if about else ""
    localized = median = ""
    shares = ["", ""]
    if row["num_queries"]:
        localized = f"{row['num_localized']} of {row['num_queries']}"
        shares = [f"{100 * row['recall'][key]:.0f} %" for key in ("0.05m_5deg", "0.25m_2deg")]
    if row["num_localized"]:
        length = format_length(row["median_translation_m"])
        median = f"{length}, {row['median_rotation_deg']:.2f}°"
    false, num_images = row["false_accepts"], row["num_queries"] + row["num_elsewhere"]
    accepts = f'<span class="{"bad" if false else "good"}">{false}</span> of {num_images}'
    total = row["median_times_ms"].get("total")
    return [name, localized, median, *shares, accepts, "" if total is None else f"{total:.0f}"]


def _render_facts(rows: list[tuple[str, str]]) -> str:
    cells = (f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{''.join(cells)}</table>"
