"""Check that recordings with poses in different world frames are refused, and that recordings of
one world pass."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from room_frames import FrameList, stereo_frame
from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.map_facts.map_building import build_map, check_common_world
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import with_poses

ONE_FROM_TWO = Rigid3(exp_so3(np.array([0.1, -0.7, 0.2])), np.array([2.0, -1.0, 0.5]))


def walked(start: float, name: str, seed: int = 0) -> FrameList:
    return FrameList([stereo_frame(start + 0.4 * k, seed) for k in range(6)], name)


def moved(sequence: StereoSequence, a_from_b: Rigid3) -> StereoSequence:
    poses = [None if pose is None else a_from_b @ pose for pose in sequence.poses]
    return with_poses(sequence, poses)


def test_one_world_is_confirmed():
    assert check_common_world([walked(0.0, "one"), walked(0.2, "two")]) == []


def test_a_world_of_its_own_is_named_with_the_transform():
    apart = moved(walked(0.2, "two"), ONE_FROM_TWO.inverse())
    with pytest.raises(TrajectoryError, match=r"two: .* not in the world of one: 6 of 6") as caught:
        check_common_world([walked(0.0, "one"), apart])
    numbers = str(caught.value).partition("one_from_two = ")[2].partition(" ")[0].split(",")
    found = [float(number) for number in numbers]
    assert np.linalg.norm(np.array(found[:3]) - ONE_FROM_TWO.translation) < 0.05


def test_another_place_is_noted_without_a_fault():
    (note,) = check_common_world([walked(0.0, "one"), walked(0.0, "two", seed=3)])
    assert "two: no picture shows a place of one" in note


def test_single_images_confirm_one_world():
    one, two = (
        FrameList([replace(f, right=None, rig=None) for f in of.frames], of.name)
        for of in (walked(0.0, "one"), walked(0.2, "two"))
    )
    assert check_common_world([one, two]) == []


def test_recordings_of_two_sessions_are_refused_before_mapping(shared: Path):
    case = shared / "cases" / "turn3" / "two_worlds"
    with pytest.raises(TrajectoryError, match="topoloc update"):
        build_map([case / "one", case / "two"])


def test_real_sessions_share_a_world_only_after_their_transform(shared: Path):
    lab = shared / "data" / "zed_lab"
    one, two = open_sequence(lab / "session1"), open_sequence(lab / "session2@0:98")
    with pytest.raises(TrajectoryError, match="session2: its poses are not in the world of sess"):
        check_common_world([one, two])
    fitted = json.loads((lab / "session1_from_session2.json").read_text(encoding="utf-8"))
    (matrix,) = [value for value in fitted.values() if np.shape(value) == (4, 4)]
    one_from_two = Rigid3.from_matrix(np.array(matrix))
    assert check_common_world([one, moved(two, one_from_two)]) == []
