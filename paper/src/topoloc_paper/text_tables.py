"""The tables for people: columns and cells, as Markdown (the file beside the JSON, the README) or
as HTML (the report)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from topoloc.evaluation.metrics import format_length

Row = Mapping[str, Any]
MISSING = "–"
SHORT = 28


def markdown_of(results: Mapping[str, Any]) -> str:
    """Every table that is in the results, each under its own heading."""
    parts = [f"# The paper's experiments\n\n{about(results)}"]
    for name, (title, table) in TABLES.items():
        if results.get(name):
            parts.append(f"## {title}\n\n{table(results[name]).markdown()}")
    return "\n\n".join(parts) + "\n"


def about(results: Mapping[str, Any]) -> str:
    """Describe the command, the machine and the weights of a run."""
    s, m = results["settings"], results["machine"]
    of_words: dict[str, list[str]] = {}
    for method, words in s["weights"].items():
        of_words.setdefault(words, []).append(method)
    weights = "; ".join(f"{words} ({', '.join(methods)})" for words, methods in of_words.items())
    missing = (
        f" Recordings not there, and left out: {', '.join(results['missing'])}."
        if results["missing"]
        else ""
    )
    return (
        f"`{s['command']}`, {quality_words(s)}, {m['cores']} cores of {m['cpu']}. Weights:"
        f" {weights}; cnn-fc is trained for at most {s['epochs']} epochs, PoseNet for"
        f" {s['posenet_epochs']}.{missing} Errors are medians over the localized queries; the"
        " paper's numbers are from its own recordings, not from these."
    )


def quality_words(settings: Mapping[str, Any]) -> str:
    """Which recordings were used."""
    return (
        "the demo's recordings"
        if settings["quick"]
        else f"recordings of {settings['quality']} quality"
    )


@dataclass(frozen=True)
class Table:
    """Columns and lines of cells, all of them plain text."""

    columns: Sequence[str]
    lines: Sequence[Sequence[str]]

    def markdown(self) -> str:
        rows = [self.columns, ["---"] * len(self.columns), *self.lines]
        return "\n".join("| " + " | ".join(row) + " |" for row in rows)

    def html(self) -> str:
        """Return HTML for the report's style sheet. A first cell equal to the one above is left
        empty."""
        head = "".join(f"<th>{escape(column)}</th>" for column in self.columns)
        body, above = "", ""
        for first, *rest in self.lines:
            shown = "" if first == above else f"<b>{escape(first)}</b>"
            body += f"<tr><td>{shown}</td>" + "".join(_html_cell(cell) for cell in rest) + "</tr>"
            above = first
        return (
            '<div class="wide"><table'
            f' class="results"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )


def _html_cell(cell: str) -> str:
    """Short cells stay on one line."""
    return f"<td{' class=short' if len(cell) <= SHORT else ''}>{escape(cell)}</td>"


def error_words(row: Row) -> str:
    """Median error, and how many of all queries it is the median of."""
    if row.get("missing"):
        return f"not run: {row['missing']}"
    if row.get("median_translation_m") is None:
        return f"none of {row['num_queries']} localized"
    found = f"{format_length(row['median_translation_m'])}, {row['median_rotation_deg']:.2f}°"
    return (
        found
        if row["num_localized"] == row["num_queries"]
        else f"{found} ({row['num_localized']} of {row['num_queries']})"
    )


def paper_words(row: Row) -> str:
    """Return the paper's figure for the same case."""
    return (
        MISSING
        if row.get("paper_m") is None
        else f"{format_length(row['paper_m'])}, {row['paper_deg']:.2f}°"
    )


def percent(value: float | None) -> str:
    return MISSING if value is None else f"{100 * value:.0f} %"


def accuracy_table(rows: Sequence[Row]) -> Table:
    """Table I and II: a line for each method."""
    lines = []
    for row in rows:
        near = (
            f"{percent(row.get('topological_accuracy'))} / {percent(row.get('neighbour_accuracy'))}"
        )
        place = f"{row['dataset']}, {row['queries']}"
        lines.append(
            [
                place,
                f"{row['method']}, {row['nodes']}",
                error_words(row),
                paper_words(row),
                near,
                row["weights"],
            ]
        )
    return Table(
        ["place, queries", "method", "ours", "paper", "node right / or a neighbour", "weights"],
        lines,
    )


def normalization_table(rows: Sequence[Row]) -> Table:
    """A line for each recording: without, the paper's, topoloc's."""
    places = dict.fromkeys((row["dataset"], row["queries"]) for row in rows)
    lines = []
    for place in places:
        mine = {
            row["normalization"]: row for row in rows if (row["dataset"], row["queries"]) == place
        }
        paper, none = mine["paper"], mine["none"]
        gain = MISSING
        if paper["median_translation_m"] and none["median_translation_m"]:
            gain = (
                f"{100 * (1 - paper['median_translation_m'] / none['median_translation_m']):+.0f} %"
            )
        lines.append(
            [
                ", ".join(place),
                *(error_words(mine[kind]) for kind in ("none", "paper", "wide")),
                gain,
            ]
        )
    return Table(
        [
            "place, queries",
            "none",
            "17x17 (the paper's)",
            "65x65 (topoloc's)",
            "error taken off by the paper's",
        ],
        lines,
    )


def nodes_table(rows: Sequence[Row]) -> Table:
    """A line for each D_thresh."""
    lines = [
        [
            f"{row['dataset']}, {row['queries']}",
            f"{row['d_thresh']:g} m",
            str(row["num_nodes"]),
            f"{row['bytes'] / 1e6:.1f} MB ({row['node_bytes'] / 1e6:.1f} of them nodes)",
            error_words(row),
        ]
        for row in rows
    ]
    return Table(["place, queries", "D_thresh", "nodes", "map", "median error"], lines)


def speed_table(rows: Sequence[Row]) -> Table:
    """Table III: medians and quartiles, milliseconds."""
    lines = []
    for row in rows:
        if row.get("missing"):
            lines.append(
                [row["dataset"], row["method"], f"not run: {row['missing']}", "", "", "", "", ""]
            )
            continue
        q = {
            stage: [1e3 * value for value in values] for stage, values in row["quartiles_s"].items()
        }
        rest = [a + b for a, b in zip(q["features"], q["matching"], strict=True)]
        fine = [a + b for a, b in zip(rest, q["pnp"], strict=True)]
        total, paper = q["total"], row["paper_s"]
        cells = [f"{values[1]:.1f}" for values in (q["coarse"], q["patch_normalization"], fine)]
        spread = f"{total[1]:.0f} ({total[0]:.0f} to {total[2]:.0f})"
        load = MISSING if row.get("load") is None else f"{row['load']:.1f}"
        lines.append(
            [
                row["dataset"],
                row["method"],
                *cells,
                spread,
                f"{1e3 * paper:.0f}" if paper else MISSING,
                load,
            ]
        )
    columns = [
        "place",
        "coarse",
        "CNN + NN",
        "patch norm.",
        "SURF + PnP",
        "total (quartiles)",
        "paper's total",
        "load meanwhile",
    ]
    return Table(columns, lines)


def peers_table(rows: Sequence[Row]) -> Table:
    """A line for each peer and recording."""
    lines = []
    for row in rows:
        name = f"{row['peer']}, {row['nodes']}"
        size = (
            MISSING if row["installed_bytes"] is None else f"{row['installed_bytes'] / 1e6:.0f} MB"
        )
        if row.get("missing"):
            lines.append(
                [
                    f"{row['dataset']}, {row['queries']}",
                    name,
                    f"not run: {row['missing']}",
                    "",
                    "",
                    "",
                    "",
                    size,
                ]
            )
            continue
        localized = f"{row['num_localized']} of {row['num_queries']}"
        false = (
            f"{row['far_off']} far off, {row['accepted']} of {row['num_elsewhere']} from elsewhere"
        )
        ms, megabytes = f"{row['ms']:.0f}", f"{row['map_bytes'] / 1e6:.1f} MB"
        place = f"{row['dataset']}, {row['queries']}"
        lines.append(
            [
                place,
                name,
                error_words(row).partition(" (")[0],
                localized,
                false,
                ms,
                megabytes,
                size,
            ]
        )
    return Table(
        [
            "place, queries",
            "peer",
            "median error",
            "localized",
            "false accepts",
            "ms",
            "map",
            "installed",
        ],
        lines,
    )


def ablation_table(rows: Sequence[Row]) -> Table:
    """A line for each change."""
    lines = [
        [f"{r['dataset']}, {r['queries']}", r["part"] or MISSING, r["change"], error_words(r)]
        for r in rows
    ]
    return Table(["place, queries", "part", "change", "median error"], lines)


def targets_table(rows: Sequence[Row]) -> Table:
    """A line for each target."""
    lines = []
    for row in rows:
        asked = format_length(row["asked_m"]) + (
            f", {row['asked_deg']:.2f}°" if row["asked_deg"] is not None else ""
        )
        verdict = (
            "reached"
            if row["reached"]
            else "reached with topoloc's own nodes"
            if row["reached_by_own_nodes"]
            else "missed"
        )
        best, own = (
            f"{error_words(row[key])}, {row[key]['method']}" for key in ("best", "own_nodes")
        )
        ms = "reached" if row["ms_reached"] else "missed: " + ", ".join(row["slow"])
        lines.append(
            [
                f"{row['dataset']}, {row['queries']}",
                asked,
                best,
                own,
                verdict,
                f"{row['asked_ms']:.0f} ms: {ms}",
                row["helps"],
            ]
        )
    columns = [
        "place, queries",
        "asked for",
        "best by the paper's D_thresh",
        "own nodes",
        "verdict",
        "a query",
        "what would help most",
    ]
    return Table(columns, lines)


TABLES: dict[str, tuple[str, Callable[[Sequence[Row]], Table]]] = {
    "targets": ("What had to be reached", targets_table),
    "accuracy": ("Tables I and II: accuracy", accuracy_table),
    "normalization": ("Patch normalisation", normalization_table),
    "nodes": ("Number of nodes", nodes_table),
    "speed": ("Table III: milliseconds a stage", speed_table),
    "peers": ("Others on the same maps", peers_table),
    "ablation": ("Where the error comes from", ablation_table),
}
