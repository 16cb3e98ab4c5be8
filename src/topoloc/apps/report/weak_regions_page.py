"""How firmly a map is held as one self-contained page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from topoloc import NodeQuality, TopoMetricMap, WeakRegion, WeakRegions
from topoloc.apps.report.page_template import render_page
from topoloc.apps.report.weak_regions_figure import draw_weak_regions
from topoloc.plugin import write_text

REASON_TEXTS = {
    "not_held": "not held by the rest of the map",
    "few_landmarks": "few landmarks",
    "one_direction": "nobody looks back",
    "single_session": "one session alone",
}
_METHOD_TEXT = (
    "Each node is asked of the rest of the map as a picture would be, as if nobody had stood there:"
    " it cannot be found by itself. What the rest localizes with few inliers, or not at all, is"
    " weakly held."
)
_MAP = "Seen from above. A tick shows where a node looks."
_WEAKEST = "The nodes that the rest of the map holds least, by the inliers that it finds in them."
_MAX_REGIONS, _MAX_IMAGES = 20, 6
_COLUMNS = ("why", "nodes", "around (m)", "first picture", "last picture")


def write_weak_regions(
    path: Path, weak: WeakRegions, topomap: TopoMetricMap, info: dict[str, Any]
) -> None:
    """Write the page, at once or not at all; the same map gives the same bytes.

    Args:
        info: what `topoloc info` says of the map.

    Raises:
        TopolocError: the file cannot be written.
    """
    body = "\n".join(
        [
            _render_cards(weak),
            _render_section(
                "Where to walk next",
                _METHOD_TEXT,
                f'<p class="lead">{escape(weak.suggest_next_recording())}</p>',
            ),
            _render_section(
                "The map from above",
                _MAP,
                f'<div class="wide">{draw_weak_regions(weak, topomap)}</div>',
            ),
            _render_section("Weak parts", "", _render_regions_table(weak.parts)),
            _render_section(
                "The weakest nodes", _WEAKEST, _render_images(weak.weakest[:_MAX_IMAGES], topomap)
            ),
        ]
    )
    sessions = ", ".join(dict.fromkeys(weak.session_names.values()))
    write_text(
        path, render_page(f"How firmly {Path(info['path']).name} is held", f"Of {sessions}", body)
    )


def _render_cards(weak: WeakRegions) -> str:
    num_held = len(weak.queried_nodes) - weak.count("not_held")
    shown = [
        (
            "good" if num_held == len(weak.queried_nodes) else "bad",
            f"{num_held} of {len(weak.queried_nodes)}",
            "nodes held by the rest of the map",
        )
    ]
    shown.append(("", str(weak.count("few_landmarks")), "nodes of few landmarks"))
    shown.append(
        (
            "",
            str(weak.count("one_direction")),
            f"of {len(weak.nodes)} nodes where nobody looks back",
        )
    )
    shown.append(("", str(weak.count("single_session")), "nodes seen by one session alone"))
    inner = "".join(
        f'<div class="card {kind}"><b>{value}</b><span>{text}</span></div>'
        for kind, value, text in shown
    )
    return f'<div class="cards">{inner}</div>'


def _render_regions_table(parts: Sequence[WeakRegion]) -> str:
    if not parts:
        return "<p>There are none.</p>"
    body = "".join(_render_region_row(part) for part in parts[:_MAX_REGIONS])
    more = (
        f"<p>{len(parts) - _MAX_REGIONS} smaller ones are not shown.</p>"
        if len(parts) > _MAX_REGIONS
        else ""
    )
    head = "".join(f"<th>{name}</th>" for name in _COLUMNS)
    table = f'<table class="folds"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="Weak parts">{table}</div>{more}'
    )


def _render_region_row(part: WeakRegion) -> str:
    around = ", ".join(f"{value:.1f}" for value in part.centre.round(1) + 0.0)
    cells = (
        REASON_TEXTS[part.reason],
        str(len(part.nodes)),
        around,
        part.nodes[0].name,
        part.nodes[-1].name,
    )
    return (
        "<tr>"
        + "".join(
            f'<td data-column="{name}">{escape(cell)}</td>'
            for name, cell in zip(_COLUMNS, cells, strict=True)
        )
        + "</tr>"
    )


def _render_images(nodes: Sequence[NodeQuality], topomap: TopoMetricMap) -> str:
    if not nodes:
        return "<p>None was asked.</p>"
    return (
        '<div class="queries">' + "".join(_render_image(node, topomap) for node in nodes) + "</div>"
    )


def _render_image(node: NodeQuality, topomap: TopoMetricMap) -> str:
    assert node.answer is not None, "it was asked"
    data = base64.b64encode(topomap.nodes[topomap.row_of(node.node_id)].template_jpeg).decode(
        "ascii"
    )
    caption = escape(f"node {node.node_id}, {node.name}")
    said = (
        f"{node.answer.num_inliers} inliers without itself"
        if node.answer.is_localized
        else "not localized without itself"
    )
    if node.answer.is_wrong:
        said = "found elsewhere without itself"
    why = ", ".join(REASON_TEXTS[reason] for reason in node.reasons) or "not weak"
    facts = f'<div class="facts"><b>{said}, {node.num_landmarks} landmarks</b><p>{why}</p></div>'
    picture = (
        f'<figure><img alt="{caption}"'
        f' src="data:image/jpeg;base64,{data}"><figcaption>{caption}</figcaption></figure>'
    )
    return f"<article>{picture}{facts}</article>"


def _render_section(title: str, explanation: str, content: str) -> str:
    return (
        f"<section><h2>{title}</h2>"
        + (f"<p>{explanation}</p>" if explanation else "")
        + f"{content}</section>"
    )
