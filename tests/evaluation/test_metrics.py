"""Test the figures of evaluations with known results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hand_made import answer, elsewhere, lost
from topoloc.apps.viewer.result_files import read_results
from topoloc.evaluation.metrics import EvaluatedQuery, find_quarters, summarize
from topoloc.localization.result import Localization

ANSWERS = [
    answer("a", 0.0, error_m=0.01, error_deg=0.1),
    answer("b", 0.5, error_m=0.03, error_deg=3.0),
    answer("c", 1.0, error_m=0.2, error_deg=1.0, first_candidate=1),
    answer("d", 1.5, error_m=0.04, error_deg=11.0),
    answer("e", 2.0, error_m=0.6, error_deg=0.5),
    lost("f", 2.5),
    lost("g", 3.0, "not_in_map"),
    lost("h", 3.5),
]


def test_errors_are_those_put_in():
    assert ANSWERS[1].translation_m == pytest.approx(0.03)
    assert ANSWERS[1].rotation_deg == pytest.approx(3.0)
    assert [a.is_false_accept for a in ANSWERS] == [
        False,
        False,
        False,
        True,
        True,
        False,
        False,
        False,
    ]


def test_counts_medians_and_recall():
    evaluation = summarize(ANSWERS)
    assert (evaluation["num_queries"], evaluation["num_localized"]) == (8, 5)
    assert evaluation["median_translation_m"] == pytest.approx(0.04)
    assert evaluation["median_rotation_deg"] == pytest.approx(1.0)
    assert evaluation["recall"] == {
        "0.05m_5deg": 2 / 8,
        "0.25m_2deg": 2 / 8,
        "0.5m_5deg": 3 / 8,
        "5m_10deg": 4 / 8,
    }
    assert evaluation["topological_accuracy"] == 4 / 8
    assert evaluation["false_accepts"] == 2
    assert evaluation["not_localized"] == {"not_in_map": 1, "too_few_inliers": 2}
    assert evaluation["num_elsewhere"] == 0
    assert evaluation["max_translation_m"] == pytest.approx(0.6)
    assert evaluation["max_rotation_deg"] == pytest.approx(11.0)
    assert evaluation["num_inaccurate"] == 3  # 3 degrees, 11 degrees, 0.6 m


def test_errors_are_compared_with_their_standard_deviations():
    exact = answer("a", 0.0, error_m=0.03, error_deg=0.0)  # a standard deviation of 1 cm each
    assert exact.error_over_sigma == pytest.approx(3.0 / np.sqrt(6.0))
    assert np.isnan(lost("b", 0.0).error_over_sigma)
    inside, outside = (answer("c", 0.0, error_m=m, error_deg=0.0) for m in (0.0354, 0.0356))
    assert summarize([inside, exact, outside])["num_outside_ellipsoid"] == 1  # 3.548 sigmas


def _posed(num_inliers: int, error_m: float = 0.0, **more: float) -> EvaluatedQuery:
    """Return a pose with standard deviations of 1 cm each and half of this many percent as p."""
    one = answer(str(num_inliers), 0.0, error_m=error_m, error_deg=0.0)
    assert isinstance(one.result, Localization)
    found = replace(one.result, num_inliers=num_inliers, probability=num_inliers / 200)
    return replace(one, result=found, **more)


def test_the_hardest_quarter_does_not_hide_behind_the_average():
    easy = [_posed(100 + n, angle_deg=60.0 - n, light_ratio=1.0) for n in range(6)]
    hard = [_posed(10, 0.3, angle_deg=1.0), _posed(20, 0.1, angle_deg=50.0)]
    nowhere = [lost("f", 0.0), elsewhere("moon", accepted=True)]
    quarters = find_quarters([*easy, *nowhere, *hard])
    by_inliers, by_angle = quarters[:4], quarters[4:]
    assert [one.by for one in quarters] == ["inliers"] * 4 + ["angle"] * 4  # six have a light
    hardest = by_inliers[0]
    assert (hardest.hardest, hardest.easiest, hardest.num_poses) == (10.0, 20.0, 2)
    assert (hardest.num_right, hardest.num_inside) == (1, 0)
    assert hardest.mean_probability == pytest.approx(0.075)
    assert hardest.median_position_sigma_m == pytest.approx(0.01 * np.sqrt(3.0), rel=0.05)
    assert all(one.num_right == one.num_inside == 2 for one in by_inliers[1:])
    assert (by_angle[0].hardest, by_angle[-1].easiest) == (60.0, 1.0)
    assert find_quarters(easy) == []  # too few to tell


def test_poses_for_images_from_elsewhere_are_false_and_nothing_else_changes():
    before = summarize(ANSWERS)
    evaluation = summarize(
        [*ANSWERS, elsewhere("moon", accepted=True), elsewhere("mars", accepted=False)]
    )
    assert evaluation["num_elsewhere"] == 2
    assert evaluation["false_accepts"] == before["false_accepts"] + 1
    for key in (
        "num_queries",
        "num_localized",
        "median_translation_m",
        "recall",
        "topological_accuracy",
    ):
        assert evaluation[key] == before[key]


def test_times_are_medians_over_all_queries():
    evaluation = summarize(
        [elsewhere("x", accepted=False), elsewhere("y", accepted=False), lost("f", 0.0)]
    )
    assert evaluation["median_times_ms"]["features"] == 30.0
    assert evaluation["median_times_ms"]["total"] == 41.0
    assert evaluation["median_times_ms"]["pnp"] == 0.0  # two of three never came so far


@pytest.mark.parametrize(
    "answers",
    [[lost("f", 0.0)], [elsewhere("moon", accepted=False)]],
    ids=["none localized", "no truth"],
)
def test_unknown_values_are_null_and_never_nan(answers: list):
    evaluation = summarize(answers)
    assert evaluation["median_translation_m"] is None
    assert evaluation["median_rotation_deg"] is None
    json.dumps(evaluation, allow_nan=False)


def test_each_recording_is_judged_alone_too():
    night = [replace(a, recording="night") for a in ANSWERS[:2]]
    evaluation = summarize([*ANSWERS, *night, elsewhere("moon", accepted=True)])
    rows = evaluation["recordings"]
    assert [row["name"] for row in rows] == ["walk", "night", "moon"]
    for row, answers in zip(rows, (ANSWERS, night), strict=False):
        alone = summarize(answers)
        assert {key: value for key, value in row.items() if key != "name"} == {
            k: v for k, v in alone.items() if k != "recordings"
        }
    assert (rows[2]["num_queries"], rows[2]["num_elsewhere"], rows[2]["false_accepts"]) == (0, 1, 1)
    assert sum(row["num_queries"] for row in rows) == evaluation["num_queries"]


def test_an_answer_is_written_with_its_truth_and_read_again(tmp_path: Path):
    asked = [answer("a", 0.3, 0.02, 0.5), lost("b", 0.4), elsewhere("c", accepted=False)]
    (tmp_path / "evaluation.json").write_text(
        json.dumps({"answers": [one.to_json() for one in asked]})
    )
    walk, moon = read_results(tmp_path / "evaluation.json")
    assert [one["query"] for one in walk.answers] == ["a", "b"]
    assert [one["query"] for one in moon.answers] == ["c"]
    a, b = walk.answers
    apart = np.subtract(a["world_from_cam"]["translation"], a["true_world_from_cam"]["translation"])
    assert np.linalg.norm(apart) == pytest.approx(0.02)
    assert b["true_world_from_cam"] is not None
    assert moon.answers[0]["true_world_from_cam"] is None
