"""Check that the tests' shape checks refuse sizes that contradict the annotations, in functions
and dataclasses."""

from __future__ import annotations

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from topoloc.geometry.alignment import align_points, nearest_rotation
from topoloc.geometry.rigid import Rigid3


def test_one_letter_is_one_size():
    points = np.random.default_rng(0).normal(size=(5, 3))
    assert align_points(points, points).angle() < 1e-6
    with pytest.raises(BeartypeCallHintViolation, match="points_b"):
        align_points(points, points[:4])


def test_arguments_methods_and_dataclasses_are_checked():
    with pytest.raises(BeartypeCallHintViolation, match="correlation"):
        nearest_rotation(np.eye(4))
    with pytest.raises(BeartypeCallHintViolation, match="rotation"):
        Rigid3(np.eye(3)[:2], np.zeros(3))
    with pytest.raises(BeartypeCallHintViolation, match="points"):
        Rigid3(np.eye(3), np.zeros(3)).apply(np.zeros((4, 2)))


def test_a_result_is_of_the_sizes_of_the_arguments():
    pose = Rigid3(np.eye(3), np.zeros(3))
    object.__setattr__(pose, "translation", np.zeros((2, 3)))
    with pytest.raises(BeartypeCallHintViolation, match="return"):
        pose.apply(np.zeros(3))
