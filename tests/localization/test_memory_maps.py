"""Build maps of frames in memory, with and without poses. Invalid images and times raise an error
instead of "not in the map"."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topoloc
from built_room import unseen_views
from topoloc.errors import RecordingError
from topoloc.recordings.open import open_sequence

SURF_ALONE = topoloc.BuildConfig(other_kinds=())


def test_frames_in_memory_give_the_map_of_their_folder(tiny_recording: Path):
    recording = open_sequence(tiny_recording)
    memory = topoloc.MemorySequence([recording[index] for index in range(6)])
    ours, folders = (
        topoloc.build_map(sequence, SURF_ALONE)
        for sequence in (memory, open_sequence(f"{tiny_recording}@0:6"))
    )
    assert len(ours.nodes) == len(folders.nodes)
    for one, other in zip(ours.nodes, folders.nodes, strict=True):
        np.testing.assert_array_equal(one.points_cam, other.points_cam)
    assert ours.sessions[0].poses_from == "given"


def test_without_poses_slam_is_run(tiny_recording: Path):
    recording = open_sequence(tiny_recording)
    frames = [replace(recording[index], world_from_cam=None) for index in range(6)]
    topomap = topoloc.build_map(topoloc.MemorySequence(frames), SURF_ALONE)
    assert topomap.sessions[0].poses_from == "slam"
    true = recording.poses[0].inverse() @ recording.poses[5]
    result = topoloc.Localizer(topomap).localize(recording[5].image, recording[5].camera)
    assert isinstance(result, topoloc.Localization)
    np.testing.assert_allclose(result.world_from_cam.translation, true.translation, atol=0.03)


def test_single_pictures_with_poses(tiny_recording: Path):
    recording = open_sequence(tiny_recording)
    frames = [replace(recording[index], right=None, rig=None) for index in range(len(recording))]
    topomap = topoloc.build_map(topoloc.MemorySequence(frames), SURF_ALONE)
    localizer, errors = topoloc.Localizer(topomap), []
    for image, world_from_cam in unseen_views():
        result = localizer.localize(image, frames[0].camera)
        if isinstance(result, topoloc.Localization):
            errors.append(
                np.linalg.norm(result.world_from_cam.translation - world_from_cam.translation)
            )
    assert len(errors) >= len(unseen_views()) - 1
    assert np.median(errors) < 0.02
    assert max(errors) < 0.1


def test_single_pictures_without_poses_need_more(tiny_recording: Path):
    recording = open_sequence(tiny_recording)
    frames = [
        replace(recording[index], world_from_cam=None, right=None, rig=None) for index in range(3)
    ]
    with pytest.raises(RecordingError, match="SLAM needs stereo pairs or depth images"):
        topoloc.build_map(topoloc.MemorySequence(frames), SURF_ALONE)


def test_images_and_times_of_another_type_are_refused(room_map: Path):
    """The calls run in another process, because the shape checks of the tests would raise first."""
    program = """
import sys, numpy as np, topoloc
localizer = topoloc.Localizer(topoloc.TopoMetricMap.load(sys.argv[1]))
camera = topoloc.Camera.pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
grey = np.zeros((240, 320), np.uint8)
tracker = topoloc.Tracker(localizer)
for call in (
    lambda: localizer.localize(grey / 255.0, camera),
    lambda: localizer.localize(grey.astype(np.uint16), None),
    lambda: localizer.localize([[1, 2]], camera),
    lambda: tracker.process(grey, camera, 0.25),
    lambda: tracker.process(grey[:, :, None], camera, 1),
):
    try:
        call()
    except topoloc.TopolocError as error:
        print(type(error).__name__, error)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(room_map)],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert [line.split()[0] for line in lines] == ["QueryError"] * 5
    for line, says in zip(
        lines,
        ("float64", "16 bits", "not list", "integer nanoseconds, not 0.25", "axis of its own"),
        strict=True,
    ):
        assert says in line
