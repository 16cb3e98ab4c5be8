"""Test the page of an evaluation: complete, self-contained, deterministic, with the right
worst queries."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hand_made import MAP_INFO, answer, elsewhere, lost, pose, two_nodes
from topoloc.apps.report.map_figure import (
    MapFigure,
    _insert_gaps,
    draw_map,
    find_horizontal_axes,
)
from topoloc.apps.report.report import (
    render_gallery,
    select_typical_queries,
    select_worst_queries,
    write_report,
)
from topoloc.apps.report.report_tables import PublishedResult, ReportTexts
from topoloc.errors import TopolocError, UnreadableImageError
from topoloc.evaluation.metrics import EvaluatedQuery, summarize
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization

GOOD = [answer(f"good{i}", 0.1 * i, error_m=0.001 * (i + 1), error_deg=0.1) for i in range(9)]
MIXED = [
    *GOOD,
    lost("lost", 0.4),
    answer("far", 0.5, 40.0, 2.0, node_id=1),
    elsewhere("moon", True),
    elsewhere("mars", False),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return _write(tmp_path_factory.mktemp("page") / "report.html", MIXED)


def _write(path: Path, answers: list[EvaluatedQuery]) -> str:
    write_report(path, summarize(answers) | {"map": MAP_INFO}, answers, two_nodes())
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("answers", "num_figures"),
    [
        (GOOD[:1], 5),
        ([lost("lost", 0.4)], 3),
        ([elsewhere("moon", accepted=True)], 2),
        ([elsewhere("mars", accepted=False)], 2),
    ],
    ids=["one", "none localized", "only false", "only elsewhere"],
)
@pytest.mark.filterwarnings("error")
def test_a_page_for_any_outcome(answers: list[EvaluatedQuery], num_figures: int, tmp_path: Path):
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
    assert "<b>2</b><span>false accepts, of 13 images</span>" in page
    assert "1 not in map, 1 too few inliers" in page
    assert "<th>Largest error</th><td>40.00 m, 2.00°</td>" in page
    assert "largest 40 m" in page or "largest 4e+03 cm" in page
    assert "1 position is outside of the figure. Arrows name the distance" in page
    assert "1.23 MB" in page
    hard = page[page.index("Where it is hard") : page.index("The place")]
    assert hard.count('<td data-column="quarter by">inliers</td>') == 4


def test_the_worst_come_first():
    worst = select_worst_queries(MIXED)
    assert [a.query for a in worst] == ["far", "moon", "lost", "good8", "good7", "good6"]
    assert select_worst_queries([elsewhere("mars", accepted=False)]) == []


def test_the_worst_are_shown_beside_the_node_they_were_matched_with(page: str):
    articles = re.findall(
        r"<article>.*?</article>", page[page.index("The worst answers") :], re.DOTALL
    )
    assert len(articles) == 6
    (far,) = [article for article in articles if "walk/far" in article]
    assert "node 1" in far
    assert "nearest to the truth is node 0" in far
    assert re.search(r"off by 40.00 m, 2.00°, 16\d\d\.\d standard deviations", far)
    assert far.count("data:image/jpeg;base64,") == 1


def _moved(x: float, step: tuple[float, float, float]) -> Rigid3:
    return Rigid3(pose(x).rotation, pose(x).translation + np.array(step))


NODES = [pose(0.0), pose(1.0)]  # in the plan 1 m by 0.5 m, of x and z


@pytest.mark.parametrize("step", [(0.4, 0.0, 0.0), (0.0, 0.0, -0.9), (-1.0, 0.0, 0.9)])
def test_an_answer_beside_the_map_is_in_the_plan(step: tuple[float, float, float]):
    with MapFigure(NODES, [], 1.0, [_moved(0.5, step)]) as figure:
        assert figure.draw_arrows([pose(0.5)], [_moved(0.5, step)]) == 0
        figure.plot([_moved(0.5, step)], marker="x")
        (mark,) = figure.axes.lines
        (place,) = figure.flatten([_moved(0.5, step)])
        np.testing.assert_array_equal(mark.get_xydata()[0], place)
        assert np.all(place > figure.low)
        assert np.all(place < figure.high)


@pytest.mark.parametrize(
    ("step", "text"),
    [((40.0, 0.0, 0.0), "40 m"), ((0.0, 0.0, -3.0), "3.0 m"), ((-3.0, 0.0, 4.0), "5.0 m")],
)
def test_an_arrow_points_to_an_answer_far_from_the_map(step: tuple[float, float, float], text: str):
    with MapFigure(NODES, [], 1.0, [_moved(0.5, step)]) as figure:
        assert (figure.high - figure.low).max() < 1.2, "the map is as large as without it"
        assert figure.draw_arrows([pose(0.5)], [_moved(0.5, step)]) == 1
        figure.plot([_moved(0.5, step)])
        assert len(figure.axes.lines) == 0
        (arrow,) = figure.axes.texts
        assert arrow.get_text() == text
        start, end = figure.flatten([pose(0.5), _moved(0.5, step)])
        gaps = np.abs(np.concatenate([figure.low - arrow.xy, figure.high - arrow.xy]))
        assert gaps.min() < 1e-9, "its tip is at the edge"
        way = (np.array(arrow.xy) - start) / np.linalg.norm(np.array(arrow.xy) - start)
        np.testing.assert_allclose(way, (end - start) / np.linalg.norm(end - start), atol=1e-9)
        tail = np.array(arrow.get_position())
        stem = arrow.xy - tail
        np.testing.assert_allclose(stem / np.linalg.norm(stem), way, atol=1e-9)


def test_every_answer_outside_of_the_plan_is_counted():
    far = [answer(f"far{i}", 0.5 + 0.01 * i, 30.0 + 5.0 * i, 1.0) for i in range(3)]
    moon = elsewhere("moon", accepted=True)
    assert isinstance(moon.result, Localization)
    away = replace(moon, result=replace(moon.result, world_from_cam=_moved(1.0, (12.0, 5.0, 0.0))))
    plan = draw_map([*GOOD, *far, moon, away], two_nodes())
    texts = re.findall(r"<!-- (.*?) -->", plan)
    assert "3 answers, 30 m to 40 m" in texts
    assert "13 m" in texts, "from the nearest node, because the image has no true position"
    assert any(text.startswith("4 positions are outside of the figure.") for text in texts)


@pytest.mark.parametrize("x", [0.0, 100.0])
def test_the_deviation_shown_is_the_cameras_own_wherever_the_world_begins(x: float):
    asked = answer("a", x, 0.0, 0.0)
    assert isinstance(asked.result, Localization)
    adjoint = asked.result.world_from_cam.adjoint()
    result = replace(asked.result, covariance=adjoint @ (1e-4 * np.eye(6)) @ adjoint.T)
    assert "standard deviation 1.73 cm" in render_gallery(
        [replace(asked, result=result)], two_nodes()
    )


def test_a_picture_that_is_gone_leaves_a_gap(tmp_path: Path):
    def gone() -> np.ndarray:
        raise UnreadableImageError("far.png: no such picture")

    without = EvaluatedQuery("far", MIXED[10].result, MIXED[10].world_from_cam, 0, "walk", gone)
    assert "image cannot be read any more" in _write(tmp_path / "report.html", [without])


def test_many_marks_become_one_picture(page: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("topoloc.apps.report.map_figure.MAX_MARKS", 10)
    assert "data:image/png" in draw_map(MIXED, two_nodes())
    assert "data:image/png" not in page


def _night(answers: list[EvaluatedQuery]) -> list[EvaluatedQuery]:
    return [replace(a, recording="night & rain") for a in answers]


def test_each_recording_has_its_row_its_colour_and_its_curve(tmp_path: Path):
    night = _night([answer("n0", 0.2, 0.03, 1.0), answer("n1", 0.3, 0.05, 2.0), lost("n2", 0.6)])
    page = _write(tmp_path / "report.html", [*GOOD, *night, elsewhere("mars", accepted=False)])
    rows = re.findall(r"<tr><td[^>]*><i.*?</tr>", page, re.DOTALL)
    assert [re.sub(r"<[^>]*>", " ", row).split()[0] for row in rows] == ["walk", "night", "moon"]
    assert all(text in rows[0] for text in ("9 of 9", "0.50 cm, 0.10°", "100 %"))
    assert all(
        text in rows[1]
        for text in ("night &amp; rain", "2 of 3", "4.00 cm, 1.50°", "67 %", ">0</span> of 3")
    )
    assert "out-of-map images" in rows[2]
    colours = [re.findall(r"background:(#\w+)", row) for row in rows]
    assert colours[0] != colours[1]
    assert colours[2] == []
    for figure in re.findall(r"<svg .*?</svg>", page, re.DOTALL)[:3]:
        assert all(colour[0] in figure for colour in colours[:2])
    assert "localized, 9 of 9 queries, walk" in page, "the headline is that of the first recording"
    assert (
        "<b>66.7 %</b><span>localized, night &amp; rain, the hardest of the others</span>" in page
    )


def test_words_and_published_figures_stand_on_the_page(tmp_path: Path):
    words = ReportTexts(
        title="A <title>",
        paragraphs=["What the night costs."],
        about={"walk": "by day"},
        published=[PublishedResult("elsewhere", 0.0202, 0.35)],
    )
    write_report(
        tmp_path / "report.html", summarize(MIXED) | {"map": MAP_INFO}, MIXED, two_nodes(), words
    )
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<h1>A &lt;title&gt;</h1>" in page
    assert '<p class="lead">What the night costs.</p>' in page
    assert "<span>by day</span>" in page
    assert "2.02 cm, 0.35°" in page


def test_a_hard_recording_leaves_places_for_the_worst_of_the_others():
    hard = _night([answer(f"n{i}", 0.1 * i, 3.0 + i, 1.0) for i in range(9)])
    worst = select_worst_queries([*GOOD, *hard])
    assert [a.query for a in worst] == ["n8", "n7", "n6", "good8", "good7", "good6"]


def test_the_typical_query_is_that_of_the_median_error():
    typical = select_typical_queries(
        [
            *GOOD,
            *_night([lost("n0", 0.0), lost("n1", 0.1), lost("n2", 0.2)]),
            elsewhere("mars", accepted=False),
        ]
    )
    assert [a.query for a in typical] == ["good4", "n1", "mars"]


def test_the_path_is_broken_where_the_recording_jumps():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [20.0, 0.0], [21.0, 0.0]])
    broken = _insert_gaps(path)
    assert np.flatnonzero(np.isnan(broken[:, 0])).tolist() == [3]
    np.testing.assert_array_equal(broken[~np.isnan(broken[:, 0])], path)
    np.testing.assert_array_equal(_insert_gaps(path[:1]), path[:1])


@pytest.mark.parametrize(
    ("down", "across", "up", "is_mirrored"),
    [([0.0, 1.0, 0.0], 2, 0, True), ([0.0, 0.1, -0.9], 1, 0, True), ([0.0, 0.2, 0.1], 2, 1, False)],
    ids=["y down", "z up", "no agreement"],
)
def test_the_map_is_seen_from_above(down: list[float], across: int, up: int, is_mirrored: bool):
    points = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    axes = find_horizontal_axes(points, np.array([down, down]))
    assert axes == (across, up, is_mirrored)


def test_nothing_is_left_where_the_page_cannot_be_written(tmp_path: Path):
    with pytest.raises(TopolocError, match="cannot write"):
        _write(tmp_path / "nowhere" / "report.html", [elsewhere("mars", accepted=False)])
    (tmp_path / "folder").mkdir()
    with pytest.raises(TopolocError, match="cannot write"):
        _write(tmp_path / "folder", [elsewhere("mars", accepted=False)])
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]
