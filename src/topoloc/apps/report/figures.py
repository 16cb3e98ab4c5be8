"""The error curves and times of a report as SVG text. `map_figure.py` draws the map.

The figures do not use pyplot, so no global state changes and the same results give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, PercentFormatter

from topoloc import EvaluatedQuery, Evaluation
from topoloc.apps.report.page_template import (
    BAD,
    GREY,
    INK,
    MAX_MARKS,
    RECORDING_COLOURS,
    STYLE,
    recording_colours,
    svg_text,
)

STAGES = ("patch_normalization", "features", "coarse", "matching", "pnp", "last_step")


def draw_error_curves(answers: Sequence[EvaluatedQuery]) -> tuple[str, str]:
    """Draw the share of queries within an error, one line for each recording.

    Returns the figures of translation and rotation.
    """
    groups = Evaluation([a for a in answers if a.world_from_cam is not None]).by_recording
    metres = [a.translation_m for a in answers if not a.is_false_accept]
    large = np.nanmax(metres, initial=0.0) > 2.0
    scale, unit = (1.0, " m") if large else (100.0, " cm")
    translations = {
        name: scale * np.array([a.translation_m for a in group]) for name, group in groups.items()
    }
    rotations = {name: np.array([a.rotation_deg for a in group]) for name, group in groups.items()}
    return (
        _draw_curves(translations, f"translation error ({unit.strip()})", unit),
        _draw_curves(rotations, "rotation error (degrees)", "°"),
    )


def draw_errors_along(answers: Sequence[EvaluatedQuery]) -> str:
    """Draw the errors of all queries in order. Marks at the top are queries without a pose."""
    with_truth = [a for a in answers if a.world_from_cam is not None]
    colours = recording_colours(list(Evaluation(with_truth).by_recording))
    has_lost = not all(a.result.localized for a in with_truth)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.9), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        translations = np.array([a.translation_m for a in with_truth])
        rotations = np.array([a.rotation_deg for a in with_truth])
        _draw_errors(panels[0], with_truth, translations, colours, _format_length)
        _draw_errors(panels[1], with_truth, rotations, colours, lambda degrees: f"{degrees:g}°")
        panels[0].set_title("translation error")
        panels[1].set_title("rotation error")
        panels[1].set(
            xlabel="query" + (" (red marks: no pose)" if has_lost else ""),
            xlim=(-0.5, max(len(with_truth) - 0.5, 0.5)),
        )
        if len(colours) > 1:
            pairs, plot = colours.items(), panels[0].plot
            handles = [plot([], [], ".-", color=colour, label=name)[0] for name, colour in pairs]
            figure.legend(handles=handles, loc="outside lower center", ncols=4)
        return svg_text(figure, "errors along the recordings")


def _draw_errors(
    axes: Axes,
    answers: Sequence[EvaluatedQuery],
    errors: Float[np.ndarray, " n"],
    colours: dict[str, str],
    label: Callable[[float], str],
) -> None:
    numbers, values = np.arange(len(answers)), np.maximum(errors, 1e-5)
    axes.set_yscale("log")
    for name, colour in colours.items():
        own = np.array([a.recording == name for a in answers])
        line = np.where(own, values, np.nan)
        axes.plot(numbers, line, "-", color=colour, linewidth=0.8, alpha=0.5)
        many = len(numbers) > MAX_MARKS
        axes.plot(numbers[own], values[own], ".", color=colour, markersize=4, rasterized=many)
    axes.set_ylim(*_powers_of_ten(values))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: label(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())
    for start, (a, b) in enumerate(pairwise(answers), 1):
        if a.recording != b.recording:
            axes.axvline(start - 0.5, color=GREY, linewidth=0.8, linestyle=":")
    lost = numbers[[not a.result.localized for a in answers]]
    if len(lost):  # an empty line, not clipped, would upset the layout
        at_top = {"transform": axes.get_xaxis_transform(), "clip_on": False}
        axes.plot(lost, np.ones(len(lost)), "|", color=BAD, markersize=8, **at_top)


def draw_stage_times(answers: Sequence[EvaluatedQuery]) -> str:
    """Draw the milliseconds of each stage: a bar to the median, a line to the 95 % quantile."""
    names = {stage for a in answers for stage in a.result.times_ms}
    last = [stage for stage in ("total",) if stage in names]
    known = [stage for stage in STAGES if stage in names]
    stages = [*known, *sorted(names - {*known, *last}), *last]
    times = [[a.result.times_ms.get(stage, 0.0) for a in answers] for stage in stages]
    medians = [float(np.median(t)) for t in times]
    highs, rows = [float(np.percentile(t, 95)) for t in times], np.arange(len(stages))[::-1]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 0.6 + 0.32 * len(stages)), layout="constrained")
        axes = figure.add_subplot()
        axes.grid(visible=False, axis="y")
        colours = [INK if stage == "total" else RECORDING_COLOURS[0] for stage in stages]
        axes.barh(rows, medians, height=0.55, color=colours)
        axes.hlines(rows, medians, highs, color=GREY, linewidth=1.2)
        for row, median, high in zip(rows, medians, highs, strict=True):
            style: dict[str, Any] = {"textcoords": "offset points", "va": "center", "color": INK}
            text = f"{median:.1f} (95 %: {high:.0f})"
            axes.annotate(text, (max(median, high), row), xytext=(6, 0), **style)
        axes.set_yticks(rows, [stage.replace("_", " ") for stage in stages])
        axes.tick_params(axis="y", length=0, labelcolor=INK)
        axes.set(xlabel="ms a query", xlim=(0.0, 1.15 * max([*highs, *medians, 1e-3])))
        return svg_text(figure, "times of the stages")


def _draw_curves(errors: dict[str, Float[np.ndarray, " _"]], label: str, unit: str) -> str:
    """Draw cumulative curves of the errors of each recording. NaN is a query without a pose."""
    colours = recording_colours(list(errors))
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 2.9 + 0.2 * len(errors)), layout="constrained")
        axes = figure.add_subplot()
        found = {name: np.sort(values[np.isfinite(values)]) for name, values in errors.items()}
        low, high = _powers_of_ten(np.concatenate([[], *found.values()]))
        for name, values in found.items():
            prefix = f"{name}: " if len(errors) > 1 else ""
            text = _curve_label(values, len(errors[name]), unit)
            shares = np.arange(1, len(values) + 1) / len(errors[name])
            x, y = np.r_[low, values, high], np.r_[0.0, shares, shares[-1:]]
            points = (x, y) if len(values) else ([], [])
            style = {"where": "post", "color": colours[name], "linewidth": 1.8}
            axes.step(*points, label=prefix + text, **style)
        limits = {"xlim": (low, high), "ylim": (0.0, 1.03), "xscale": "log"}
        axes.set(xlabel=label, ylabel="queries within this error", **limits)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
        figure.legend(loc="outside lower left", ncols=1, handlelength=1.4)
        return svg_text(figure, f"cumulative {label.partition(' (')[0]}")


def _curve_label(found: Float[np.ndarray, " n"], num_queries: int, unit: str) -> str:
    """Return the median and the largest error."""
    if len(found) == 0:
        return f"none of {num_queries} localized"
    return f"median {float(np.median(found)):.3g}{unit}, largest {found[-1]:.3g}{unit}"


def _powers_of_ten(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the powers of ten around the finite values."""
    finite = values[np.isfinite(values) & (values > 0.0)]
    if len(finite) == 0:
        return 1e-3, 1.0
    low, high = np.floor(np.log10(finite.min())), np.ceil(np.log10(finite.max()))
    return float(10.0**low), float(10.0 ** max(high, low + 1))


def _format_length(metres: float) -> str:
    if metres < 0.01:
        return f"{1e3 * metres:g} mm"
    return f"{100 * metres:g} cm" if metres < 1.0 else f"{metres:g} m"
