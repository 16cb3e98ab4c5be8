"""The certificate of a map as one self-contained page."""

from __future__ import annotations

from html import escape
from pathlib import Path

from topoloc import Certification, TopoMetricMap
from topoloc.apps.quality.certificate_texts import describe_group, describe_limits
from topoloc.apps.report.map_figure import draw_map
from topoloc.apps.report.page_template import (
    render_cards,
    render_page,
    render_section,
    render_table,
    render_wide,
)
from topoloc.apps.report.report_tables import render_quarters
from topoloc.plugin import write_text

_COLUMNS = (
    "images",
    "localized",
    "wrong",
    "independent, wrong",
    "at most wrong",
    "inside 95 %",
    "answer, refusal (ms)",
)
_FIGURES = (
    "An answer is wrong beyond 0.25 m or 2 degrees. Images of one piece of the walk are not"
    " independent, so pieces are counted. A piece is wrong if any of its answers is."
)
_GROUPS = (
    "Images of the walks alone, by the angle to the nearest mapped frame and by light (the largest"
    " ratio of their mean grey levels and colours). Each promise has 95 % confidence for itself. No"
    " threshold of a group is applied."
)
_PLAN = "Walks with known poses. Blind spots are pieces of which no image was localized."


def write_certificate(path: Path, found: Certification, topomap: TopoMetricMap, name: str) -> None:
    """Write the page atomically. Raises TopolocError: the file cannot be written."""
    one = found.certificate
    lead = f'<p class="lead">{escape(one.promise()[:1].upper() + one.promise()[1:])}.</p>'
    limits = f"<p>Threshold: {escape(one.describe_threshold())}.</p>"
    limits += f"<p>Limits: {escape(describe_limits(one))}.</p>"
    sections = [
        _render_cards(found),
        render_section("The promise", "", lead + limits),
        render_section("What was measured", _FIGURES, _render_conditions(found)),
    ]
    if one.groups:
        rows = [tuple(map(escape, describe_group(group))) for group in one.groups]
        table = render_table(("group", "promise"), rows, "tried", "Groups")
        sections.append(render_section("Promises for groups", _GROUPS, table))
    sections.append(render_quarters(one.quarters))
    walks = [
        answer
        for condition in found.conditions
        if condition.kind == "walk" and condition.has_truth
        for answer in condition.answers
    ]
    if walks:
        figure = render_wide(draw_map(walks, topomap), "The map from above")
        sections.append(render_section("The map from above", _PLAN + _list_spots(found), figure))
    sections.append(render_section("Measured with", "", _render_facts(found)))
    subtitle = f"{one.date}, topoloc {one.program}, version {one.map_version} of the map"
    page = render_page(f"Certificate of {name}", subtitle, "\n".join(sections))
    write_text(path, page)


def _render_cards(found: Certification) -> str:
    one = found.certificate
    share, threshold = one.max_wrong_share, one.min_probability
    state, loses = ("applied", "lost") if one.is_applied else ("not applied", "would be lost")
    kept = share is not None and share <= one.requested_share
    cards = [
        (
            "good" if kept else "bad",
            "none" if share is None else f"{100 * share:.2g} %",
            "at most wrong",
        ),
        ("", "none" if threshold is None else f"{threshold:.3g}", f"threshold, {state}"),
        ("", f"{100 * one.lost_share:.1f} %", f"of the right answers {loses} by it"),
        ("", str(len(found.blind_spots)), "blind spots"),
    ]
    return render_cards(cards)


def _render_conditions(found: Certification) -> str:
    rows = []
    for one in found.certificate.conditions:
        times = (one.answer_ms, one.refusal_ms)
        is_known = one.max_wrong_share is not None
        has_inside = one.kind == "walk" and one.has_truth
        rows.append(
            (
                escape(one.name),
                f"{one.num_localized} of {one.num_images}",
                str(one.num_wrong) if is_known else "unknown",
                f"{one.num_pieces}, {one.num_wrong_pieces}" if is_known else str(one.num_pieces),
                f"{100 * (one.max_wrong_share or 0.0):.2g} %" if is_known else "unknown",
                f"{one.num_inside} of {one.num_localized - one.num_wrong}" if has_inside else "",
                ", ".join("none" if ms is None else f"{ms:.0f}" for ms in times),
            )
        )
    return render_table(_COLUMNS, rows, "tried", "Conditions")


def _list_spots(found: Certification) -> str:
    spots = [pose.translation for pose in found.blind_spots]
    texts = [f"({x:.1f}, {y:.1f}, {z:.1f})" for x, y, z in spots[:20]]
    more = " ..." if len(spots) > len(texts) else ""
    return (
        f" There are {len(spots)}: {', '.join(texts)}{more} (m)." if spots else " There are none."
    )


def _render_facts(found: Certification) -> str:
    one = found.certificate
    facts = {
        "cameras": "; ".join(one.cameras),
        "settings": ", ".join(f"{name} = {value}" for name, value in one.settings.items()),
        "confidence": f"{100 * one.confidence:g} %",
        "threshold": one.describe_threshold(),
    }
    rows = [(name, escape(text or "default")) for name, text in facts.items()]
    return render_table(("", "value"), rows)
