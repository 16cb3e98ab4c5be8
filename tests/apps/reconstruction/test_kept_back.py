"""Test the check of a map by runs of its own images."""

from __future__ import annotations

import pytest

from built_room import built_room, recorded_room
from topoloc.apps.reconstruction.kept_back import check_kept_back
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import SequenceView, StereoSequence
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[TopoMetricMap, StereoSequence]:
    recording = recorded_room(tmp_path_factory.mktemp("room") / "seq")
    return built_room(recording), open_sequence(recording)


def test_right_poses(mapped: tuple[TopoMetricMap, StereoSequence]):
    told, warned = list[str](), list[str]()
    check_kept_back(mapped[0], [mapped[1]], told.append, warned.append)
    assert warned == []
    assert "of 12 images localized without their run's nodes" in told[0]


def test_poses_at_another_place(mapped: tuple[TopoMetricMap, StereoSequence]):
    topomap, sequence = mapped
    poses = [pose and Rigid3(pose.rotation, pose.translation + 1.0) for pose in sequence.poses]
    moved = SequenceView(sequence, list(range(len(sequence))), poses)
    told, warned = list[str](), list[str]()
    check_kept_back(topomap, [moved], told.append, warned.append)
    assert told == []
    assert "12 at another place" in warned[0]


def test_a_map_of_one_run_is_not_judged(mapped: tuple[TopoMetricMap, StereoSequence]):
    topomap, sequence = mapped
    poses = [pose if k < 3 else None for k, pose in enumerate(sequence.poses)]
    told = list[str]()
    few = SequenceView(sequence, list(range(len(sequence))), poses)
    check_kept_back(topomap, [few], told.append, told.append)
    assert told == []
