"""Common parts of all pages and figures: style, head, sections, cards, tables, images, SVG text."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from typing import TYPE_CHECKING, Any

from topoloc.apps.viewer.page import static_text
from topoloc.apps.viewer.scene import image_type

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, GREY, NODE, ERROR, BAD = "#1f2a37", "#6b7786", "#9db2ca", "#f0a202", "#d1345b"
# One colour for each recording, distinct for colour-blind readers too, and from ERROR and BAD.
_COLOURS = "#0f8b8d #5b4fc7 #b5651d #2f6db5 #6a7f10 #9c3f97 #3d4b5c #12724a"
RECORDING_COLOURS = tuple(_COLOURS.split())
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
    width = round(72 * figure.get_figwidth())  # one pixel a point, so that text stays readable
    style = f'style="--width: {width}px"'
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" {style} ', 1)


def render_wide(figure: str, label: str) -> str:
    """Return a figure that scrolls on a narrow screen. `label` names it for screen readers."""
    return f'<div class="wide" tabindex="0" role="region" aria-label="{label}">{figure}</div>'


def page_style() -> str:
    """Return the style sheet."""
    own = resources.files("topoloc.apps.report").joinpath("report.css")
    return static_text("theme.css") + own.read_text(encoding="utf-8")


def render_page(title: str, subtitle: str, body: str, head: str = "") -> str:
    """Return a self-contained page.

    Args:
        title: plain text, like the subtitle.
        body: HTML.
        head: HTML that the page's head needs beside the style.
    """
    title, subtitle = escape(title), escape(subtitle)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport"'
        f' content="width=device-width, initial-scale=1">\n<title>{title}</title>\n'
        f"<style>\n{page_style()}</style>{head}</head><body>\n"
        f'<header><div class="page"><h1>{title}</h1><p>{subtitle}</p></div></header>\n'
        f'<div class="page">{body}<footer>Written by topoloc.</footer></div></body></html>\n'
    )


def render_section(title: str, explanation: str, content: str) -> str:
    """Return a section of HTML. An empty explanation is left out."""
    paragraph = f"<p>{explanation}</p>" if explanation else ""
    return f"<section><h2>{title}</h2>{paragraph}{content}</section>"


def render_cards(cards: Iterable[tuple[str, str, str]]) -> str:
    """Return cards of (kind, value, text). The kind is good, bad or empty."""
    inner = "".join(
        f'<div class="card {kind}"><b>{value}</b><span>{text}</span></div>'
        for kind, value, text in cards
    )
    return f'<div class="cards">{inner}</div>'


def render_table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "", label: str = ""
) -> str:
    """Return a table that folds on narrow screens. Each cell carries the name of its column.

    Args:
        rows: cells as HTML.
        kind: further CSS class of the table.
        label: name of the scrollable region for screen readers.
    """
    head = "".join(f"<th>{name}</th>" for name in columns)
    body = "".join(f"<tr>{_render_cells(columns, row)}</tr>" for row in rows)
    table = f'<table class="{kind} folds"><thead><tr>{head}</tr></thead><tbody>{body}</tbody>'
    table += "</table>"
    return render_wide(table, label) if label else f'<div class="wide">{table}</div>'


def _render_cells(columns: Sequence[str], row: Sequence[str]) -> str:
    cells = zip(columns, row, strict=True)
    return "".join(f'<td data-column="{escape(name)}">{cell}</td>' for name, cell in cells)


def render_figure(encoded: bytes | None, caption: str) -> str:
    """Return an image (WebP or JPEG) with its caption; without an image, the caption alone."""
    caption, image = escape(caption), ""
    if encoded:
        source = f"data:image/{image_type(encoded)};base64,{base64.b64encode(encoded).decode()}"
        image = f'<img loading="lazy" alt="{caption}" src="{source}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def render_gallery_items(items: Iterable[tuple[str, str]]) -> str:
    """Return a gallery of (figure, facts), both HTML."""
    articles = "".join(
        f'<article>{figure}<div class="facts">{facts}</div></article>' for figure, facts in items
    )
    return f'<div class="queries">{articles}</div>'
