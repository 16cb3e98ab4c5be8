"""The figures of a report, each as SVG text that can stand inside a page.

Drawn with matplotlib's figures directly, not through pyplot: nothing global is touched, and the same answers give the same bytes.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, PercentFormatter

from topoloc.evaluation.metrics import Answer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap

INK, GREY, NODE, TRUTH, ESTIMATE, ERROR, BAD = "#1f2a37", "#6b7786", "#9db2ca", "#1f2a37", "#0f8b8d", "#f0a202", "#d1345b"
STAGES = ("patch_normalization", "features", "coarse", "matching", "pnp")
# Beyond so many marks a figure's points become one picture inside it: a page must stay small whatever the number of queries.
MAX_MARKS = 2000
# Height over width of the map.
MIN_ASPECT, MAX_ASPECT = 0.3, 0.8
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": GREY,
    "axes.edgecolor": "#cfd6de",
    "axes.grid": True,
    "grid.color": "#eef1f4",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
}


def draw_map(answers: Sequence[Answer], topomap: TopoMetricMap) -> str:
    """The map from above, its longer side across: nodes, true and estimated positions, a line from one to the other."""
    centres = np.array([s.world_from_cam.translation for s in topomap.summaries])
    truths = [a.world_from_cam.translation for a in answers if a.world_from_cam is not None]
    known = np.concatenate([centres, np.array(truths).reshape(-1, 3)])
    across, up, is_mirrored = _horizontal_axes(known, np.array([s.world_from_cam.rotation[:, 1] for s in topomap.summaries]))
    axes_idx = [across, up]
    low, high = _frame(known[:, axes_idx])
    width, height = high - low
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(9.0, 8.3 * height / width + 0.9), layout="constrained")
        axes = figure.add_subplot()
        _draw_nodes(axes, topomap, axes_idx, float(max(width, height)))
        num_outside = _draw_positions(axes, answers, axes_idx, low, high)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal")
        if is_mirrored:
            axes.invert_yaxis()
        if num_outside:
            axes.set_title(f"{num_outside} false position{'s' if num_outside > 1 else ''} outside of the picture", color=BAD)
        figure.legend(loc="outside lower center", ncols=6, handletextpad=0.4, columnspacing=1.6)
        return _svg(figure, "map from above")


def draw_error_curves(answers: Sequence[Answer]) -> str:
    """Which share of all queries with truth is within a given error: translation and rotation."""
    with_truth = [a for a in answers if a.world_from_cam is not None]
    metres = max((a.translation_m for a in with_truth if a.result.localized), default=0.0) > 2.0
    scale, unit = (1.0, " m") if metres else (100.0, " cm")
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(9.0, 2.9), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        _draw_curve(left, scale * np.array([a.translation_m for a in with_truth]), f"translation error ({unit.strip()})", unit)
        _draw_curve(right, np.array([a.rotation_deg for a in with_truth]), "rotation error (degrees)", "°")
        left.set(ylim=(0.0, 1.03), ylabel="queries within this error")
        left.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
        return _svg(figure, "cumulative error curves")


def draw_errors_along(answers: Sequence[Answer]) -> str:
    """The errors of query after query; those without a pose are marked at the top."""
    with_truth = [a for a in answers if a.world_from_cam is not None]
    numbers = np.arange(len(with_truth))
    lost = np.array([isinstance(a.result, NotLocalized) for a in with_truth])
    starts = [i for i, (a, b) in enumerate(pairwise(with_truth), 1) if a.recording != b.recording]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(9.0, 3.9), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        curves = (
            ("translation", [a.translation_m for a in with_truth], _length),
            ("rotation", [a.rotation_deg for a in with_truth], _angle),
        )
        for axes, (title, errors, label) in zip(panels, curves, strict=True):
            values = np.maximum(np.array(errors), 1e-5)
            axes.set_yscale("log")
            axes.plot(numbers, values, "-", color=ESTIMATE, linewidth=0.8, alpha=0.5)
            axes.plot(numbers, values, ".", color=ESTIMATE, markersize=4, rasterized=len(numbers) > MAX_MARKS)
            axes.set_ylim(*_decades(values))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _, label=label: label(value)))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_title(f"{title} error")
            for start in starts:
                axes.axvline(start - 0.5, color=GREY, linewidth=0.8, linestyle=":")
            if lost.any():  # an empty line, not clipped, would upset the layout
                marks = numbers[lost]
                axes.plot(marks, np.ones(len(marks)), "|", color=BAD, transform=axes.get_xaxis_transform(), clip_on=False, markersize=8)
        panels[-1].set(xlabel="query" + (" (red marks: no pose)" if lost.any() else ""), xlim=(-0.5, max(len(numbers) - 0.5, 0.5)))
        return _svg(figure, "errors along the sequence")


def draw_stage_times(answers: Sequence[Answer]) -> str:
    """Milliseconds of each stage: the median as a bar, a line up to what 95 % of the queries stay below."""
    names = {stage for a in answers for stage in a.result.times_ms}
    stages = [stage for stage in STAGES if stage in names] + sorted(names - {*STAGES, "total"}) + [s for s in ("total",) if s in names]
    times = [np.array([a.result.times_ms.get(stage, 0.0) for a in answers]) for stage in stages]
    medians, highs = [float(np.median(t)) for t in times], [float(np.percentile(t, 95)) for t in times]
    rows = np.arange(len(stages))[::-1]
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(9.0, 0.6 + 0.32 * len(stages)), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(visible=False, axis="y")
        axes.barh(rows, medians, height=0.55, color=[INK if stage == "total" else ESTIMATE for stage in stages])
        axes.hlines(rows, medians, highs, color=GREY, linewidth=1.2)
        for row, median, high in zip(rows, medians, highs, strict=True):
            axes.annotate(
                f"{median:.1f} (95 %: {high:.0f})",
                (max(median, high), row),
                xytext=(6, 0),
                textcoords="offset points",
                va="center",
                color=INK,
            )
        axes.set_yticks(rows, [stage.replace("_", " ") for stage in stages])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set(xlabel="ms a query", xlim=(0.0, 1.15 * max([*highs, *medians, 1e-3])))
        return _svg(figure, "times of the stages")


def _horizontal_axes(points: Float[np.ndarray, "n 3"], downs: Float[np.ndarray, "m 3"]) -> tuple[int, int, bool]:
    """The world's axes to draw across and up, and whether the latter must point down so that the map is not seen from below.

    The vertical is the axis that the cameras' y agrees on; where they agree on none, that of least extent.
    """
    down = downs.mean(axis=0)
    extent = np.ptp(points, axis=0)
    vertical = int(np.argmax(np.abs(down))) if np.abs(down).max() > 0.7 else int(np.argmin(extent))
    across, up = sorted((axis for axis in range(3) if axis != vertical), key=lambda axis: -extent[axis])
    towards_viewer = np.cross(np.eye(3)[across], np.eye(3)[up])
    return across, up, bool(towards_viewer @ down > 0)


def _frame(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
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
    edges = [(centres[edge.source_id], centres[edge.target_id]) for edge in topomap.edges]
    axes.add_collection(LineCollection(edges, colors=NODE, linewidths=0.7, alpha=0.6, rasterized=many))
    axes.add_collection(LineCollection(list(np.stack([centres, looks], axis=1)), colors=NODE, linewidths=1.0, rasterized=many))
    axes.plot(*centres.T, "o", color=NODE, markersize=5, label="node of the map", rasterized=many)


def _draw_positions(
    axes: Axes, answers: Sequence[Answer], axes_idx: list[int], low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> int:
    """True and estimated positions. Returns how many false ones lie outside of the picture."""
    good = [a for a in answers if isinstance(a.result, Localization) and not a.is_false_accept]
    false = np.array(
        [a.result.world_from_cam.translation[axes_idx] for a in answers if isinstance(a.result, Localization) and a.is_false_accept]
    )
    false = false.reshape(-1, 2)
    lost = [a.world_from_cam.translation for a in answers if a.world_from_cam is not None and isinstance(a.result, NotLocalized)]
    many = len(answers) > MAX_MARKS
    pairs = [
        (a.world_from_cam.translation[axes_idx], a.result.world_from_cam.translation[axes_idx])
        for a in answers
        if a.world_from_cam is not None and isinstance(a.result, Localization)
    ]
    if pairs:
        axes.add_collection(LineCollection(pairs, colors=ERROR, linewidths=1.2, label="error", rasterized=many, zorder=3))
    if good:
        truths = np.array([a.world_from_cam.translation[axes_idx] for a in good if a.world_from_cam is not None])
        found = np.array([a.result.world_from_cam.translation[axes_idx] for a in good if isinstance(a.result, Localization)])
        axes.plot(
            *truths.T, "o", markerfacecolor="none", color=TRUTH, markersize=4.5, markeredgewidth=0.7, label="true position", rasterized=many
        )
        axes.plot(*found.T, ".", color=ESTIMATE, markersize=5, label="estimated position", rasterized=many, zorder=4)
    if lost:
        axes.plot(
            *np.array(lost)[:, axes_idx].T, "D", markerfacecolor="white", color=BAD, markersize=4, label="not localized", rasterized=many
        )
    inside = ((false >= low) & (false <= high)).all(axis=1)
    if len(false):
        axes.plot(*false[inside].T, "x", color=BAD, markersize=7, markeredgewidth=1.6, label="false position", zorder=5)
    return int((~inside).sum())


def _draw_curve(axes: Axes, errors: Float[np.ndarray, " n"], label: str, unit: str) -> None:
    """Cumulative curve of errors, NaN where there is no pose; the far tail is named instead of drawn."""
    found = np.sort(errors[np.isfinite(errors)])
    axes.set_xlabel(label)
    if len(found) == 0:
        axes.text(0.5, 0.5, "no query was localized", transform=axes.transAxes, ha="center", color=BAD)
        return
    limit = max(1.5 * float(np.percentile(found, 95)), 1e-3)
    drawn = found[found <= limit]
    shares = np.arange(1, len(drawn) + 1) / len(errors)
    axes.step(np.r_[0.0, drawn, limit], np.r_[0.0, shares, shares[-1]], where="post", color=ESTIMATE, linewidth=1.8)
    axes.fill_between(np.r_[0.0, drawn, limit], np.r_[0.0, shares, shares[-1]], step="post", color=ESTIMATE, alpha=0.08, linewidth=0)
    median = float(np.median(found))
    axes.axvline(median, color=ERROR, linewidth=1.2)
    axes.annotate(f"median {median:.3g}{unit}", (median, 0.04), xytext=(5, 0), textcoords="offset points", color=INK)
    if beyond := len(found) - len(drawn):
        axes.text(0.99, 0.12, f"{beyond} of {len(errors)} beyond", transform=axes.transAxes, ha="right", color=BAD)
    axes.set_xlim(0.0, limit)


def _decades(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Powers of ten around the finite values."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 1e-3, 1.0
    low, high = np.floor(np.log10(finite.min())), np.ceil(np.log10(finite.max()))
    return float(10.0**low), float(10.0 ** max(high, low + 1))


def _length(metres: float) -> str:
    if metres < 0.01:
        return f"{1e3 * metres:g} mm"
    return f"{100 * metres:g} cm" if metres < 1.0 else f"{metres:g} m"


def _angle(degrees: float) -> str:
    return f"{degrees:g}°"


def _svg(figure: Figure, title: str) -> str:
    """The figure as an `svg` element without a header; names inside are made from the title, so that figures on one page do not mix."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": title}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = re.sub(r'<g id="[^"]*"', "<g", text[text.index("<svg") :])
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1)
