"""Test the digest of a map job, which covers all inputs that decide the map."""

from __future__ import annotations

import os
import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from topoloc.apps.cli.mapping.map_jobs import MapJob, PoseOptions
from topoloc.apps.cli.output import UsageError
from topoloc.errors import RecordingError
from topoloc.mapping.build import BuildConfig


@pytest.fixture
def making(recording: Path) -> MapJob:
    return MapJob((str(recording),), PoseOptions(), BuildConfig())


def test_the_digest_survives_pickling(making: MapJob):
    assert (
        pickle.loads(pickle.dumps(making)).digest() == making.digest() == replace(making).digest()
    )


def test_each_input_changes_the_digest(
    making: MapJob, recording: Path, monkeypatch: pytest.MonkeyPatch
):
    poses = recording / "other.tum"
    poses.write_text("0 0 0 0 0 0 0 1\n")
    digests = [
        making.digest(),
        replace(making, recordings=(f"{recording}@0:5",)).digest(),
        replace(making, build=BuildConfig(other_kinds=())).digest(),
        replace(making, camera="500,500,160,120").digest(),
        replace(making, pose_options=PoseOptions(("slam",))).digest(),
        replace(making, pose_options=PoseOptions((str(poses),))).digest(),
    ]
    poses.write_text("0 1 1 1 0 0 0 1\n0 0 0 0 0 0 0 1\n")
    digests.append(replace(making, pose_options=PoseOptions((str(poses),))).digest())
    picture = next((recording / "image_0").iterdir())
    os.utime(picture, ns=(1, 1))
    digests.append(making.digest())
    picture.unlink()
    digests.append(making.digest())
    monkeypatch.setattr("topoloc.apps.cli.mapping.map_jobs.version", lambda _: "9.9")
    digests.append(making.digest())
    assert len(set(digests)) == len(digests)


def test_no_such_recording(making: MapJob, tmp_path: Path):
    with pytest.raises(RecordingError, match="no such file"):
        replace(making, recordings=(str(tmp_path / "nothing@0:5"),)).digest()


def test_jobs_are_split_by_recording(making: MapJob):
    three = replace(making, recordings=("a", "b", "c"))
    assert [one.recordings for one in three.split_by_recording()] == [("a",), ("b",), ("c",)]
    given = [
        one.pose_options.trajectory
        for one in replace(three, pose_options=PoseOptions(("x", "y", "z"))).split_by_recording()
    ]
    assert given == [("x",), ("y",), ("z",)]
    assert [
        one.pose_options.trajectory
        for one in replace(three, pose_options=PoseOptions(("slam",))).split_by_recording()
    ] == [("slam",)] * 3
    with pytest.raises(UsageError, match="3 recordings but 2 trajectories"):
        replace(three, pose_options=PoseOptions(("x", "y"))).split_by_recording()
