"""The table of the paper's experiments in docs/benchmarks.md: a block between two markers,
generated from the results alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from topoloc.errors import TopolocError
from topoloc.recordings.atomic import write_text
from topoloc_paper.settings import LEARNED
from topoloc_paper.text_tables import MISSING, Row, Table, about, error_words, paper_words

BEGIN, END = "<!-- benchmark paper -->", "<!-- /benchmark paper -->"
PEERS = ("the paper's step", "pycolmap, SIFT")


def block_of(results: Mapping[str, Any]) -> str:
    """The block with its markers: a line for each recording, its methods and the peers side by
    side, and the commands that make it."""
    accuracy, peers = results.get("accuracy", []), results.get("peers", [])
    places = dict.fromkeys((row["dataset"], row["queries"]) for row in accuracy)
    lines = []
    for place in places:
        mine = [row for row in accuracy if (row["dataset"], row["queries"]) == place]
        others = [row for row in peers if (row["dataset"], row["queries"]) == place]
        lines.append([", ".join(place), *_cells(mine, others)])
    own = "surf-vlad (no weights)"
    columns = [
        "place, queries",
        "the paper's best",
        "PoseNet",
        *LEARNED,
        own,
        f"{own}, own nodes, ms",
        *PEERS,
    ]
    how = (
        "All but the last of ours have the paper's D_thresh; in brackets how many queries were"
        " localized, where not all. With `conditions` in place of `paper` the command makes the"
        " rows of rendered places, with `recordings` the others, with `peers` the last two columns."
    )
    return f"{BEGIN}\n{about(results)} {how}\n\n{Table(columns, lines).markdown()}\n{END}"


def update_readme(path: Path, results: Mapping[str, Any]) -> None:
    """Replace the block of this file.

    Raises:
        TopolocError: the file cannot be read or written, or has no such block.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise TopolocError(f"cannot read {path}: {error.strerror}") from error
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise TopolocError(f"{path} has no lines {BEGIN} and {END} to write between")
    write_text(path, before + block_of(results) + after)


def _cells(mine: Sequence[Row], others: Sequence[Row]) -> list[str]:
    """The paper's best, then every method by the paper's D_thresh, surf-vlad on topoloc's own
    nodes, and the peers."""
    printed = [row for row in mine if row["paper_m"] is not None and row["method"] != "posenet"]
    cells = [paper_words(min(printed, key=lambda row: row["paper_m"])) if printed else MISSING]
    for method in ("posenet", *LEARNED, "surf-vlad"):
        cells.append(
            _cell(
                [
                    row
                    for row in mine
                    if row["method"] == method and row["nodes"].startswith("D_thresh")
                ]
            )
        )
    own = [row for row in mine if not row["nodes"].startswith("D_thresh")]
    cells.append(
        _cell(own) + (f", {own[0]['ms']:.0f} ms" if own and own[0].get("ms") is not None else "")
    )
    return cells + [_cell([row for row in others if row["peer"] == peer]) for peer in PEERS]


def _cell(rows: Sequence[Row]) -> str:
    return error_words(rows[0]) if rows else MISSING
