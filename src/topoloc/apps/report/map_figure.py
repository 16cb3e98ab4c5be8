"""The map from above as SVG text: its nodes, and where the queries were and were found."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from topoloc import EvaluatedQuery, Localization, NotLocalized, TopoMetricMap
from topoloc.apps.report.figure_style import (
    BAD,
    ERROR,
    GREY,
    MAX_MARKS,
    NODE,
    STYLE,
    recording_colours,
    svg_text,
)
from topoloc.plugin import group_by_recording

# Height over width of the map.
MIN_ASPECT, MAX_ASPECT = 0.3, 0.8
# A step so many times the recording's median step is a gap, over which no path is drawn.
GAP_STEPS = 6.0


def draw_map(answers: Sequence[EvaluatedQuery], topomap: TopoMetricMap) -> str:
    """The map from above, its longer side across: nodes, true paths and estimated positions, a line
    from one to the other.

    Each recording has its colour. The world's two axes that lie flat are drawn, whichever of the
    three is up.
    """
    with_truth = [a for a in answers if a.world_from_cam is not None]
    centres = np.array([s.world_from_cam.translation for s in topomap.summaries])
    truths = [a.world_from_cam.translation for a in with_truth if a.world_from_cam is not None]
    known = np.concatenate([centres, np.array(truths).reshape(-1, 3)])
    across, up, is_mirrored = find_horizontal_axes(
        known, np.array([s.world_from_cam.rotation[:, 1] for s in topomap.summaries])
    )
    axes_idx = [across, up]
    low, high = compute_plot_limits(known[:, axes_idx])
    width, height = high - low
    groups = group_by_recording(with_truth)
    colours = recording_colours(list(groups))
    with matplotlib.rc_context(STYLE):
        figure = Figure(
            figsize=(9.0, 8.3 * height / width + 0.9 + 0.2 * (len(groups) // 2)),
            layout="constrained",
        )
        axes = figure.add_subplot()
        _draw_nodes(axes, topomap, axes_idx, float(max(width, height)))
        for name, group in groups.items():
            _draw_recording(axes, group, axes_idx, colours[name])
        _draw_errors(axes, with_truth, axes_idx)
        num_outside = _draw_false_accepts(axes, answers, axes_idx, low, high)
        axes.set(
            xlim=(low[0], high[0]),
            ylim=(low[1], high[1]),
            xlabel=f"{'xyz'[across]} (m)",
            ylabel=f"{'xyz'[up]} (m)",
            aspect="equal",
        )
        if is_mirrored:
            axes.invert_yaxis()
        if num_outside:
            axes.set_title(
                f"{num_outside} false position{'s' if num_outside > 1 else ''} outside of the"
                " picture",
                color=BAD,
            )
        figure.legend(
            handles=_draw_legend(answers, colours),
            loc="outside lower center",
            ncols=5,
            handletextpad=0.5,
            columnspacing=1.6,
        )
        return svg_text(figure, "map from above")


def find_horizontal_axes(
    points: Float[np.ndarray, "n 3"], downs: Float[np.ndarray, "m 3"]
) -> tuple[int, int, bool]:
    """The world's axes to draw across and up, and whether the latter must point down so that the
    map is not seen from below.

    The vertical is the axis that the cameras' y agrees on; where they agree on none, that of least
    extent.
    """
    down = downs.mean(axis=0)
    extent = np.ptp(points, axis=0)
    vertical = int(np.argmax(np.abs(down))) if np.abs(down).max() > 0.7 else int(np.argmin(extent))
    across, up = sorted(
        (axis for axis in range(3) if axis != vertical), key=lambda axis: -extent[axis]
    )
    towards_viewer = np.cross(np.eye(3)[across], np.eye(3)[up])
    return across, up, bool(towards_viewer @ down > 0)


def compute_plot_limits(
    points: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """(low, high) corners around all points, with a margin, neither very flat nor very high."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low + 0.12 * max(float((high - low).max()), 0.1)
    size = np.maximum(size, [size[1] / MAX_ASPECT, size[0] * MIN_ASPECT])
    return (low + high - size) / 2, (low + high + size) / 2


def _draw_nodes(axes: Axes, topomap: TopoMetricMap, axes_idx: list[int], span: float) -> None:
    """Nodes as dots with a tick in the direction they look, edges as lines."""
    poses = [s.world_from_cam for s in topomap.summaries]
    centres = np.array([p.translation[axes_idx] for p in poses])
    looks = centres + 0.022 * span * np.array([p.rotation[axes_idx, 2] for p in poses])
    many = len(poses) > MAX_MARKS
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
    axes.plot(*centres.T, "o", color=NODE, markersize=5, rasterized=many)


def _draw_recording(
    axes: Axes, answers: Sequence[EvaluatedQuery], axes_idx: list[int], colour: str
) -> None:
    """The true path as a line with a ring at each query, estimated positions as dots, diamonds
    where there is no estimate."""
    many = len(answers) > MAX_MARKS
    truths = np.array(
        [a.world_from_cam.translation[axes_idx] for a in answers if a.world_from_cam is not None]
    )
    axes.plot(
        *_insert_gaps(truths).T, "-", color=colour, linewidth=1.0, alpha=0.45, rasterized=many
    )
    axes.plot(
        *truths.T,
        "o",
        markerfacecolor="none",
        color=colour,
        markersize=4.5,
        markeredgewidth=0.6,
        rasterized=many,
    )
    found = [
        a.result.world_from_cam.translation[axes_idx]
        for a in answers
        if isinstance(a.result, Localization) and not a.is_false_accept
    ]
    if found:
        axes.plot(*np.array(found).T, ".", color=colour, markersize=5, rasterized=many, zorder=4)
    lost = truths[[isinstance(a.result, NotLocalized) for a in answers]]
    if len(lost):
        axes.plot(
            *lost.T,
            "D",
            markerfacecolor="white",
            color=colour,
            markersize=5.5,
            markeredgewidth=1.3,
            rasterized=many,
            zorder=5,
        )


def _draw_legend(answers: Sequence[EvaluatedQuery], colours: dict[str, str]) -> list[Line2D]:
    """Recordings by colour, where there are several; marks by shape."""
    names = colours if len(colours) > 1 else {}
    handles = [
        Line2D([], [], color=colour, marker="o", markersize=5, linewidth=1.0, label=name)
        for name, colour in names.items()
    ]
    single = GREY if names else next(iter(colours.values()), GREY)
    handles.append(
        Line2D([], [], linestyle="", marker="o", color=NODE, markersize=5, label="node of the map")
    )
    if colours:
        handles.append(
            Line2D(
                [],
                [],
                marker="o",
                markerfacecolor="none",
                color=single,
                markersize=4.5,
                linewidth=1.0,
                label="true path",
            )
        )
    if any(a.result.localized and a.world_from_cam is not None for a in answers):
        handles.append(
            Line2D([], [], linestyle="", marker=".", color=single, markersize=6, label="estimated")
        )
        handles.append(Line2D([], [], color=ERROR, linewidth=1.2, label="error"))
    if any(not a.result.localized and a.world_from_cam is not None for a in answers):
        handles.append(
            Line2D(
                [],
                [],
                linestyle="",
                marker="D",
                markerfacecolor="white",
                color=single,
                markersize=5.5,
                label="not localized",
            )
        )
    if any(a.is_false_accept for a in answers):
        handles.append(
            Line2D(
                [],
                [],
                linestyle="",
                marker="x",
                color=BAD,
                markersize=7,
                markeredgewidth=1.6,
                label="false position",
            )
        )
    return handles


def _insert_gaps(path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """The path with a row of NaN wherever the next position is far off: no line is drawn there."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    if len(steps) == 0:
        return path
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps))
    return np.insert(path, gaps + 1, np.nan, axis=0)


def _draw_errors(axes: Axes, answers: Sequence[EvaluatedQuery], axes_idx: list[int]) -> None:
    pairs = [
        (a.world_from_cam.translation[axes_idx], a.result.world_from_cam.translation[axes_idx])
        for a in answers
        if a.world_from_cam is not None and isinstance(a.result, Localization)
    ]
    if pairs:
        many = len(pairs) > MAX_MARKS
        axes.add_collection(
            LineCollection(pairs, colors=ERROR, linewidths=1.2, rasterized=many, zorder=3)
        )


def _draw_false_accepts(
    axes: Axes,
    answers: Sequence[EvaluatedQuery],
    axes_idx: list[int],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
) -> int:
    """False positions as crosses. Returns how many lie outside of the picture."""
    rows = [
        a.result.world_from_cam.translation[axes_idx]
        for a in answers
        if isinstance(a.result, Localization) and a.is_false_accept
    ]
    false = np.array(rows).reshape(-1, 2)
    inside = ((false >= low) & (false <= high)).all(axis=1)
    if len(false):
        axes.plot(*false[inside].T, "x", color=BAD, markersize=7, markeredgewidth=1.6, zorder=5)
    return int((~inside).sum())
