"""Check that errors of one rigid transform are distinguished from pose errors."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc.evaluation.metrics import EvaluatedQuery, fit_worlds
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization, NotLocalized

MAP_FROM_TRUTH = Rigid3.exp(np.array([3.0, -1.0, 0.5, 0.1, -0.2, 0.3]))


def answers(
    map_from_truth: Rigid3, noise: float, num_wrong: int = 0, num: int = 20
) -> list[EvaluatedQuery]:
    """Return poses along a straight path, each with an error of `noise` (metres, radians), some at
    random places, and one refusal."""
    rng, found = (
        np.random.default_rng(0),
        [EvaluatedQuery("none", NotLocalized("not_in_map"), Rigid3.identity(), recording="walk")],
    )
    for number in range(num):
        true = Rigid3.exp(np.array([0.2 * number, 0.0, 0.0, 0.0, 0.1 * np.sin(number), 0.0]))
        off = Rigid3.exp(rng.normal(size=6) * (5.0 if number < num_wrong else noise))
        pose = off @ map_from_truth @ true
        found.append(
            EvaluatedQuery(
                f"{number}",
                Localization(pose, np.eye(6) * 1e-4, 0.99, 0, [], 50, 40),
                true,
                recording="walk",
            )
        )
    return found


def test_another_world_is_found_though_some_answers_are_wrong():
    fit = fit_worlds(answers(MAP_FROM_TRUTH, 0.003, num_wrong=6))
    assert fit is not None
    assert (fit.recording, fit.num_answers, fit.num_localized) == ("walk", 14, 20)
    np.testing.assert_allclose(fit.map_from_truth.matrix(), MAP_FROM_TRUTH.matrix(), atol=0.01)
    assert fit.median_translation_m < 0.02
    assert fit.to_json()["map_from_truth"] == fit.map_from_truth.matrix().tolist()


@pytest.mark.parametrize(
    "found",
    [
        answers(Rigid3.identity(), 0.01),
        answers(Rigid3.identity(), 0.01, num_wrong=9),
        answers(Rigid3.identity(), 3.0),
        answers(MAP_FROM_TRUTH, 0.01, num=4),
        answers(MAP_FROM_TRUTH, 0.01, num_wrong=15),
    ],
    ids=["right", "some wrong", "all wrong", "too few", "most wrong"],
)
def test_errors_that_are_errors_are_left_alone(found: list[EvaluatedQuery]):
    assert fit_worlds(found) is None
