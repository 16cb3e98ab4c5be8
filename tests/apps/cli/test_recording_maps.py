"""What decides what a map looks like, as one digest."""

from __future__ import annotations

import os
import pickle
from dataclasses import replace
from pathlib import Path

import pytest

from topoloc.apps.cli.output import UsageError
from topoloc.apps.cli.recording_maps import MapMaking, PosesAsked
from topoloc.errors import RecordingError
from topoloc.mapping.build import BuildConfig
from topoloc.slam.slam import SlamConfig


@pytest.fixture
def making(recording: Path) -> MapMaking:
    return MapMaking((str(recording),), PosesAsked(), BuildConfig(), SlamConfig())


def test_it_stays_where_it_is_sent(making: MapMaking):
    assert (
        pickle.loads(pickle.dumps(making)).digest() == making.digest() == replace(making).digest()
    )


def test_whatever_decides_changes_it(
    making: MapMaking, recording: Path, monkeypatch: pytest.MonkeyPatch
):
    poses = recording / "other.tum"
    poses.write_text("0 0 0 0 0 0 0 1\n")
    digests = [
        making.digest(),
        replace(making, recordings=(f"{recording}@0:5",)).digest(),
        replace(making, build=BuildConfig(max_node_points=500)).digest(),
        replace(making, camera="500,500,160,120").digest(),
        replace(making, asked=PosesAsked(("slam",))).digest(),
        replace(making, asked=PosesAsked((str(poses),))).digest(),
    ]
    poses.write_text("0 1 1 1 0 0 0 1\n0 0 0 0 0 0 0 1\n")
    digests.append(replace(making, asked=PosesAsked((str(poses),))).digest())
    picture = next((recording / "image_0").iterdir())
    os.utime(picture, ns=(1, 1))
    digests.append(making.digest())
    picture.unlink()
    digests.append(making.digest())
    monkeypatch.setattr("topoloc.__version__", "9.9", raising=False)
    digests.append(making.digest())
    assert len(set(digests)) == len(digests)


def test_no_such_recording(making: MapMaking, tmp_path: Path):
    with pytest.raises(RecordingError, match="no such file"):
        replace(making, recordings=(str(tmp_path / "nothing@0:5"),)).digest()


def test_one_each(making: MapMaking):
    three = replace(making, recordings=("a", "b", "c"))
    assert [one.recordings for one in three.one_each()] == [("a",), ("b",), ("c",)]
    given = [
        one.asked.trajectory for one in replace(three, asked=PosesAsked(("x", "y", "z"))).one_each()
    ]
    assert given == [("x",), ("y",), ("z",)]
    assert [
        one.asked.trajectory for one in replace(three, asked=PosesAsked(("slam",))).one_each()
    ] == [("slam",)] * 3
    with pytest.raises(UsageError, match="3 recordings but 2 trajectories"):
        replace(three, asked=PosesAsked(("x", "y"))).one_each()
