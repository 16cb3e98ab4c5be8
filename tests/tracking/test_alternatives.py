"""Test streams along a wall of equal panels: alternatives are kept until motion or a unique
place decides."""

from __future__ import annotations

import numpy as np
import pytest
from panel_wall import STEP, Walk

from topoloc.localization.result import Localization, NotLocalized
from topoloc.tracking.stream_result import StreamedPose

PANELS = (2.0, -1.0, 0.0, 1.0)
"""Possible offsets of an image that shows only panels. The truth is third."""


def is_right(answer: StreamedPose, walk: Walk) -> bool:
    assert isinstance(answer.result, Localization)
    assert answer.smoothed is not None
    return (
        max(
            abs(pose.translation[0] - walk.x)
            for pose in (answer.result.world_from_cam, answer.smoothed)
        )
        < 0.1
    )


@pytest.mark.parametrize("has_odometry", [True, False])
def test_after_a_unique_place_the_motion_decides(has_odometry: bool):
    walk = Walk(has_odometry)
    for _ in range(4):
        assert walk.see(0.0).state == "localized"
    for _ in range(12):
        answer = walk.see(*PANELS)
        assert answer.state == "localized"
        assert is_right(answer, walk)


def test_before_it_no_pose_is_claimed_and_all_are_named():
    walk = Walk()
    for _ in range(5):
        answer = walk.see(*PANELS)
        line = answer.to_json("7")
        assert line["state"] == line["reason"] == "ambiguous"
        assert not line["localized"]
        assert line["smoothed"] is None
        assert "world_from_cam" not in line
        probabilities = [one["probability"] for one in line["alternatives"]]
        assert probabilities == sorted(probabilities, reverse=True)
        assert 0.8 < sum(probabilities) <= 1.0
        offsets = [one["world_from_cam"]["translation"][0] - walk.x for one in line["alternatives"]]
        assert min(map(abs, offsets)) < 0.02, "the true one is among them"
    for _ in range(2):
        answer = walk.see(0.0)
        assert answer.state == "localized"
        assert is_right(answer, walk)
    for _ in range(4):
        assert is_right(walk.see(*PANELS), walk)


def test_the_motion_selects_the_only_alternative_that_moves_like_the_camera():
    walk, rng = Walk(), np.random.default_rng(1)
    answers = [walk.see(*rng.uniform(-9.0, 9.0, 2), 0.0) for _ in range(10)]
    assert [answer.state for answer in answers[:2]] == ["ambiguous"] * 2
    assert is_right(answers[-1], walk)


@pytest.mark.parametrize("num_wrong", [1, 2])
def test_a_certain_pose_one_panel_off_is_refused(num_wrong: int):
    walk = Walk()
    for _ in range(4):
        walk.see(0.0)
    wrong = [walk.see(1.0) for _ in range(num_wrong)]
    assert [answer.state for answer in wrong] == ["predicted", "ambiguous"][:num_wrong]
    assert wrong[0].to_json("")["reason"] == "jump"
    assert wrong[0].smoothed is not None
    assert abs(wrong[0].smoothed.translation[0] - STEP * 4) < 0.1
    last = [walk.see(0.0) for _ in range(3)][-1]
    assert last.state == "localized"
    assert is_right(last, walk)


def test_a_stream_that_began_one_panel_off_is_corrected():
    walk = Walk()
    assert not is_right(walk.see(1.0), walk)
    assert walk.see(0.0).state == "ambiguous"
    for _ in range(3):
        answer = walk.see(0.0)
        assert answer.state == "localized"
        assert is_right(answer, walk)


def test_an_uncertain_pose_waits_for_the_next_image():
    walk = Walk()
    walk.wall.probability = 0.8
    first = walk.see(0.0)
    assert first.state == "ambiguous"
    assert isinstance(first.result, NotLocalized)
    assert first.result.detail == "too little speaks for this pose so far"
    assert [round(one.probability, 2) for one in first.result.alternatives] == [0.8]
    second = walk.see(0.0)
    assert second.state == "localized"
    assert is_right(second, walk)


@pytest.mark.parametrize(("num_seen", "state"), [(1, "ambiguous"), (4, "predicted")])
def test_images_without_a_pose_lower_a_weak_belief(num_seen: int, state: str):
    walk = Walk()
    walk.wall.probability = 0.93
    assert [walk.see(0.0).state for _ in range(num_seen)] == ["localized"] * num_seen
    assert walk.see().state == state


def test_a_camera_that_was_carried_elsewhere_is_found():
    walk = Walk()
    for _ in range(4):
        walk.see(0.0)
    answers = [walk.see(30.0) for _ in range(4)]
    assert [answer.state for answer in answers] == [
        "predicted",
        "ambiguous",
        "localized",
        "localized",
    ]
    assert answers[-1].smoothed is not None
    assert abs(answers[-1].smoothed.translation[0] - walk.x - 30.0) < 0.1


def test_pictures_that_miss_the_true_pose_are_bridged():
    walk = Walk()
    for _ in range(4):
        walk.see(0.0)
    answer = walk.see(2.0, -1.0, 3.0)
    assert answer.state == "predicted"
    assert isinstance(answer.result, NotLocalized)
    assert answer.result.reason == "ambiguous"
    assert is_right(walk.see(*PANELS), walk)


def test_a_single_predicted_pose_is_searched_alone():
    walk = Walk()
    for _ in range(4):
        walk.see(0.0)
    before = walk.wall.num_asked
    walk.see(*PANELS)
    assert walk.wall.num_asked == before + 1
