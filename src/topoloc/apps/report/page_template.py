"""What all pages to show have around them: head, style by light and by dark, title."""

from __future__ import annotations

from html import escape
from importlib import resources

from topoloc.apps.viewer.page import static_text


def page_style() -> str:
    """The style sheet."""
    return static_text("theme.css") + resources.files("topoloc.apps.report").joinpath(
        "report.css"
    ).read_text(encoding="utf-8")


def render_page(title: str, subtitle: str, body: str, head: str = "") -> str:
    """A self-contained page as text.

    Args:
        title: plain text, as the subtitle.
        body: HTML; `head` what the page's head needs beside the style.
    """
    meta = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    )
    header = (
        "<header><div"
        f' class="page"><h1>{escape(title)}</h1><p>{escape(subtitle)}</p></div></header>'
    )
    return (
        "<!DOCTYPE html>\n<html"
        f' lang="en"><head>{meta}\n<title>{escape(title)}</title>\n<style>\n{page_style()}</style>{head}</head><body>\n{header}\n<div'  # noqa: E501
        f' class="page">{body}<footer>Written by topoloc.</footer></div></body></html>\n'
    )
