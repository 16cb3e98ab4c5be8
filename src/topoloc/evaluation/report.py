"""An evaluation as one self-contained page: numbers, the map from above, error curves, times, and the worst queries to look at."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from topoloc.errors import UnreadableImageError
from topoloc.evaluation.figures import draw_error_curves, draw_errors_along, draw_map, draw_stage_times
from topoloc.evaluation.metrics import MAX_ROTATION_DEG, MAX_TRANSLATION, Answer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.sequences.atomic import write_text
from topoloc.sequences.frame import Image

NUM_WORST = 6
PICTURE_WIDTH_PX = 480


def write_report(path: Path, evaluation: dict[str, Any], answers: list[Answer], topomap: TopoMetricMap) -> None:
    """Write the page, at once or not at all; the same answers give the same bytes.

    Args:
        evaluation: what `summarize` says of the answers, with what `topoloc info` says of the map under "map".

    Raises:
        TopolocError: the file cannot be written.
    """
    write_text(path, _page(evaluation, answers, topomap))


def worst_queries(answers: Sequence[Answer], count: int = NUM_WORST) -> list[Answer]:
    """False accepts first, then queries without a pose that should have one, then the largest errors."""

    def badness(answer: Answer) -> tuple[int, float]:
        if answer.world_from_cam is None:
            return 2, 0.0
        if isinstance(answer.result, NotLocalized):
            return 1, 0.0
        return 2 * answer.is_false_accept, max(answer.translation_m / MAX_TRANSLATION, answer.rotation_deg / MAX_ROTATION_DEG)

    wrong = [a for a in answers if a.world_from_cam is not None or a.is_false_accept]
    return sorted(wrong, key=badness, reverse=True)[:count]


def _page(evaluation: dict[str, Any], answers: list[Answer], topomap: TopoMetricMap) -> str:
    style = resources.files("topoloc.evaluation").joinpath("report.css").read_text(encoding="utf-8")
    name = escape(Path(evaluation["map"]["path"]).name)
    recordings = escape(", ".join(dict.fromkeys(a.recording for a in answers if a.recording)) or "no recordings")
    sections = [_numbers(evaluation), _map_section(answers, topomap)]
    if evaluation["num_queries"]:
        sections += [_curves_section(evaluation, answers), _along_section(answers)]
    if evaluation["median_times_ms"]:
        sections.append(_times_section(answers))
    sections += [_worst_section(answers, topomap), _config_section(evaluation)]
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    header = f'<header><div class="page"><h1>Localization in {name}</h1><p>Asked about: {recordings}</p></div></header>'
    body = "\n".join([_cards(evaluation), *sections, "<footer>Written by topoloc evaluate.</footer>"])
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}\n<title>Localization in {name}</title>\n<style>\n{style}</style></head><body>\n'
        f'{header}\n<div class="page">{body}</div></body></html>\n'
    )


def _section(title: str, explanation: str, content: str) -> str:
    return f"<section><h2>{title}</h2><p>{explanation}</p>{content}</section>"


def _cards(e: dict[str, Any]) -> str:
    cards = []
    if e["num_queries"]:
        share = 100 * e["num_localized"] / e["num_queries"]
        cards.append(("", f"{share:.1f} %", f"localized, {e['num_localized']} of {e['num_queries']} queries"))
    if e["num_localized"]:
        cards.append(("", _length(e["median_translation_m"]), "median position error"))
        cards.append(("", f"{e['median_rotation_deg']:.2f}°", "median rotation error"))
    if not e["num_queries"]:
        cards.append(("", str(e["num_elsewhere"]), "images from elsewhere"))
    cards.append(
        ("bad" if e["false_accepts"] else "good", str(e["false_accepts"]), "false accept" if e["false_accepts"] == 1 else "false accepts")
    )
    if "total" in e["median_times_ms"]:
        cards.append(("", f"{e['median_times_ms']['total']:.0f} ms", "a query, median"))
    return (
        '<div class="cards">'
        + "".join(f'<div class="card {kind}"><b>{b}</b><span>{text}</span></div>' for kind, b, text in cards)
        + "</div>"
    )


def _numbers(e: dict[str, Any]) -> str:
    rows = [("Queries with truth", f"{e['num_queries']}, localized {e['num_localized']}")] if e["num_queries"] else []
    for name, share in e["recall"].items():
        if share is not None:
            metres, degrees = name.removesuffix("deg").split("m_")
            rows.append((f"Within {_length(float(metres), digits=0)} and {degrees}°", f"{100 * share:.1f} % of all queries"))
    if e["topological_accuracy"] is not None:
        rows.append(("Nearest node named first", f"{100 * e['topological_accuracy']:.1f} %"))
    if e["num_elsewhere"]:
        rows.append(("Images from elsewhere", str(e["num_elsewhere"])))
    rows.append(("False accepts", str(e["false_accepts"])))
    reasons = [f"{count} {reason.replace('_', ' ')}" for reason, count in e["not_localized"].items()]
    rows.append(("Not localized, why", ", ".join(reasons) or "none"))
    m = e["map"]
    about_map = [
        ("Map", f"{m['num_nodes']} nodes, {m['num_points']:,} points"),
        ("Size", f"{m['bytes'] / 1e6:.2f} MB"),
        ("Mapped", f"{m['length_m']:.1f} m of trajectory"),
        ("Extent", " × ".join(f"{extent:.1f}" for extent in m["extent_m"]) + " m"),
        ("From", ", ".join(m["recordings"])),
        ("Coarse localizers", ", ".join(m["coarse"])),
    ]
    about_map += [(f"Median ms, {stage.replace('_', ' ')}", f"{ms:.1f}") for stage, ms in e["median_times_ms"].items() if stage == "total"]
    false = f"A false accept is a pose for an image from elsewhere, or one off by more than {MAX_TRANSLATION:g} m or {MAX_ROTATION_DEG:g}°."
    shares = "Shares are of all queries with a known pose: one that got none counts as a miss. " if e["num_queries"] else ""
    return _section("The numbers", shares + false, f'<div class="columns">{_table(rows)}{_table(about_map)}</div>')


def _table(rows: list[tuple[str, str]]) -> str:
    return "<table>" + "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows) + "</table>"


def _map_section(answers: list[Answer], topomap: TopoMetricMap) -> str:
    text = "Seen from above. A tick at a node shows where its camera looked; lines lead from true to estimated positions."
    return _section("The map from above", text, draw_map(answers, topomap))


def _curves_section(evaluation: dict[str, Any], answers: list[Answer]) -> str:
    text = "The height of a curve is the share of all queries whose error is at most that much; it ends where no more queries have a pose."
    return _section("How large are the errors?", text, draw_error_curves(answers)) if evaluation["num_localized"] else ""


def _along_section(answers: list[Answer]) -> str:
    text = "Every query in the order of its recording; errors on a logarithmic scale."
    return _section("Where do errors occur?", text, draw_errors_along(answers))


def _times_section(answers: list[Answer]) -> str:
    text = "Bars are medians; the line ends where 95 % of the queries are done. The total includes what lies between the stages."
    return _section("Where does the time go?", text, draw_stage_times(answers))


def _worst_section(answers: list[Answer], topomap: TopoMetricMap) -> str:
    worst = worst_queries(answers)
    if not worst:
        return _section("The worst queries", "There are none: no image from elsewhere was given a pose.", "")
    text = "False accepts first, then queries without a pose, then the largest errors. Left the query, right the node it was matched with."
    return _section("The worst queries", text, '<div class="queries">' + "".join(_query(a, topomap) for a in worst) + "</div>")


def _query(answer: Answer, topomap: TopoMetricMap) -> str:
    result = answer.result
    node_id = result.node_id if isinstance(result, Localization) else result.candidates[0].node_id if result.candidates else None
    node = None if node_id is None else topomap.nodes[node_id]
    template = _picture(node.template_jpeg if node else None, f"node {node_id}" if node else "no node")
    evidence = f"{result.num_inliers} inliers of {result.num_matches} matches"
    if isinstance(result, Localization):
        sigma = float(np.sqrt(max(np.trace(result.covariance[:3, :3]), 0.0)))
        evidence += f", probability {result.probability:.2f}, its own standard deviation {_length(sigma)}"
    if answer.nearest_node_id is not None and answer.nearest_node_id != node_id:
        evidence += f"; nearest to the truth is node {answer.nearest_node_id}"
    kind = "good" if result.localized and not answer.is_false_accept else "bad"
    title = escape(f"{answer.recording}/{answer.query}" if answer.recording else answer.query)
    return (
        f'<article><div class="pictures">{_picture(_query_jpeg(answer), "query")}{template}</div>'
        f'<div class="facts"><b>{title}</b><p class="{kind}">{_verdict(answer)}</p><p>{evidence}</p></div></article>'
    )


def _verdict(answer: Answer) -> str:
    if isinstance(answer.result, NotLocalized):
        return f"not localized: {answer.result.reason.replace('_', ' ')}"
    if answer.world_from_cam is None:
        return "false accept: this image was not taken here"
    error = f"{_length(answer.translation_m)}, {answer.rotation_deg:.2f}°"
    return f"false accept: off by {error}" if answer.is_false_accept else f"off by {error}"


def _query_jpeg(answer: Answer) -> bytes | None:
    """The query's picture, read again and made small; None where it cannot be had any more."""
    try:
        image = answer.read_image() if answer.read_image else None
    except UnreadableImageError:
        return None
    return None if image is None else _small_jpeg(image)


def _small_jpeg(image: Image) -> bytes:
    height, width = image.shape[:2]
    if width > PICTURE_WIDTH_PX:
        image = cv2.resize(image, (PICTURE_WIDTH_PX, max(round(height * PICTURE_WIDTH_PX / width), 1)), interpolation=cv2.INTER_AREA)
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _picture(jpeg: bytes | None, caption: str) -> str:
    if jpeg is None:
        return f'<figure><div class="none">{escape(caption)}: no picture</div></figure>'
    source = "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")
    return f'<figure><img src="{source}" alt="{escape(caption)}"><figcaption>{escape(caption)}</figcaption></figure>'


def _config_section(evaluation: dict[str, Any]) -> str:
    text = escape(json.dumps(evaluation["map"]["config"], indent=1, sort_keys=True))
    return f"<section><details><summary>The configuration that the map was built with</summary><pre>{text}</pre></details></section>"


def _length(metres: float, digits: int | None = None) -> str:
    """Metres for people: in cm below one."""
    if metres >= 1.0:
        return f"{metres:.{2 if digits is None else digits}f} m"
    return f"{100 * metres:.{(2 if metres < 0.1 else 1) if digits is None else digits}f} cm"
