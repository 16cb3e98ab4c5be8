"""The error curves and times of a report, each as SVG text that can stand inside a page;
`map_figure.py` draws the map.

Drawn with matplotlib's figures directly, not through pyplot: nothing global is touched, and the
same answers give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, PercentFormatter

from topoloc import EvaluatedQuery, NotLocalized
from topoloc.apps.report.figure_style import (
    BAD,
    GREY,
    INK,
    MAX_MARKS,
    RECORDING_COLOURS,
    STYLE,
    recording_colours,
    svg_text,
)
from topoloc.plugin import group_by_recording

STAGES = ("patch_normalization", "features", "coarse", "matching", "pnp")


def draw_error_curves(answers: Sequence[EvaluatedQuery]) -> tuple[str, str]:
    """Which share of the queries with truth is within a given error, one line a recording:
    translation and rotation, a figure each."""
    groups = group_by_recording([a for a in answers if a.world_from_cam is not None])
    everything = [a for group in groups.values() for a in group]
    metres = (
        max(
            (a.translation_m for a in everything if a.result.localized and not a.is_false_accept),
            default=0.0,
        )
        > 2.0
    )
    scale, unit = (1.0, " m") if metres else (100.0, " cm")
    translations = {
        name: scale * np.array([a.translation_m for a in group]) for name, group in groups.items()
    }
    rotations = {name: np.array([a.rotation_deg for a in group]) for name, group in groups.items()}
    return (
        _draw_curves(translations, f"translation error ({unit.strip()})", unit),
        _draw_curves(rotations, "rotation error (degrees)", "°"),
    )


def draw_errors_along(answers: Sequence[EvaluatedQuery]) -> str:
    """The errors of query after query; those without a pose are marked at the top."""
    with_truth = [a for a in answers if a.world_from_cam is not None]
    groups = group_by_recording(with_truth)
    colours = recording_colours(list(groups))
    numbers = np.arange(len(with_truth))
    lost = np.array([isinstance(a.result, NotLocalized) for a in with_truth])
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.9), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        curves = (
            ("translation", [a.translation_m for a in with_truth], _format_length),
            ("rotation", [a.rotation_deg for a in with_truth], _format_angle),
        )
        for axes, (title, errors, label) in zip(panels, curves, strict=True):
            values = np.maximum(np.array(errors), 1e-5)
            axes.set_yscale("log")
            for name, colour in colours.items():
                own = np.array([a.recording == name for a in with_truth])
                axes.plot(
                    numbers,
                    np.where(own, values, np.nan),
                    "-",
                    color=colour,
                    linewidth=0.8,
                    alpha=0.5,
                )
                axes.plot(
                    numbers[own],
                    values[own],
                    ".",
                    color=colour,
                    markersize=4,
                    rasterized=len(numbers) > MAX_MARKS,
                )
            axes.set_ylim(*_powers_of_ten(values))
            axes.yaxis.set_major_formatter(
                FuncFormatter(lambda value, _, label=label: label(value))
            )
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_title(f"{title} error")
            for start in (
                i for i, (a, b) in enumerate(pairwise(with_truth), 1) if a.recording != b.recording
            ):
                axes.axvline(start - 0.5, color=GREY, linewidth=0.8, linestyle=":")
            if lost.any():  # an empty line, not clipped, would upset the layout
                marks = numbers[lost]
                axes.plot(
                    marks,
                    np.ones(len(marks)),
                    "|",
                    color=BAD,
                    transform=axes.get_xaxis_transform(),
                    clip_on=False,
                    markersize=8,
                )
        panels[-1].set(
            xlabel="query" + (" (red marks: no pose)" if lost.any() else ""),
            xlim=(-0.5, max(len(numbers) - 0.5, 0.5)),
        )
        if len(groups) > 1:
            handles = [
                panels[0].plot([], [], ".-", color=colour, label=name)[0]
                for name, colour in colours.items()
            ]
            figure.legend(handles=handles, loc="outside lower center", ncols=4)
        return svg_text(figure, "errors along the recordings")


def draw_stage_times(answers: Sequence[EvaluatedQuery]) -> str:
    """Milliseconds of each stage: the median as a bar, a line up to what 95 % of the queries stay
    below."""
    names = {stage for a in answers for stage in a.result.times_ms}
    stages = (
        [stage for stage in STAGES if stage in names]
        + sorted(names - {*STAGES, "total"})
        + [s for s in ("total",) if s in names]
    )
    times = [np.array([a.result.times_ms.get(stage, 0.0) for a in answers]) for stage in stages]
    medians, highs = (
        [float(np.median(t)) for t in times],
        [float(np.percentile(t, 95)) for t in times],
    )
    rows = np.arange(len(stages))[::-1]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 0.6 + 0.32 * len(stages)), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(visible=False, axis="y")
        axes.barh(
            rows,
            medians,
            height=0.55,
            color=[INK if stage == "total" else RECORDING_COLOURS[0] for stage in stages],
        )
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
        return svg_text(figure, "times of the stages")


def _draw_curves(errors: dict[str, Float[np.ndarray, " _"]], label: str, unit: str) -> str:
    """Cumulative curves of the errors of each recording, NaN where there is no pose."""
    colours = recording_colours(list(errors))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 2.9 + 0.2 * len(errors)), layout="constrained")
        axes = figure.add_subplot()
        found = {name: np.sort(values[np.isfinite(values)]) for name, values in errors.items()}
        # as wide as the middle of the recordings' tails: one bad recording must not squeeze the
        # others to the left edge
        tails = [1.5 * float(np.percentile(values, 95)) for values in found.values() if len(values)]
        limit = max(float(np.median(tails)), 1e-3) if tails else 1.0
        for name, values in found.items():
            _draw_curve(
                axes,
                values,
                len(errors[name]),
                limit,
                colours[name],
                f"{name}: " if len(errors) > 1 else "",
                unit,
            )
        axes.set(
            xlabel=label, ylabel="queries within this error", xlim=(0.0, limit), ylim=(0.0, 1.03)
        )
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
        figure.legend(loc="outside lower left", ncols=1, handlelength=1.4)
        return svg_text(figure, f"cumulative {label.partition(' (')[0]}")


def _draw_curve(
    axes: Axes,
    found: Float[np.ndarray, " n"],
    num_queries: int,
    limit: float,
    colour: str,
    name: str,
    unit: str,
) -> None:
    """One curve; what lies beyond the right edge is named in the legend instead of drawn."""
    if len(found) == 0:
        axes.plot([], [], color=colour, label=f"{name}none of {num_queries} localized")
        return
    drawn = found[found <= limit]
    shares = np.arange(1, len(drawn) + 1) / num_queries
    last = shares[-1] if len(shares) else 0.0
    beyond = (
        f", {len(found) - len(drawn)} of {num_queries} beyond" if len(found) > len(drawn) else ""
    )
    median = f"{name}median {float(np.median(found)):.3g}{unit}{beyond}"
    axes.step(
        np.r_[0.0, drawn, limit],
        np.r_[0.0, shares, last],
        where="post",
        color=colour,
        linewidth=1.8,
        label=median,
    )


def _powers_of_ten(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Powers of ten around the finite values."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 1e-3, 1.0
    low, high = np.floor(np.log10(finite.min())), np.ceil(np.log10(finite.max()))
    return float(10.0**low), float(10.0 ** max(high, low + 1))


def _format_length(metres: float) -> str:
    if metres < 0.01:
        return f"{1e3 * metres:g} mm"
    return f"{100 * metres:g} cm" if metres < 1.0 else f"{metres:g} m"


def _format_angle(degrees: float) -> str:
    return f"{degrees:g}°"
