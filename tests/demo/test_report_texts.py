"""Check that the demo's texts follow from its results."""

from __future__ import annotations

from typing import Any

import pytest

from topoloc.demo.recordings import describe_night, describe_out_of_map


def _row(
    name: str, num: int, localized: int, false: int = 0, num_elsewhere: int = 0
) -> dict[str, Any]:
    reasons = {"not_in_map": num - localized} if num > localized else {}
    medians = {
        "median_translation_m": 0.012 if localized else None,
        "median_rotation_deg": 0.3 if localized else None,
        "max_translation_m": 0.061 if localized else None,
    }
    return {
        "name": name,
        "num_queries": num,
        "num_localized": localized,
        "false_accepts": false,
        "num_elsewhere": num_elsewhere,
        "not_localized": reasons,
        **medians,
    }


@pytest.mark.parametrize(
    ("night", "said"),
    [
        (_row("night", 40, 40), "100 % of 40 images get a pose, by day 100 %; the median error is 1.20 cm and 0.30 degrees instead of 1.20 cm"),  # noqa: E501
        (_row("night", 40, 30), '75 % of 40 images get a pose, by day 100 %; the median error is 1.20 cm and 0.30 degrees instead of 1.20 cm and 0.30 '  # noqa: E501
         'degrees. 10 are not localized (10 not in map). No pose is wrong by more than 0.5 m'),
        (_row("night", 40, 0), '0 % of 40 images get a pose, by day 100 %. 40 are not localized (40 not in map). No pose is wrong by more than 0.5 m or 10 degrees.'),  # noqa: E501
        (_row("night", 40, 39, false=1), '1 is not localized (1 not in map). 1 pose is '
         'wrong by more than 0.5 m or 10 degrees. The largest error by night is 6.1 cm.'),
    ],
    ids=["as by day", "some lost", "all lost", "one wrong"],
)  # fmt: skip
def test_the_errors_by_night_are_reported_as_measured(night: dict[str, Any], said: str):
    assert said in describe_night({"recordings": [_row("day", 20, 20), night]})


@pytest.mark.parametrize(("false", "said"), [(0, "none gets a pose"), (2, "2 wrongly get a pose")])
def test_wrong_acceptances_are_reported(false: int, said: str):
    evaluation = {
        "num_elsewhere": 30,
        "recordings": [_row("day", 20, 20), _row("elsewhere", 0, 0, false, 30)],
    }
    assert said in describe_out_of_map(evaluation)
