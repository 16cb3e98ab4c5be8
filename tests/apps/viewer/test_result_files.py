"""Test result files: the content decides the kind, and an invalid line is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from topoloc.apps.viewer.result_files import read_results
from topoloc.errors import TopolocError
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Alternative, Localization, NotLocalized
from topoloc.recordings.trajectory import Trajectory
from topoloc.tracking.stream_result import StreamedPose

FOUND = Localization(
    Rigid3(np.eye(3), np.array([1.0, 2.0, 3.0])),
    1e-4 * np.eye(6),
    0.9,
    4,
    [],
    50,
    40,
    {"total": 9.0},
)
OPEN = NotLocalized(
    "ambiguous",
    alternatives=(
        Alternative(FOUND.world_from_cam, 0.5, 4),
        Alternative(Rigid3.identity(), 0.4, 0),
    ),
)


def test_lines_of_results_and_of_streams(tmp_path: Path):
    streamed = StreamedPose(7, "tracked", FOUND, Rigid3(np.eye(3), np.array([1.0, 2.0, 3.5])))
    path = tmp_path / "night.jsonl"
    path.write_text(
        "\n".join(
            json.dumps(one.to_json(name))
            for name, one in (("a", FOUND), ("b", OPEN), ("c", streamed))
        )
        + "\n"
    )
    (results,) = read_results(path)
    assert results.name == "night"
    a, b, c = results.answers
    assert a == FOUND.to_json("a")
    assert [one["probability"] for one in b["alternatives"]] == [0.5, 0.4]
    assert (c["state"], c["smoothed"]["translation"]) == ("tracked", [1.0, 2.0, 3.5])


def test_one_result_alone(tmp_path: Path):
    (tmp_path / "one.json").write_text(json.dumps(FOUND.to_json("a"), indent=1))
    assert [one["query"] for one in read_results(tmp_path / "one.json")[0].answers] == ["a"]


def test_an_evaluation_has_its_recordings_and_its_truth(tmp_path: Path):
    truth = {"translation": [1.0, 2.0, 3.1], "quat_wxyz": [1.0, 0.0, 0.0, 0.0]}
    answers = [FOUND.to_json("a") | {"recording": "day", "true_world_from_cam": truth}]
    answers += [OPEN.to_json("b") | {"recording": "moon", "true_world_from_cam": None}]
    (tmp_path / "e.json").write_text(json.dumps({"num_queries": 1, "answers": answers}))
    day, moon = read_results(tmp_path / "e.json")
    assert (day.name, moon.name) == ("day", "moon")
    assert day.answers[0]["true_world_from_cam"] == truth
    assert moon.answers[0]["true_world_from_cam"] is None


def test_a_trajectory_is_a_path(tmp_path: Path):
    Trajectory([Rigid3.identity(), FOUND.world_from_cam], [0, 10**9]).write_tum(
        tmp_path / "walk.tum"
    )
    (walk,) = read_results(tmp_path / "walk.tum")
    assert (walk.name, len(walk.answers)) == ("walk", 0)
    np.testing.assert_allclose(walk.path[1].translation, [1.0, 2.0, 3.0])


def _bad(**changes: Any) -> str:
    return json.dumps(FOUND.to_json("a") | changes)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (lambda: json.dumps(FOUND.to_json("a")) + "\n" + _bad(world_from_cam=None), "line 2"),
        (lambda: _bad(covariance=[[1.0]]), "covariance"),
        (
            lambda: _bad(true_world_from_cam={"translation": [0, 0, float("nan")]}),
            "true_world_from_cam",
        ),
        (lambda: json.dumps({"num_queries": 3}), "neither results nor an evaluation"),
        (lambda: "{" * 100_000, "line 1"),
        (lambda: "hello", "columns"),
    ],
    ids=["a second line", "no covariance", "truth of NaN", "no answers", "nested", "text"],
)
def test_an_invalid_result_is_named(text: Callable[[], str], said: str, tmp_path: Path):
    (tmp_path / "x.json").write_text(text())
    with pytest.raises(TopolocError, match=said) as failure:
        read_results(tmp_path / "x.json")
    assert "x.json" in str(failure.value)


def test_unknown_keys_are_dropped(tmp_path: Path):
    (tmp_path / "x.json").write_text(
        json.dumps(replace(FOUND, geopose=None).to_json("<b>") | {"evil": "</script>"})
    )
    (answer,) = read_results(tmp_path / "x.json")[0].answers
    assert "evil" not in answer
