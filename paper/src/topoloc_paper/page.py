"""The benchmark as one page to show, and its figures as files: every table and figure of the paper,
ours beside theirs."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from topoloc.apps.report.figures import draw_error_curves
from topoloc.apps.report.map_figure import draw_map
from topoloc.apps.report.page_template import STYLE, page_style, svg_text
from topoloc.apps.report.report import (
    render_gallery,
    select_typical_queries,
    select_worst_queries,
)
from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.atomic import write_bytes, write_text
from topoloc_paper import picture_figures
from topoloc_paper.asking import Way, answers
from topoloc_paper.datasets import Dataset
from topoloc_paper.drawings import draw_node_sweep, draw_stage_times, draw_topological_accuracy
from topoloc_paper.maps import MapKind, path_of
from topoloc_paper.settings import Bench
from topoloc_paper.text_tables import TABLES, about

_STYLE = """
.page { max-width: 1240px; }
.results { min-width: 860px; font-size: 13.5px; }
.results th { width: auto; font-size: 13px; }
.results td:last-child { min-width: 200px; }
.results td { padding: 5px 14px 5px 0; }
h3 { margin: 22px 0 6px; font-size: 15px; font-weight: 600; }
img.figure { display: block; width: 100%; height: auto; margin: 6px 0 22px; }
.results td:first-child, .results .short { white-space: nowrap; }
"""
_EXPLANATIONS = {
    "accuracy": (
        "Median errors over what was localized; in brackets how many of how many queries those are."
        " PoseNet always answers. Each learned network names its weights; topoloc's surf-vlad needs"
        " none. The paper's column is what it printed for its own recordings of such a place, which"
        " are not ours."
    ),
    "normalization": (
        "The same maps and queries without patch normalisation, with the paper's and topoloc's. "
        "The paper claims about 20 % on real data. Only SURF features are used here."
    ),
    "nodes": (
        "Eq. 1's D_thresh from low to high: more nodes cost bytes and buy accuracy until the fine"
        " step is what limits it."
    ),
    "speed": (
        "Medians; the whole query with its quartiles. All coarse localizers were asked each picture"
        " in turn. The paper's machine had a GPU."
    ),
    "peers": (
        "All have the same recordings, poses, retrieval and queries. A pose further off than 0.5 m"
        " or 10° counts as far off, one for an image from another place as accepted from elsewhere."
        " Installed is the distribution with all that it needs."
    ),
    "ablation": (
        "One thing is changed at a time, everything else stays as it is: "
        "what moves the error is where it comes from. "
        "Compare the row without a second match with the row of SURF alone."
    ),
    "targets": (
        "What was asked for, the best that was reached with the paper's number of nodes, and what"
        " topoloc does by itself."
    ),
}


class _Files:
    """Writes each figure into a folder and gives it back as HTML."""

    def __init__(self, bench: Bench) -> None:
        self._folder = bench.out / "figures"
        self._folder.mkdir(parents=True, exist_ok=True)

    def drawn(self, name: str, figure: Figure) -> str:
        """As SVG and PNG; on the page stands the SVG."""
        with matplotlib.rc_context(STYLE):
            self._png(name, figure)
            return self.svg(name, svg_text(figure, name))

    def photo(self, name: str, figure: Figure) -> str:
        """As PNG, on the page as JPEG: a figure that is pictures."""
        with matplotlib.rc_context(STYLE):
            self._png(name, figure)
            buffer = io.BytesIO()
            figure.savefig(buffer, format="jpg", dpi=130, pil_kwargs={"quality": 85})
        encoded = base64.b64encode(buffer.getvalue()).decode("ascii")
        return f'<img class="figure" src="data:image/jpeg;base64,{encoded}" alt="{escape(name)}">'

    def svg(self, name: str, text: str) -> str:
        write_text(
            self._folder / f"{name}.svg",
            text.replace("<svg ", '<svg xmlns:svg="http://www.w3.org/2000/svg" ', 1),
        )
        return f'<div class="wide">{text}</div>'

    def _png(self, name: str, figure: Figure) -> None:
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=130, metadata={"Software": None})
        write_bytes(self._folder / f"{name}.png", buffer.getvalue())


def write_page(bench: Bench, results: Mapping[str, Any]) -> None:
    """Write `report.html` and the folder `figures`.

    Raises:
        TopolocError: a file cannot be written.
    """
    files = _Files(bench)
    style = page_style() + _STYLE
    sections = [_section("What this is", "", f"<p>{escape(about(results)).replace('`', '')}</p>")]
    sections += [
        _table_section(results, "targets"),
        _table_section(results, "accuracy", _accuracy_figures(files, results)),
    ]
    sections += [
        _dataset_section(bench, files, dataset) for dataset in (*bench.rendered, *bench.real)
    ]
    sections += [_against_posenet(bench, files), _light_section(bench, files, results)]
    sections.append(
        _table_section(
            results,
            "nodes",
            files.drawn("nodes", draw_node_sweep(results["nodes"])) if results.get("nodes") else "",
        )
    )
    timed = [row for row in results.get("speed", []) if not row.get("missing")]
    sections.append(
        _table_section(
            results, "speed", files.drawn("times", draw_stage_times(timed)) if timed else ""
        )
    )
    sections += [_table_section(results, "peers"), _table_section(results, "ablation")]
    title = "The paper's experiments, made again"
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    )
    subtitle = (
        "Roussel et al., Deep-Geometric 6 DoF Localization from a Single Image in Topo-metric Maps"
    )
    body = "\n".join(
        [_cards(results), *filter(None, sections), "<footer>Written by topoloc.</footer>"]
    )
    header = f'<header><div class="page"><h1>{title}</h1><p>{subtitle}</p></div></header>'
    page = (
        "<!DOCTYPE html>\n<html"
        f' lang="en"><head>{head}\n<title>{title}</title>\n<style>\n{style}</style></head><body>\n{header}\n'  # noqa: E501
    )
    write_text(bench.out / "report.html", f'{page}<div class="page">{body}</div></body></html>\n')


def _section(title: str, explanation: str, content: str) -> str:
    return (
        f"<section><h2>{escape(title)}</h2>"
        + (f"<p>{escape(explanation)}</p>" if explanation else "")
        + f"{content}</section>"
    )


def _table_section(results: Mapping[str, Any], name: str, figure: str = "") -> str:
    if not results.get(name):
        return ""
    title, table = TABLES[name]
    return _section(title, _EXPLANATIONS[name], figure + table(results[name]).html())


def _cards(results: Mapping[str, Any]) -> str:
    shown = []
    for row in results.get("targets", []):
        reached = row["reached"] or row["reached_by_own_nodes"]
        best = row["best"] if row["reached"] or not reached else row["own_nodes"]
        value = (
            f"{100 * best['median_translation_m']:.1f} cm"
            if best["median_translation_m"] < 1
            else f"{best['median_translation_m']:.2f} m"
        )
        asked = (
            f"{100 * row['asked_m']:.1f} cm" if row["asked_m"] < 1 else f"{row['asked_m']:.2f} m"
        )
        words = f"{row['dataset']}, {row['queries']}: median, asked for {asked}"
        shown.append(
            '<div class="card'
            f' {"good" if reached else "bad"}"><b>{value}</b><span>{escape(words)}</span></div>'
        )
    return f'<div class="cards">{"".join(shown)}</div>'


def _accuracy_figures(files: _Files, results: Mapping[str, Any]) -> str:
    rows = [row for row in results["accuracy"] if row.get("topological_accuracy") is not None]
    if not rows:
        return ""
    words = (
        "<h3>Topological accuracy</h3><p>The nearest node named first; paler, it or a neighbour of"
        " it.</p>"
    )
    return words + files.drawn("topological_accuracy", draw_topological_accuracy(rows))


def _own_answers(bench: Bench, dataset: Dataset) -> list[EvaluatedQuery]:
    """Of all recordings, as topoloc answers by itself."""
    way = Way(MapKind.as_topoloc())
    return [answer for label in dataset.queries for answer in answers(bench, dataset, label, way)]


def _dataset_section(bench: Bench, files: _Files, dataset: Dataset) -> str:
    """The place from above, its error curves, a typical query of each recording and the worst ones,
    with their matches."""
    found = _own_answers(bench, dataset)
    topomap = TopoMetricMap.load(path_of(bench, dataset, MapKind.as_topoloc()))
    parts = [files.svg(f"{dataset.name}_from_above", draw_map(found, topomap))]
    curves = draw_error_curves(found) if any(a.result.localized for a in found) else ()
    parts.append(f'<h3>Errors</h3><div class="halves">{"".join(curves)}</div>')
    parts.append(
        "<h3>A typical query of each recording</h3>"
        + render_gallery(select_typical_queries(found), topomap)
    )
    parts.append(
        "<h3>The best and the worst queries</h3>"
        + render_gallery([*_best(found), *select_worst_queries(found, 3)], topomap)
    )
    text = (
        "Topoloc as it comes: own nodes, surf-vlad. Lines join what was matched: green what the"
        " pose (or the truth) explains, red what not."
    )
    return _section(dataset.title, text, "".join(parts))


def _best(found: Sequence[EvaluatedQuery]) -> list[EvaluatedQuery]:
    localized = [a for a in found if a.result.localized and a.translation_m == a.translation_m]
    return sorted(localized, key=lambda a: a.translation_m)[:1]


def _against_posenet(bench: Bench, files: _Files) -> str:
    figures = picture_figures.against_posenet(bench)
    content = "".join(files.drawn(f"posenet_{name}", figure) for name, figure in figures.items())
    text = (
        "Positions from above: the path that was taken, and what PoseNet and topoloc say of each"
        " picture."
    )
    return _section("PoseNet and the deep-geometric localizer", text, content) if content else ""


def _light_section(bench: Bench, files: _Files, results: Mapping[str, Any]) -> str:
    parts = [
        files.photo(name, figure) for name, figure in picture_figures.conditions(bench).items()
    ]
    parts += [
        files.photo(name, figure)
        for name, figure in picture_figures.normalized_pairs(bench).items()
    ]
    if results.get("normalization"):
        parts.append(
            "<h3>With and without</h3>"
            + TABLES["normalization"][1](results["normalization"]).html()
        )
    text = (
        "The same places in other light and weather, and what patch normalisation makes of a pair"
        " of pictures. " + _EXPLANATIONS["normalization"]
    )
    return _section("Light and weather", text, "".join(parts))
