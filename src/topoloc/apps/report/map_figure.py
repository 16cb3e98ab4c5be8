"""A map from above as SVG text: its nodes, true trajectories and estimated positions."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from topoloc import EvaluatedQuery, Evaluation, Localization, Rigid3, TopoMetricMap
from topoloc.apps.core_names import format_length
from topoloc.apps.report.page_template import (
    BAD,
    ERROR,
    GREY,
    MAX_MARKS,
    NODE,
    STYLE,
    recording_colours,
    svg_text,
)

# Height over width of the map.
MIN_ASPECT, MAX_ASPECT = 0.3, 0.8
# A step longer than this many median steps is a gap, over which no line is drawn.
GAP_STEPS = 6.0
_TRUTH = {"marker": "o", "markerfacecolor": "none", "markersize": 4.5}
_LOST = {"linestyle": "", "marker": "D", "markerfacecolor": "white", "markersize": 5.5}
_FALSE = {"linestyle": "", "marker": "x", "color": BAD, "markersize": 7, "markeredgewidth": 1.6}


class MapFigure:
    """Axes that show the horizontal plane of the world. A context manager that sets the style.

    Args:
        nodes: world_from_cam of the nodes.
        others: further poses that must be visible.
        extra_height: height of the figure beside the map, inches.
        answers: poses that are visible up to one extent of the others away from them.
    """

    def __init__(
        self,
        nodes: Sequence[Rigid3],
        others: Sequence[Rigid3],
        extra_height: float,
        answers: Sequence[Rigid3] = (),
    ) -> None:
        self.nodes = nodes
        known = np.array([pose.translation for pose in [*nodes, *others]])
        downs = np.array([pose.rotation[:, 1] for pose in nodes])
        across, up, self._is_mirrored = find_horizontal_axes(known, downs)
        self.axes_idx = [across, up]
        places, found = known[:, self.axes_idx], self.flatten(answers)
        reach = max(float(np.ptp(places, axis=0).max()), 0.1)
        near = _are_within(found, places.min(axis=0) - reach, places.max(axis=0) + reach)
        self.low, self.high = compute_plot_limits(np.concatenate([places, found[near]]))
        self._extra_height = extra_height
        self._stack = ExitStack()

    def __enter__(self) -> MapFigure:
        self._stack.enter_context(matplotlib.rc_context(STYLE))
        width, height = self.high - self.low
        size = (9.0, 8.3 * height / width + self._extra_height)
        self._figure = Figure(figsize=size, layout="constrained")
        self.axes = self._figure.add_subplot()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def flatten(self, poses: Sequence[Rigid3]) -> Float[np.ndarray, "n 2"]:
        """Return the positions in the axes of the figure."""
        return np.array([pose.translation[self.axes_idx] for pose in poses]).reshape(-1, 2)

    def plot(self, poses: Sequence[Rigid3], **style: Any) -> None:
        """Draw the positions that are within the figure. Many marks become one image inside the
        SVG."""
        places = self.flatten(poses)
        places = places[_are_within(places, self.low, self.high)]
        if len(places):
            style = {"rasterized": len(places) > MAX_MARKS} | style
            self.axes.plot(*places.T, **style)

    def draw_arrows(self, starts: Sequence[Rigid3], ends: Sequence[Rigid3]) -> int:
        """Draw an arrow at the edge to each end that is outside of the figure, with its distance
        from its start, which is inside. Neighbouring arrows become one. Return the number of ends
        outside."""
        arrows, arm = list[tuple[Any, Any, list[float]]](), 0.08 * (self.high - self.low).max()
        for start, end in zip(starts, ends, strict=True):
            origin, place = self.flatten([start, end])
            if _are_within(place[None], self.low, self.high)[0]:
                continue
            way = place - origin
            room = np.where(way > 0, self.high, self.low) - origin
            tip = origin + way * np.divide(room, way, out=np.full(2, np.inf), where=way != 0).min()
            near = (metres for other, _, metres in arrows if np.hypot(*(other - tip)) < arm)
            if (merged := next(near, None)) is None:
                arrows.append((tip, tip - arm * way / np.hypot(*way), merged := []))
            merged.append(float(np.linalg.norm(end.translation - start.translation)))
        style: dict[str, Any] = {"arrowstyle": "-|>", "color": BAD}
        box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none"}
        middle = {"ha": "center", "va": "center", "zorder": 6, "bbox": box, "color": BAD}
        for tip, tail, metres in arrows:
            self.axes.annotate(_describe_arrow(metres), tip, tail, arrowprops=style, **middle)
        return sum(len(metres) for _, _, metres in arrows)

    def draw_lines(self, lines: Sequence[Any], **style: Any) -> None:
        """Draw pairs of points as lines."""
        many = len(lines) > MAX_MARKS
        self.axes.add_collection(LineCollection(lines, rasterized=many, **style))

    def draw_nodes(self, topomap: TopoMetricMap) -> None:
        """Draw the edges and the viewing direction of each node."""
        centres, span = self.flatten(self.nodes), 0.025 * float((self.high - self.low).max())
        looks = centres + span * np.array([pose.rotation[self.axes_idx, 2] for pose in self.nodes])
        edges = [
            (centres[topomap.row_of(edge.source_id)], centres[topomap.row_of(edge.target_id)])
            for edge in topomap.edges
        ]
        self.draw_lines(edges, colors=NODE, linewidths=0.7, alpha=0.6)
        self.draw_lines(list(np.stack([centres, looks], axis=1)), colors=NODE, linewidths=1.0)

    def to_svg(self, title: str, handles: list[Line2D], num_columns: int) -> str:
        """Add the legend and return the figure as SVG text."""
        (left, bottom), (right, top) = self.low, self.high
        xlabel, ylabel = (f"{'xyz'[axis]} (m)" for axis in self.axes_idx)
        limits = {"xlim": (left, right), "ylim": (bottom, top)}
        self.axes.set(xlabel=xlabel, ylabel=ylabel, aspect="equal", **limits)
        if self._is_mirrored:
            self.axes.invert_yaxis()
        spacing, place = {"handletextpad": 0.5, "columnspacing": 1.6}, "outside lower center"
        self._figure.legend(handles=handles, loc=place, ncols=num_columns, **spacing)
        return svg_text(self._figure, title)


def draw_map(answers: Sequence[EvaluatedQuery], topomap: TopoMetricMap) -> str:
    """Draw nodes, true trajectories and estimated positions, with lines between the latter two.

    Each recording has its own colour.
    """
    with_truth = [a for a in answers if a.world_from_cam is not None]
    nodes = [summary.world_from_cam for summary in topomap.summaries]
    groups = Evaluation(with_truth).by_recording
    colours = recording_colours(list(groups))
    height, estimates = 0.9 + 0.2 * (len(groups) // 2), _estimates(answers)
    with MapFigure(nodes, _truths(with_truth), height, estimates) as figure:
        figure.draw_nodes(topomap)
        figure.plot(nodes, linestyle="", marker="o", color=NODE, markersize=5)
        for name, group in groups.items():
            _draw_recording(figure, group, colours[name])
        pairs = [
            figure.flatten([a.world_from_cam, a.result.world_from_cam])
            for a in with_truth
            if a.world_from_cam is not None and isinstance(a.result, Localization)
        ]
        figure.draw_lines(pairs, colors=ERROR, linewidths=1.2, zorder=3)
        false = _estimates([a for a in answers if a.is_false_accept])
        figure.plot(false, zorder=5, **_FALSE)
        found = [a for a in answers if isinstance(a.result, Localization)]
        starts = [a.world_from_cam or _find_nearest(nodes, a) for a in found]
        if num_outside := figure.draw_arrows(starts, estimates):
            what = "positions are" if num_outside > 1 else "position is"
            text = f"{num_outside} {what} outside of the figure. Arrows name the distance from the"
            figure.axes.set_title(f"{text} truth, or from the nearest node without one.", color=BAD)
        return figure.to_svg("map from above", _create_legend(answers, colours), 5)


def find_horizontal_axes(
    points: Float[np.ndarray, "n 3"], downs: Float[np.ndarray, "m 3"]
) -> tuple[int, int, bool]:
    """Return the world axes for right and up in the figure, and whether up must be inverted.

    The vertical axis is the one that the y axes of the cameras agree on, else the one with the
    smallest extent. Inversion avoids a view from below.
    """
    down, extent = downs.mean(axis=0), np.ptp(points, axis=0)
    vertical = int(np.argmax(np.abs(down))) if np.abs(down).max() > 0.7 else int(np.argmin(extent))
    across, up = sorted(
        (axis for axis in range(3) if axis != vertical), key=lambda axis: -extent[axis]
    )
    towards_viewer = np.cross(np.eye(3)[across], np.eye(3)[up])
    return across, up, bool(towards_viewer @ down > 0)


def compute_plot_limits(
    points: Float[np.ndarray, "n 2"],
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the (low, high) corners around all points, with a margin and a bounded aspect."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = high - low + 0.12 * max(float((high - low).max()), 0.1)
    size = np.maximum(size, [size[1] / MAX_ASPECT, size[0] * MIN_ASPECT])
    return (low + high - size) / 2, (low + high + size) / 2


def _are_within(
    places: Float[np.ndarray, "n 2"], low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> Bool[np.ndarray, " n"]:
    return np.all((places >= low) & (places <= high), axis=1)


def _describe_arrow(metres: Sequence[float]) -> str:
    """Return the text of an arrow to ends at these distances."""
    ends = [format_length(one, 0 if one >= 10.0 else 1) for one in (min(metres), max(metres))]
    several = f"{len(metres)} answers, " if len(metres) > 1 else ""
    return several + " to ".join(dict.fromkeys(ends))


def _find_nearest(nodes: Sequence[Rigid3], answer: EvaluatedQuery) -> Rigid3:
    """Return the node that is nearest to the estimated position."""
    (estimate,) = _estimates([answer])
    return min(nodes, key=lambda node: np.linalg.norm(node.translation - estimate.translation))


def _truths(answers: Sequence[EvaluatedQuery]) -> list[Rigid3]:
    return [a.world_from_cam for a in answers if a.world_from_cam is not None]


def _estimates(answers: Sequence[EvaluatedQuery]) -> list[Rigid3]:
    return [a.result.world_from_cam for a in answers if isinstance(a.result, Localization)]


def _draw_recording(figure: MapFigure, answers: Sequence[EvaluatedQuery], colour: str) -> None:
    """Draw the true trajectory with a ring for each query, and the estimated positions."""
    truths = _truths(answers)
    many, path = len(truths) > MAX_MARKS, _insert_gaps(figure.flatten(truths))
    figure.axes.plot(*path.T, "-", color=colour, linewidth=1.0, alpha=0.45, rasterized=many)
    figure.plot(truths, linestyle="", color=colour, markeredgewidth=0.6, **_TRUTH)
    found = _estimates([a for a in answers if not a.is_false_accept])
    figure.plot(found, linestyle="", marker=".", color=colour, markersize=5, zorder=4)
    lost = _truths([a for a in answers if not a.result.localized])
    figure.plot(lost, color=colour, markeredgewidth=1.3, zorder=5, **_LOST)


def _create_legend(answers: Sequence[EvaluatedQuery], colours: dict[str, str]) -> list[Line2D]:
    """Return the handles of the recordings by colour, if there are several, and of the marks."""
    names = colours if len(colours) > 1 else {}
    single = GREY if names else next(iter(colours.values()), GREY)
    entries = [
        {"color": colour, "marker": "o", "markersize": 5, "linewidth": 1.0, "label": name}
        for name, colour in names.items()
    ]
    entries.append(
        {"linestyle": "", "marker": "o", "color": NODE, "markersize": 5, "label": "node of the map"}
    )
    with_truth = [a.result.localized for a in answers if a.world_from_cam is not None]
    if colours:
        entries.append(_TRUTH | {"color": single, "linewidth": 1.0, "label": "true trajectory"})
    if any(with_truth):
        entries.append(
            {"linestyle": "", "marker": ".", "color": single, "markersize": 6, "label": "estimated"}
        )
        entries.append({"color": ERROR, "linewidth": 1.2, "label": "error"})
    if not all(with_truth):
        entries.append(_LOST | {"color": single, "label": "not localized"})
    if any(a.is_false_accept for a in answers):
        entries.append(_FALSE | {"label": "false position"})
    return [Line2D([], [], **entry) for entry in entries]


def _insert_gaps(path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Insert a row of NaN before each position that is far from the previous one."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    if len(steps) == 0:
        return path
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps))
    return np.insert(path, gaps + 1, np.nan, axis=0)
