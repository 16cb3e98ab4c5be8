"""The numbers of a report as HTML: the headline cards, a row for each recording, and all the
rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

from topoloc import EvaluatedQuery
from topoloc.apps.report.figure_style import recording_colours
from topoloc.plugin import format_length

_COLUMNS = ("localized", "median error", "in 5 cm, 5°", "in 25 cm, 2°", "false accepts", "ms")


@dataclass(frozen=True)
class PublishedResult:
    """A figure from elsewhere to stand below one's own: median errors in metres and degrees."""

    name: str
    median_translation_m: float
    median_rotation_deg: float


@dataclass(frozen=True)
class ReportTexts:
    """What a page says beside its numbers.

    `about` says of recordings what they are. `paragraphs` stand between the headline numbers and
    the figures.
    """

    title: str = ""
    subtitle: str = ""
    paragraphs: Sequence[str] = ()
    about: Mapping[str, str] = field(default_factory=dict)
    published: Sequence[PublishedResult] = ()


def render_headline_cards(evaluation: dict[str, Any]) -> str:
    """The headline: of the first recording with truth where there are several, since a mean over
    easy and hard ones says nothing."""
    rows = [row for row in evaluation["recordings"] if row["num_queries"]]
    e = rows[0] if len(rows) > 1 else evaluation
    of = f", {escape(e['name'])}" if len(rows) > 1 else ""
    shown = []
    if e["num_queries"]:
        share = 100 * e["num_localized"] / e["num_queries"]
        shown.append(
            (
                "",
                f"{share:.1f} %",
                f"localized, {e['num_localized']} of {e['num_queries']} queries{of}",
            )
        )
    if e["num_localized"]:
        shown.append(("", format_length(e["median_translation_m"]), f"median position error{of}"))
        shown.append(("", f"{e['median_rotation_deg']:.2f}°", f"median rotation error{of}"))
    if len(rows) > 1:
        hardest = min(rows[1:], key=lambda row: row["num_localized"] / row["num_queries"])
        share = 100 * hardest["num_localized"] / hardest["num_queries"]
        shown.append(
            (
                "",
                f"{share:.1f} %",
                f"localized, {escape(hardest['name'])}, the hardest of the others",
            )
        )
    if not e["num_queries"]:
        shown.append(("", str(e["num_elsewhere"]), "images from elsewhere"))
    false = evaluation["false_accepts"]
    num_asked = evaluation["num_queries"] + evaluation["num_elsewhere"]
    shown.append(
        (
            "bad" if false else "good",
            str(false),
            f"false accept{'' if false == 1 else 's'}, of {num_asked} images",
        )
    )
    if "total" in evaluation["median_times_ms"]:
        shown.append(("", f"{evaluation['median_times_ms']['total']:.0f} ms", "a query, median"))
    inner = "".join(
        f'<div class="card {kind}"><b>{value}</b><span>{text}</span></div>'
        for kind, value, text in shown
    )
    return f'<div class="cards">{inner}</div>'


def render_recordings_table(evaluation: dict[str, Any], texts: ReportTexts) -> str:
    """A row for each recording, and below them what others published."""
    names = [row["name"] for row in evaluation["recordings"] if row["num_queries"]]
    colours = recording_colours(names)
    head = "".join(f"<th>{column}</th>" for column in ("recording", *_COLUMNS))
    body = "".join(
        _render_recording_row(row, colours, texts.about.get(row["name"], ""))
        for row in evaluation["recordings"]
    )
    for other in texts.published:
        median = f"{format_length(other.median_translation_m)}, {other.median_rotation_deg:.2f}°"
        body += f'<tr class="published"><td>{escape(other.name)}</td>{_render_cells(["", median, "", "", "", ""])}</tr>'  # noqa: E501
    return (
        '<div class="wide"><table class="recordings'
        f' folds"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def render_number_tables(evaluation: dict[str, Any]) -> str:
    """All of the evaluation in two columns: the queries, the map."""
    e, m = evaluation, evaluation["map"]
    rows = (
        [("Queries with truth", f"{e['num_queries']}, localized {e['num_localized']}")]
        if e["num_queries"]
        else []
    )
    for name, share in e["recall"].items():
        if share is not None:
            metres, degrees = name.removesuffix("deg").split("m_")
            rows.append(
                (
                    f"Within {format_length(float(metres), digits=0)} and {degrees}°",
                    f"{100 * share:.1f} % of all queries",
                )
            )
    if e["topological_accuracy"] is not None:
        rows.append(("Nearest node named first", f"{100 * e['topological_accuracy']:.1f} %"))
    if e["num_elsewhere"]:
        rows.append(("Images from elsewhere", str(e["num_elsewhere"])))
    rows.append(("False accepts", str(e["false_accepts"])))
    reasons = [
        f"{count} {reason.replace('_', ' ')}" for reason, count in e["not_localized"].items()
    ]
    rows.append(("Not localized, why", ", ".join(reasons) or "none"))
    about_map = [
        ("Map", f"{m['num_nodes']} nodes, {m['num_points']:,} points"),
        ("Size", f"{m['bytes'] / 1e6:.2f} MB"),
        ("Mapped", f"{m['length_m']:.1f} m of trajectory"),
        ("Extent", " × ".join(f"{extent:.1f}" for extent in m["extent_m"]) + " m"),
        ("From", ", ".join(m["recordings"])),
        ("Coarse localizers", ", ".join(m["coarse"])),
    ]
    about_map += (
        [("Median of a query", f"{e['median_times_ms']['total']:.1f} ms")]
        if "total" in e["median_times_ms"]
        else []
    )
    return f'<div class="columns">{_render_facts(rows)}{_render_facts(about_map)}</div>'


def explain_shares(evaluation: dict[str, Any]) -> str:
    """One sentence or two on how the shares are to be read."""
    false = (
        "A false accept is a pose for an image from elsewhere, or one off by more than"
        f" {EvaluatedQuery.MAX_TRANSLATION:g} m or {EvaluatedQuery.MAX_ROTATION_DEG:g}°."
    )
    if not evaluation["num_queries"]:
        return false
    return (
        "Shares are of all queries with a known pose: one that got none counts as a miss. " + false
    )


def _render_recording_row(row: dict[str, Any], colours: Mapping[str, str], about: str) -> str:
    about = about or (
        "images from elsewhere" if row["num_elsewhere"] and not row["num_queries"] else ""
    )
    name = f"<b>{escape(row['name'] or 'queries')}</b>" + (
        f"<span>{escape(about)}</span>" if about else ""
    )
    mark = (
        f'<i style="background:{colours[row["name"]]}"></i>'
        if row["name"] in colours
        else "<i></i>"
    )
    false, num_asked = row["false_accepts"], row["num_queries"] + row["num_elsewhere"]
    cells = ["" for _ in range(4)]
    if row["num_queries"]:
        cells[0] = f"{row['num_localized']} of {row['num_queries']}"
        cells[2], cells[3] = (
            f"{100 * row['recall'][key]:.0f} %" for key in ("0.05m_5deg", "0.25m_2deg")
        )
    if row["num_localized"]:
        cells[1] = (
            f"{format_length(row['median_translation_m'])}, {row['median_rotation_deg']:.2f}°"
        )
    cells.append(f'<span class="{"bad" if false else "good"}">{false}</span> of {num_asked}')
    cells.append(
        f"{row['median_times_ms']['total']:.0f}" if "total" in row["median_times_ms"] else ""
    )
    return f"<tr><td>{mark}{name}</td>{_render_cells(cells)}</tr>"


def _render_cells(cells: Sequence[str]) -> str:
    """With their columns' names, which stand beside them where the screen is too narrow for
    columns."""
    return "".join(
        f'<td data-column="{column}">{cell}</td>'
        for column, cell in zip(_COLUMNS, cells, strict=True)
    )


def _render_facts(rows: list[tuple[str, str]]) -> str:
    return (
        "<table>"
        + "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows
        )
        + "</table>"
    )
