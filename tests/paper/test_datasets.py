"""Test the datasets of the benchmark: the commands that render them, and which
recordings are complete."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import tyro

from topoloc.recordings.trajectory import Trajectory
from topoloc_paper import datasets
from topoloc_paper.datasets import (
    RENDERED,
    PaperRecording,
    at_hand,
    is_complete,
    quick_datasets,
    real_datasets,
)
from topoloc_worlds import simulate
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.layout import Layout, prepare
from topoloc_worlds.recorder import _settings
from topoloc_worlds.routes import frame_poses, plan_route
from topoloc_worlds.worlds import find_world

TINY = PaperRecording("lab_day", "lab", spacing=3.0, lateral=0.1, take=1, mono=True)


@pytest.mark.parametrize("recording", RENDERED, ids=lambda recording: recording.name)
@pytest.mark.parametrize("draft", [False, True])
def test_simulate_with_the_same_words_has_the_same_settings(recording: PaperRecording, draft: bool):
    command = tyro.cli(
        simulate.Command, args=[*recording.words.split(), *(["--draft"] if draft else [])]
    )
    assert find_condition(command.condition) == find_condition(recording.condition)
    assert command._config(find_world(recording.world)) == recording.config(draft)


def _begun(folder: Path, draft: bool) -> Layout:
    """Write all files of TINY except its images, as the recorder does at the start."""
    pytest.importorskip("mitsuba", reason="the recorder stores Mitsuba's version")
    world, config = find_world(TINY.world), TINY.config(draft)
    route = plan_route(world.loop, world.camera_height, config.route)
    layout = Layout(folder, config.camera, config.baseline)
    settings = _settings(world, find_condition(TINY.condition), config, "llvm", route)
    prepare(layout, settings, Trajectory(frame_poses(route), route.t_ns), False)
    return layout


def test_a_recording_is_complete_with_its_last_picture_and_of_one_quality(tmp_path: Path):
    layout = _begun(tmp_path / "lab_day", draft=True)
    world = find_world(TINY.world)
    num = plan_route(world.loop, world.camera_height, TINY.config(True).route).num_frames
    for index in range(num):
        assert not is_complete(TINY, layout.folder, draft=True)
        layout.pictures(index)["left"].touch()
    assert is_complete(TINY, layout.folder, draft=True)
    assert not is_complete(TINY, layout.folder, draft=False)
    assert not is_complete(replace(TINY, take=2), layout.folder, draft=True)


def test_complete_datasets_are_kept_and_missing_recordings_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    there = {"lab_map", "lab_night", "corridor_day"}
    monkeypatch.setattr(
        datasets, "is_complete", lambda recording, folder, draft: recording.name in there
    )
    kept, missing = at_hand(datasets.rendered_datasets(tmp_path), tmp_path, False)
    assert [(dataset.name, list(dataset.queries)) for dataset in kept] == [("lab", ["night"])]
    assert set(missing) == {recording.name for recording in RENDERED} - there


def test_the_quick_lab_can_be_opened_anywhere():
    (lab,) = quick_datasets()
    assert sum(len(sequence) for sequence in lab.open_mapping()) > 50
    assert all(pose is not None for label in lab.queries for pose in lab.open_queries(label).poses)


def test_real_recordings_are_the_existing_ones(shared: Path, tmp_path: Path):
    assert real_datasets(tmp_path) == []
    found = real_datasets(shared / "data")
    assert [dataset.name for dataset in found] == ["kitchen", "zed-lab", "kitti-1", "kitti-2"]
    zed = found[1]
    assert len(zed.open_queries("session 2")) == 99
    assert 0.0 < zed.map_from_query_truth().angle() < 1.0
