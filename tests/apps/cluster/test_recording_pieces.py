"""Test long recordings mapped in pieces: frames, names, worlds, and joins by shared frames."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tiny_world import path_pose
from topoloc.apps.cli import main
from topoloc.apps.cli.mapping.map_jobs import MapJob, PoseOptions, SplitOptions, split_recording
from topoloc.apps.cli.output import UsageError
from topoloc.atlas.atlas import Atlas
from topoloc.geometry.alignment import translation_error
from topoloc.mapping.build import BuildConfig


@pytest.fixture(scope="module")
def long_walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tiny_world import write_stereo_recording

    return write_stereo_recording(
        tmp_path_factory.mktemp("long") / "walk", indices=[float(k) for k in range(10)]
    )


def _making(recording: Path, *trajectory: str) -> MapJob:
    return MapJob((str(recording),), PoseOptions(tuple(trajectory)), BuildConfig())


@pytest.mark.parametrize(
    ("total", "frames", "shared"),
    [(10, 6, 3), (1000, 300, 30), (301, 300, 30), (300, 300, 30), (7, 300, 30), (999, 100, 50)],
)
def test_pieces_cover_all_frames_and_overlap(total: int, frames: int, shared: int):
    ranges = SplitOptions(frames, shared).ranges(total)
    assert ranges[0][0] == 0
    assert ranges[-1][1] == total
    assert all(stop - start == min(frames, total) for start, stop in ranges)
    assert all(stop - start >= shared for (_, stop), (start, _) in pairwise(ranges))
    assert len(ranges) == 1 or len(ranges) - 1 < total / (frames - shared)


def test_the_pieces_of_one_trajectory_are_one_world(long_walk: Path):
    pieces = split_recording(_making(long_walk), "walk", SplitOptions(6, 3))
    assert [making.recordings[0].rpartition("@")[2] for making in pieces.piece_jobs] == [
        "0:6",
        "2:8",
        "4:10",
    ]
    assert [making.pose_options.trajectory for making in pieces.piece_jobs] == [("truth",)] * 3
    assert pieces.world is not None
    assert pieces.world.startswith("walk-")
    assert split_recording(_making(long_walk, "slam"), "walk", SplitOptions(6, 3)).world is None
    whole = split_recording(_making(long_walk), "walk", SplitOptions(10, 3))
    assert [making.recordings for making in whole.piece_jobs] == [(str(long_walk),)]
    assert whole.world is None


def test_a_recording_that_cannot_be_split_is_an_error(long_walk: Path, tmp_path: Path):
    with pytest.raises(UsageError, match="takes whole recordings"):
        split_recording(_making(Path(f"{long_walk}@0::1")), "walk", SplitOptions(6, 3))
    for frames, shared in ((6, 4), (6, 2), (0, 0)):
        with pytest.raises(UsageError, match="successive pieces must share"):
            SplitOptions(frames, shared)
    missing = split_recording(_making(tmp_path / "none"), "none", SplitOptions(6, 3))
    assert len(missing.piece_jobs) == 1
    assert main(["build", str(long_walk), str(tmp_path / "a.topo"), "--split", "6"]) == 2
    for text in ("6,4", "6,", "six", "-6", "6,3,2", "²"):
        assert (
            main(["build", str(long_walk), str(tmp_path / "a"), "--ray", "local", "--split", text])
            == 2
        )
    assert SplitOptions.parse("600") == SplitOptions(600, 60)
    assert SplitOptions.parse("12") == SplitOptions(12, 3)
    assert SplitOptions.parse("600,90") == SplitOptions(600, 90)


def _built(capsys: pytest.CaptureFixture[str], *args: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["build", *(str(arg) for arg in args), "--json", "-"]) == 0
    return json.loads(capsys.readouterr().out)


def test_pieces_by_slam_are_built_joined_and_found_again(
    cluster: Any, long_walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    atlas = tmp_path / "campus"
    args = (
        long_walk,
        atlas,
        "--ray",
        cluster.address,
        "--split",
        "7,3",
        "--features",
        "surf",
        "--trajectory",
        "slam",
    )
    built = _built(capsys, *args)
    assert [(one["tile_id"], one["state"]) for one in built["recordings"]] == [
        ("walk_0-7", "built"),
        ("walk_3-10", "built"),
    ]
    assert [(one["first"], one["second"], one["same_pictures"]) for one in built["tried"]] == [
        ("walk_0-7", "walk_3-10", True)
    ]
    manifest = Atlas.open(str(atlas)).manifest
    assert {tile.in_joint_world.joint for tile in manifest.tiles} == {"walk_0-7"}
    expected = path_pose(0.0).inverse() @ path_pose(
        3.0
    )  # SLAM's worlds are the cameras of the first frames
    assert translation_error(expected, manifest.joins[0].first_from_second) < 0.02
    again = _built(capsys, *args)
    assert [one["state"] for one in again["recordings"]] == ["there", "there"]
    assert again["tried"] == []
