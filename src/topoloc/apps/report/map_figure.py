"""A map from above as SVG text: its nodes, true trajectories and estimated positions."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from topoloc import EvaluatedQuery, Evaluation, Localization, Rigid3, TopoMetricMap
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
    """

    def __init__(
        self, nodes: Sequence[Rigid3], others: Sequence[Rigid3], extra_height: float
    ) -> None:
        self.nodes = nodes
        known = np.array([pose.translation for pose in [*nodes, *others]])
        downs = np.array([pose.rotation[:, 1] for pose in nodes])
        across, up, self._is_mirrored = find_horizontal_axes(known, downs)
        self.axes_idx = [across, up]
        self.low, self.high = compute_plot_limits(known[:, self.axes_idx])
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

    def contains(self, pose: Rigid3) -> bool:
        """Return whether a position lies within the figure."""
        (place,) = self.flatten([pose])
        return bool(np.all(place >= self.low) and np.all(place <= self.high))

    def plot(self, poses: Sequence[Rigid3], **style: Any) -> None:
        """Draw the positions, at the edge if they are outside. Many marks become one image inside
        the SVG."""
        if poses:
            style = {"rasterized": len(poses) > MAX_MARKS} | style
            self.axes.plot(*np.clip(self.flatten(poses), self.low, self.high).T, **style)

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
    with MapFigure(nodes, _truths(with_truth), 0.9 + 0.2 * (len(groups) // 2)) as figure:
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
        figure.plot(false, zorder=5, clip_on=False, **_FALSE)
        if num_outside := sum(not figure.contains(pose) for pose in false):
            what = "positions are" if num_outside > 1 else "position is"
            text = f"{num_outside} false {what} outside of the figure, marked at its edge"
            figure.axes.set_title(text, color=BAD)
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
