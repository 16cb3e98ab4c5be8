"""The figures of the paper's experiments, as matplotlib figures; `page.py` puts them on a page and
into files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, PercentFormatter

from topoloc.apps.report.page_template import BAD, GREY, INK, NODE, RECORDING_COLOURS, STYLE

Row = Mapping[str, Any]
METHOD_COLOURS: dict[str, str] = dict(
    zip(("surf-vlad", "cnn-fc", "cnn-nn", "vlad-nn"), RECORDING_COLOURS, strict=False)
)


def draw_topological_accuracy(rows: Sequence[Row]) -> Figure:
    """Draw the paper's figure of topological accuracy.

    A bar shows, for each recording, the share of queries whose nearest node was ranked first. The
    paler bar above it shows the share whose neighbouring node was ranked first.
    """
    shown = [
        r
        for r in rows
        if r.get("topological_accuracy") is not None and r["nodes"].startswith("D_thresh")
    ]
    places = list(dict.fromkeys((r["dataset"], r["queries"]) for r in shown))
    methods = [m for m in METHOD_COLOURS if any(r["method"] == m for r in shown)]
    width = 0.8 / max(len(methods), 1)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.4), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(visible=False, axis="x")
        for number, method in enumerate(methods):
            mine = {(r["dataset"], r["queries"]): r for r in shown if r["method"] == method}
            at = np.arange(len(places)) + (number - (len(methods) - 1) / 2) * width
            hits = [mine[p]["topological_accuracy"] if p in mine else 0.0 for p in places]
            near = [mine[p]["neighbour_accuracy"] or 0.0 if p in mine else 0.0 for p in places]
            axes.bar(at, near, 0.9 * width, color=METHOD_COLOURS[method], alpha=0.3)
            axes.bar(at, hits, 0.9 * width, color=METHOD_COLOURS[method], label=method)
        axes.set_xticks(
            range(len(places)), [f"{dataset}\n{queries}" for dataset, queries in places]
        )
        axes.tick_params(axis="x", length=0, labelcolor=INK)
        axes.set(ylim=(0.0, 1.02), ylabel="nearest node named first")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
        figure.legend(loc="outside lower center", ncols=len(methods))
        return figure


def draw_node_sweep(rows: Sequence[Row]) -> Figure:
    """The paper's figure of the number of nodes: errors and the map's bytes against it, a line for
    each place."""
    places = list(dict.fromkeys((r["dataset"], r["queries"]) for r in rows))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.2), layout="constrained")
        panels = figure.subplots(1, 3)
        kinds = (
            ("median_translation_m", 100.0, "median error (cm)"),
            ("median_rotation_deg", 1.0, "median error (degrees)"),
        )
        for place, colour in zip(places, RECORDING_COLOURS, strict=False):
            mine = sorted(
                (r for r in rows if (r["dataset"], r["queries"]) == place),
                key=lambda r: r["num_nodes"],
            )
            nodes = [r["num_nodes"] for r in mine]
            for axes, (key, scale, label) in zip(panels, kinds, strict=False):
                values = [np.nan if r[key] is None else scale * r[key] for r in mine]
                axes.plot(
                    nodes,
                    values,
                    "o-",
                    color=colour,
                    markersize=4,
                    label=", ".join(place) if axes is panels[0] else None,
                )
                axes.set(ylabel=label, yscale="log")
            panels[2].plot(
                nodes, [r["bytes"] / 1e6 for r in mine], "o-", color=colour, markersize=4
            )
            panels[2].set(ylabel="map file (MB)", yscale="log")
        for axes in panels:
            axes.set(xlabel="nodes", xscale="log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axis.set_minor_formatter(NullFormatter())
        figure.legend(loc="outside lower center", ncols=max(len(places), 1))
        return figure


def draw_stage_times(rows: Sequence[Row]) -> Figure:
    """Draw Table III as stacked bars of the median times of all stages, beside the paper's
    total."""
    shown = [r for r in rows if not r.get("missing")]
    stages = {
        "patch_normalization": "patch normalisation",
        "features": "SURF",
        "coarse": "CNN + NN",
        "matching": "matching",
        "pnp": "PnP",
    }
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 0.9 + 0.3 * len(shown)), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(visible=False, axis="y")
        at = np.arange(len(shown))[::-1]
        left = np.zeros(len(shown))
        for (stage, label), colour in zip(stages.items(), RECORDING_COLOURS, strict=False):
            medians = np.array([1e3 * r["quartiles_s"][stage][1] for r in shown])
            axes.barh(at, medians, 0.6, left=left, color=colour, label=label)
            left += medians
        for row, y, end in zip(shown, at, left, strict=True):
            total = 1e3 * row["quartiles_s"]["total"][1]
            paper = (
                f"  (the paper, with a GPU: {1e3 * row['paper_s']:.0f})" if row["paper_s"] else ""
            )
            axes.annotate(
                f"{total:.0f} ms{paper}",
                (end, y),
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                color=INK,
            )
        axes.set_yticks(at, [f"{r['dataset']}, {r['method']}" for r in shown])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set(xlabel="ms a query, medians", xlim=(0.0, 1.45 * max([*left.tolist(), 1e-3])))
        figure.legend(loc="outside lower center", ncols=len(stages))
        return figure


def draw_against_posenet(
    truths: Float[np.ndarray, "n 3"],
    posenet: Float[np.ndarray, "n 3"],
    ours: Float[np.ndarray, "m 3"],
    title: str,
) -> Figure:
    """The paper's qualitative comparison: positions (metres, z up) from above, of the truth, of
    PoseNet, and ours."""
    span = np.ptp(truths[:, :2], axis=0)
    across, up = (0, 1) if span[0] >= span[1] else (1, 0)
    ratio = float(np.clip(span[up] / max(span[across], 1e-6), 0.3, 0.9))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 4.2 * ratio + 1.0), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, found, name, colour in (
            (panels[0], posenet, "PoseNet", BAD),
            (panels[1], ours, "topoloc", RECORDING_COLOURS[0]),
        ):
            _draw_path(axes, truths[:, [across, up]])
            axes.plot(*found[:, [across, up]].T, ".", color=colour, markersize=4)
            axes.set(
                title=f"{title}: {name}",
                aspect="equal",
                xlabel=f"{'xyz'[across]} (m)",
                ylabel=f"{'xyz'[up]} (m)",
            )
        low, high = truths[:, [across, up]].min(axis=0), truths[:, [across, up]].max(axis=0)
        margin = 0.12 * float((high - low).max())
        panels[0].set(
            xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin)
        )
        return figure


def draw_pictures(
    rows: Sequence[Sequence[np.ndarray]], row_names: Sequence[str], column_names: Sequence[str]
) -> Figure:
    """Pictures side by side, in rows."""
    with matplotlib.rc_context(STYLE):
        height, width = rows[0][0].shape[:2]
        num_columns = max(len(row) for row in rows)
        cell = 9.0 / num_columns
        figure = Figure(
            figsize=(9.0, len(rows) * cell * height / width + 0.4), layout="constrained", dpi=130
        )
        panels = figure.subplots(len(rows), num_columns, squeeze=False)
        for i, row in enumerate(rows):
            for j, axes in enumerate(panels[i]):
                axes.set_axis_off()
                if j < len(row):
                    axes.imshow(row[j], cmap="gray", vmin=0, vmax=255, interpolation="lanczos")
                if i == 0 and j < len(column_names):
                    axes.set_title(column_names[j], color=INK)
            panels[i][0].text(
                0.015,
                0.03,
                row_names[i],
                transform=panels[i][0].transAxes,
                color="white",
                bbox={"color": INK, "alpha": 0.7, "pad": 2},
            )
        return figure


def _draw_path(axes: Axes, truths: Float[np.ndarray, "n 2"]) -> None:
    steps = np.linalg.norm(np.diff(truths, axis=0), axis=1)
    gaps = np.flatnonzero(steps > 6.0 * np.median(steps)) + 1 if len(steps) else []
    axes.plot(*np.insert(truths, gaps, np.nan, axis=0).T, "-", color=NODE, linewidth=2.5)
    axes.plot(*truths.T, "o", markerfacecolor="none", color=GREY, markersize=3, markeredgewidth=0.5)
