"""The page of an evaluation: whole, self-contained, the same twice, and right about what was worst."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from hand_made import MAP_INFO, answer, elsewhere, lost, two_nodes

from topoloc.errors import TopolocError, UnreadableImageError
from topoloc.evaluation.figures import _horizontal_axes, draw_map
from topoloc.evaluation.metrics import Answer, summarize
from topoloc.evaluation.report import worst_queries, write_report

GOOD = [answer(f"good{i}", 0.1 * i, error_m=0.001 * (i + 1), error_deg=0.1) for i in range(9)]
MIXED = [*GOOD, lost("lost", 0.4), answer("far", 0.5, 40.0, 2.0, node_id=1), elsewhere("moon", True), elsewhere("mars", False)]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return _write(tmp_path_factory.mktemp("page") / "report.html", MIXED)


def _write(path: Path, answers: list[Answer]) -> str:
    write_report(path, summarize(answers) | {"map": MAP_INFO}, answers, two_nodes())
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("answers", "num_figures"),
    [
        (GOOD[:1], 4),
        ([lost("lost", 0.4)], 3),
        ([elsewhere("moon", accepted=True)], 2),
        ([elsewhere("mars", accepted=False)], 2),
    ],
    ids=["one", "none localized", "only false", "only elsewhere"],
)
@pytest.mark.filterwarnings("error")
def test_a_page_for_any_outcome(answers: list[Answer], num_figures: int, tmp_path: Path):
    page = _write(tmp_path / "report.html", answers)
    figures = re.findall(r"<svg .*?</svg>", page, re.DOTALL)
    assert len(figures) == num_figures
    for figure in figures:
        ElementTree.fromstring(figure)
        assert "nan" not in figure.lower().replace("nance", "")
    assert "None" not in page
    assert "nan" not in re.sub(r"<svg .*?</svg>|base64,[^\"]*", "", page, flags=re.DOTALL)


def test_the_page_needs_nothing_from_outside_and_is_well_formed(page: str):
    outside = re.findall(r"(?:src|href)=\"(?!data:image/jpeg;base64,|#)[^\"]*\"", page)
    assert outside == []
    assert "two &amp; &lt;more&gt;.topo" in page
    assert "<more>" not in page
    body = page[page.index("<body>") : page.index("</html>")]
    ElementTree.fromstring(re.sub(r"(<img [^>]*)>", r"\1/>", body))


def test_the_same_answers_give_the_same_bytes(page: str, tmp_path: Path):
    assert _write(tmp_path / "again.html", MIXED) == page


def test_numbers_on_the_page_are_those_of_the_evaluation(page: str):
    assert "localized, 10 of 11 queries" in page
    assert "0.55 cm" in page  # the median of 1, 2 ... 9 mm and 40 m
    assert "<b>2</b><span>false accepts</span>" in page
    assert "1 not in map, 1 too few inliers" in page
    assert "1.23 MB" in page


def test_the_worst_come_first():
    worst = worst_queries(MIXED)
    assert [a.query for a in worst] == ["far", "moon", "lost", "good8", "good7", "good6"]
    assert worst_queries([elsewhere("mars", accepted=False)]) == []


def test_the_worst_are_shown_beside_the_node_they_were_matched_with(page: str):
    articles = re.findall(r"<article>.*?</article>", page, re.DOTALL)
    assert len(articles) == 6
    (far,) = [article for article in articles if "walk/far" in article]
    assert "node 1" in far
    assert "nearest to the truth is node 0" in far
    assert "off by 40.00 m, 2.00°" in far
    assert far.count("data:image/jpeg;base64,") == 2


def test_a_picture_that_is_gone_leaves_a_gap(tmp_path: Path):
    def gone() -> np.ndarray:
        raise UnreadableImageError("far.png: no such picture")

    without = Answer("far", MIXED[10].result, MIXED[10].world_from_cam, 0, "walk", gone)
    assert "query: no picture" in _write(tmp_path / "report.html", [without])


def test_many_marks_become_one_picture(page: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("topoloc.evaluation.figures.MAX_MARKS", 10)
    assert "data:image/png" in draw_map(MIXED, two_nodes())
    assert "data:image/png" not in page


@pytest.mark.parametrize(
    ("down", "across", "up", "is_mirrored"),
    [([0.0, 1.0, 0.0], 2, 0, True), ([0.0, 0.1, -0.9], 1, 0, True), ([0.0, 0.2, 0.1], 2, 1, False)],
    ids=["y down", "z up", "no agreement"],
)
def test_the_map_is_seen_from_above(down: list[float], across: int, up: int, is_mirrored: bool):
    points = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    axes = _horizontal_axes(points, np.array([down, down]))
    assert axes == (across, up, is_mirrored)


def test_nothing_is_left_where_the_page_cannot_be_written(tmp_path: Path):
    with pytest.raises(TopolocError, match="cannot write"):
        _write(tmp_path / "nowhere" / "report.html", [elsewhere("mars", accepted=False)])
    (tmp_path / "folder").mkdir()
    with pytest.raises(TopolocError, match="cannot write"):
        _write(tmp_path / "folder", [elsewhere("mars", accepted=False)])
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
