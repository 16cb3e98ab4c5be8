"""Common style of the figures of a report, and their conversion to SVG text."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, GREY, NODE, ERROR, BAD = "#1f2a37", "#6b7786", "#9db2ca", "#f0a202", "#d1345b"
# One colour for each recording, distinct for colour-blind readers too, and from ERROR and BAD.
RECORDING_COLOURS = (
    "#0f8b8d",
    "#5b4fc7",
    "#b5651d",
    "#2f6db5",
    "#6a7f10",
    "#9c3f97",
    "#3d4b5c",
    "#12724a",
)
# With more marks, the points of a figure become one image inside it, which bounds its size.
MAX_MARKS = 2000
STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
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


def recording_colours(names: Sequence[str]) -> dict[str, str]:
    """Return a colour for each recording, the same in all figures of a page."""
    return {name: RECORDING_COLOURS[i % len(RECORDING_COLOURS)] for i, name in enumerate(names)}


def svg_text(figure: Figure, title: str) -> str:
    """Return the figure as an `svg` element without a header.

    Ids inside depend on the title, so those of several figures on a page differ.
    """
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": title}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = re.sub(r'<g id="[^"]*"', "<g", text[text.index("<svg") :])
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1)
