"""The README's table of the paper's experiments: a block between two markers, generated from the results and from nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from topoloc.errors import TopolocError
from topoloc.evaluation.paper.text_tables import MISSING, Row, Table, error_words, paper_words, quality_words
from topoloc.sequences.atomic import write_text

BEGIN, END = "<!-- benchmark paper -->", "<!-- /benchmark paper -->"


def block_of(results: Mapping[str, Any]) -> str:
    """The block with its markers: for every recording PoseNet, the best learned coarse localizer, surf-vlad and the peers."""
    s, m = results["settings"], results["machine"]
    about = (
        f"The paper's experiments, made again by `topoloc benchmark paper`: {quality_words(s)}, {m['cores']} cores of {m['cpu']}. "
        "Medians over the localized queries, and how many those are where not all; the paper's numbers are from its own recordings."
    )
    lines = [cells for row in results.get("accuracy", []) if (cells := _accuracy_cells(row, s["command"]))]
    lines += [cells for row in results.get("peers", []) if (cells := _peer_cells(row, s["command"]))]
    missing = f"\n\nLeft out, since not there: {', '.join(results['missing'])}." if results["missing"] else ""
    columns = ["place, queries", "method (weights)", "median error", "paper", "ms", "command"]
    return f"{BEGIN}\n{about}\n\n{Table(columns, lines).markdown()}{missing}\n{END}"


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


def _accuracy_cells(row: Row, command: str) -> list[str]:
    name = f"{row['method']}, {row['nodes']}" + ("" if row["weights"] == "none needed" else f" ({row['weights']})")
    ms = MISSING if row.get("ms") is None else f"{row['ms']:.0f}"
    return [
        f"{row['dataset']}, {row['queries']}",
        name,
        error_words(row),
        paper_words(row),
        ms,
        f"`{_of_part(command, 'conditions', row)}`",
    ]


def _peer_cells(row: Row, command: str) -> list[str]:
    if row["peer"] == "topoloc":
        return []
    ms = MISSING if row.get("ms") is None else f"{row['ms']:.0f}"
    name = f"{row['peer']}, {row['nodes']}"
    return [f"{row['dataset']}, {row['queries']}", name, error_words(row), MISSING, ms, f"`{_of_part(command, 'peers', row)}`"]


def _of_part(command: str, part: str, row: Row) -> str:
    """The shortest command that makes the row."""
    return command.replace(" paper", f" {'recordings' if row.get('real') else part}", 1)
