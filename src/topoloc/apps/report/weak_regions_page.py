"""The weak regions of a map as one self-contained page."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from matplotlib.lines import Line2D

from topoloc import TopoMetricMap, WeakRegions
from topoloc.apps.report.map_figure import MapFigure
from topoloc.apps.report.page_template import (
    BAD,
    ERROR,
    GREY,
    render_cards,
    render_figure,
    render_gallery_items,
    render_page,
    render_section,
    render_table,
    render_wide,
)
from topoloc.plugin import write_text

REASON_TEXTS = {
    "not_held": "not localized by the rest of the map",
    "few_landmarks": "few landmarks",
    "one_direction": "no opposite view",
    "single_session": "one session only",
}
_METHOD = (
    "Each node is hidden and localized in the rest of the map, like a query. A node is weak if the"
    " rest of the map finds few inliers or no pose."
)
_MAP = "Seen from above. A tick shows the viewing direction of a node."
_WEAKEST = "The nodes with the fewest inliers in the rest of the map."
_MAX_REGIONS, _MAX_IMAGES = 20, 6
_COLUMNS = ("reason", "nodes", "around (m)", "first image", "last image")
# Marker, colour, size and label of a node by its most severe reason. A hollow marker has no
# opposite view.
_MARKS: dict[str | None, tuple[str, str, float, str]] = {
    None: ("o", "#2f6db5", 5.0, "localized by the rest of the map"),
    "single_session": ("o", "#7fa7d6", 5.0, "seen by one session only"),
    "few_landmarks": ("s", ERROR, 6.0, "few landmarks"),
    "not_held": ("D", BAD, 6.5, "not localized by the rest of the map"),
}


def write_weak_regions(
    path: Path, weak: WeakRegions, topomap: TopoMetricMap, info: dict[str, Any]
) -> None:
    """Write the page atomically. The same map gives the same bytes. `info`:
    `TopoMetricMap.describe` of the map. Raises TopolocError: the file cannot be written."""
    advice = f'<p class="lead">{escape(weak.suggest_next_recording())}</p>'
    figure = render_wide(draw_weak_regions(weak, topomap), "The map from above")
    images = _render_images(weak, topomap)
    sections = [
        _render_cards(weak),
        render_section("Where to record next", _METHOD, advice),
        render_section("The map from above", _MAP, figure),
        render_section("Weak regions", "", _render_regions(weak)),
        render_section("The weakest nodes", _WEAKEST, images),
    ]
    title = f"Weak regions of {Path(info['path']).name}"
    sessions = ", ".join(dict.fromkeys(weak.session_names.values()))
    write_text(path, render_page(title, f"Sessions: {sessions}", "\n".join(sections)))


def draw_weak_regions(weak: WeakRegions, topomap: TopoMetricMap) -> str:
    """Draw the nodes by their weakness and the edges of a map from above, as SVG text."""
    poses = [node.world_from_cam for node in weak.nodes]
    with MapFigure(poses, [], 1.1) as figure:
        figure.draw_nodes(topomap)
        return figure.to_svg("weak regions of the map", _draw_marks(figure, weak), 3)


def _draw_marks(figure: MapFigure, weak: WeakRegions) -> list[Line2D]:
    """Draw the nodes and return the handles of the legend."""
    handles = list[Line2D]()
    ring = {"linestyle": "", "markeredgewidth": 1.4, "markerfacecolor": "white"}
    for order, (reason, (marker, colour, size, label)) in enumerate(_MARKS.items()):
        style = {"marker": marker, "color": colour, "markersize": size, "linestyle": ""}
        marked = [node for node in weak.nodes if _worst_reason(node.reasons, weak) == reason]
        for is_ring in (False, True):
            drawn = [node for node in marked if ("one_direction" in node.reasons) == is_ring]
            poses, its_style = [node.world_from_cam for node in drawn], ring if is_ring else {}
            figure.plot(poses, zorder=3 + order, **style | its_style)
        if marked:
            handles.append(Line2D([], [], label=label, **style))
    if weak.count("one_direction"):
        style = ring | {"marker": "o", "color": GREY, "markersize": 5.0}
        handles.append(Line2D([], [], label="hollow: no opposite view", **style))
    return handles


def _worst_reason(reasons: Sequence[str], weak: WeakRegions) -> str | None:
    """Return the most severe reason. In a map of one session, `single_session` is no reason."""
    ignored = "single_session" if len(weak.session_names) < 2 else None
    shown = [reason for reason in reversed(_MARKS) if reason not in (None, ignored)]
    return next((reason for reason in shown if reason in reasons), None)


def _render_cards(weak: WeakRegions) -> str:
    num_queried = len(weak.queried_nodes)
    num_held = num_queried - weak.count("not_held")
    kind, held = "good" if num_held == num_queried else "bad", f"{num_held} of {num_queried}"
    texts: dict[Any, str] = {
        "few_landmarks": "nodes with few landmarks",
        "one_direction": f"of {len(weak.nodes)} nodes without an opposite view",
        "single_session": "nodes seen by one session only",
    }
    cards = [("", str(weak.count(reason)), text) for reason, text in texts.items()]
    return render_cards([(kind, held, "nodes localized by the rest of the map"), *cards])


def _render_regions(weak: WeakRegions) -> str:
    parts = weak.parts
    if not parts:
        return "<p>There are none.</p>"
    rows = [
        (
            REASON_TEXTS[part.reason],
            str(len(part.nodes)),
            ", ".join(f"{value:.1f}" for value in part.centre.round(1) + 0.0),
            escape(part.nodes[0].name),
            escape(part.nodes[-1].name),
        )
        for part in parts[:_MAX_REGIONS]
    ]
    num_hidden = len(parts) - len(rows)
    more = f"<p>{num_hidden} smaller ones are not shown.</p>" if num_hidden else ""
    return render_table(_COLUMNS, rows, label="Weak regions") + more


def _render_images(weak: WeakRegions, topomap: TopoMetricMap) -> str:
    items = list[tuple[str, str]]()
    for node in weak.weakest[:_MAX_IMAGES]:
        image = topomap.nodes[topomap.row_of(node.node_id)].template_image
        outcome = "not localized without itself"
        if node.answer is not None and node.answer.is_wrong:
            outcome = "wrong pose without itself"
        elif node.answer is not None and node.answer.is_localized:
            outcome = f"{node.answer.num_inliers} inliers without itself"
        reasons = ", ".join(REASON_TEXTS[reason] for reason in node.reasons) or "not weak"
        facts = f"<b>{outcome}, {node.num_landmarks} landmarks</b><p>{reasons}</p>"
        items.append((render_figure(image, f"node {node.node_id}, {node.name}"), facts))
    return render_gallery_items(items) if items else "<p>No node was tested.</p>"
