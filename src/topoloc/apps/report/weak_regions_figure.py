"""How firmly each node of a map is held, from above, as SVG text."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from topoloc import NodeQuality, TopoMetricMap, WeakRegions
from topoloc.apps.report.figure_style import BAD, ERROR, GREY, MAX_MARKS, NODE, STYLE, svg_text
from topoloc.apps.report.map_figure import compute_plot_limits, find_horizontal_axes

# What a node is drawn as: by the worst that is true of it; a ring instead of a dot where nobody
# looks back.
_MARKS: dict[str | None, tuple[str, str, float, str]] = {
    None: ("o", "#2f6db5", 5.0, "held by the rest of the map"),
    "single_session": ("o", "#7fa7d6", 5.0, "seen by one session alone"),
    "few_landmarks": ("s", ERROR, 6.0, "few landmarks"),
    "not_held": ("D", BAD, 6.5, "not held by the rest of the map"),
}


def draw_weak_regions(weak: WeakRegions, topomap: TopoMetricMap) -> str:
    """Nodes by how they are held, a tick where each looks, and the edges; the world's axes that lie
    flat."""
    centres = np.array([node.world_from_cam.translation for node in weak.nodes])
    across, up, is_mirrored = find_horizontal_axes(
        centres, np.array([node.world_from_cam.rotation[:, 1] for node in weak.nodes])
    )
    axes_idx = [across, up]
    low, high = compute_plot_limits(centres[:, axes_idx])
    width, height = high - low
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 8.3 * height / width + 1.1), layout="constrained")
        axes = figure.add_subplot()
        _draw_edges(axes, weak.nodes, topomap, axes_idx, float(max(width, height)))
        handles = _draw_marks(axes, weak, axes_idx)
        axes.set(
            xlim=(low[0], high[0]),
            ylim=(low[1], high[1]),
            xlabel=f"{'xyz'[across]} (m)",
            ylabel=f"{'xyz'[up]} (m)",
            aspect="equal",
        )
        if is_mirrored:
            axes.invert_yaxis()
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=3,
            handletextpad=0.5,
            columnspacing=1.6,
        )
        return svg_text(figure, "how firmly the map is held")


def _draw_edges(
    axes: Axes,
    nodes: Sequence[NodeQuality],
    topomap: TopoMetricMap,
    axes_idx: list[int],
    span: float,
) -> None:
    many = len(nodes) > MAX_MARKS
    centres = np.array([node.world_from_cam.translation[axes_idx] for node in nodes])
    looks = centres + 0.03 * span * np.array(
        [node.world_from_cam.rotation[axes_idx, 2] for node in nodes]
    )
    edges = [
        (centres[topomap.row_of(edge.source_id)], centres[topomap.row_of(edge.target_id)])
        for edge in topomap.edges
    ]
    axes.add_collection(
        LineCollection(edges, colors=NODE, linewidths=0.7, alpha=0.6, rasterized=many)
    )
    axes.add_collection(
        LineCollection(
            list(np.stack([centres, looks], axis=1)), colors=NODE, linewidths=1.0, rasterized=many
        )
    )


def _draw_marks(axes: Axes, weak: WeakRegions, axes_idx: list[int]) -> list[Line2D]:
    """The nodes; returns the legend's handles, of what there is."""
    handles, many = list[Line2D](), len(weak.nodes) > MAX_MARKS
    for order, (reason, (marker, colour, size, label)) in enumerate(_MARKS.items()):
        of_mark = [node for node in weak.nodes if _worst_reason(node, weak) == reason]
        for is_ring in (False, True):
            drawn = [
                node.world_from_cam.translation[axes_idx]
                for node in of_mark
                if ("one_direction" in node.reasons) == is_ring
            ]
            if drawn:
                fill = "white" if is_ring else colour
                style = {
                    "color": colour,
                    "markerfacecolor": fill,
                    "markersize": size,
                    "markeredgewidth": 1.4,
                    "linestyle": "",
                }
                axes.plot(
                    *np.array(drawn).T, marker=marker, rasterized=many, zorder=3 + order, **style
                )
        if of_mark:
            handles.append(
                Line2D(
                    [], [], linestyle="", marker=marker, color=colour, markersize=size, label=label
                )
            )
    if weak.count("one_direction"):
        ring = {
            "markerfacecolor": "white",
            "color": GREY,
            "markersize": 5.0,
            "markeredgewidth": 1.4,
            "linestyle": "",
        }
        handles.append(Line2D([], [], marker="o", label="hollow: nobody looks back here", **ring))
    return handles


def _worst_reason(node: NodeQuality, weak: WeakRegions) -> str | None:
    """Of a map of one session, that only this one saw a node says nothing."""
    shown = [
        reason
        for reason in _MARKS
        if reason is not None and (reason != "single_session" or len(weak.session_names) > 1)
    ]
    return next((reason for reason in reversed(shown) if reason in node.reasons), None)
