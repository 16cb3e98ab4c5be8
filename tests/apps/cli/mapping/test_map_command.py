"""Test `topoloc map`: the map grows while its recording is replayed or written."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from built_room import unseen_views
from tiny_world import path_pose, write_stereo_recording
from topoloc import Localization, Localizer, TopoMetricMap, open_sequence
from topoloc.apps.cli import main
from topoloc.apps.formats.recording_writer import RecordingWriter
from topoloc.geometry.alignment import absolute_trajectory_errors
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.storage.integrity_check import find_map_damage

Complaint = Callable[..., str]
THERE = [float(index) for index in np.linspace(0.0, 13.0, 54)]
OPTIONS = ("--piece", "30", "--features", "surf")


def record_walk(folder: Path, indices: list[float]) -> Path:
    """Write a recording without ground truth, with twenty stereo pairs per second."""
    write_stereo_recording(folder, indices=indices)
    (folder / "truth.tum").unlink()
    (folder / "times.txt").write_text("".join(f"{k / 20:.9f}\n" for k in range(len(indices))))
    return folder


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of 107 stereo pairs that goes along the path and back."""
    return record_walk(tmp_path_factory.mktemp("walk") / "room", [*THERE, *THERE[-2::-1]])


def errors_m(path: Path, world_from_map: Rigid3) -> list[float]:
    """Return the position errors in metres of images of the room, all of which
    must be localized."""
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        camera, off = topomap.nodes[0].camera, []
        for picture, truth in unseen_views():
            result = localizer.localize(picture, camera)
            assert isinstance(result, Localization)
            apart = world_from_map @ result.world_from_cam
            off.append(float(np.linalg.norm(apart.translation - truth.translation)))
    return off


def test_walk_there_and_back(walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out, facts_path = tmp_path / "room.topo", tmp_path / "facts.json"
    written = ("--level", "--json", str(facts_path))
    assert main(["map", str(walk), str(out), *OPTIONS, *written]) == 0
    lines = capsys.readouterr().out.splitlines()
    sizes = [int(line.split(":")[1].split()[0]) for line in lines if " nodes, " in line]
    assert "107 frames, 0 without a pose" in lines[-2]
    assert 5 <= sizes[0] <= sizes[-1] <= sizes[0] + 3  # mapped places get no new nodes
    assert find_map_damage(out) == []
    with TopoMetricMap.load(out) as topomap:  # the floor of this room is at z = -1.3
        first = topomap.summaries[0].world_from_cam
        assert abs(first.translation[2] - path_pose(0.0).translation[2] - 1.3) < 0.05
    assert np.median(errors_m(out, path_pose(0.0) @ first.inverse())) < 0.02
    facts = json.loads(facts_path.read_text())
    assert facts["num_frames"] == 107
    assert facts["num_lost"] == 0
    assert facts["max_shift_m"] < 0.1
    assert len(facts["sessions"]) == 1


def test_dark_stretch_is_left_out_and_the_walk_goes_on(walk: Path, tmp_path: Path):
    dark = record_walk(tmp_path / "dark", [*THERE, *[13.0] * 30, *THERE[-2::-1]])
    for number in range(54, 84):
        for side in ("image_0", "image_1"):
            name = str(dark / side / f"{number:06d}.png")
            assert cv2.imwrite(name, np.zeros((240, 320), np.uint8))
    out, facts = tmp_path / "room.topo", tmp_path / "facts.json"
    assert main(["map", str(dark), str(out), *OPTIONS, "--json", str(facts)]) == 0
    assert 30 <= json.loads(facts.read_text())["num_lost"] < 45
    assert np.median(errors_m(out, path_pose(0.0))) < 0.02


def test_recording_that_is_being_written(walk: Path, tmp_path: Path):
    recording, out = tmp_path / "live", tmp_path / "room.topo"
    sequence = open_sequence(walk)

    def record() -> None:
        with RecordingWriter(recording) as writer:
            for index in range(len(sequence)):
                writer.write(sequence[index])
                time.sleep(0.01)

    camera = threading.Thread(target=record)
    camera.start()
    assert main(["map", str(recording), str(out), *OPTIONS, "--live", "--idle", "3"]) == 0
    camera.join()
    assert np.median(errors_m(out, path_pose(0.0))) < 0.02


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_ended_early_the_map_so_far_is_whole(walk: Path, tmp_path: Path, number: signal.Signals):
    out = tmp_path / "room.topo"
    command = [sys.executable, "-m", "topoloc", "map", str(walk), str(out), *OPTIONS, "--realtime"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while " nodes, " not in process.stdout.readline():
            assert process.poll() is None
        process.send_signal(number)
        process.stdout.read()
        assert process.wait() == (-9 if number == signal.SIGKILL else 0)
    assert find_map_damage(out) == []
    with TopoMetricMap.load(out) as topomap:
        result = Localizer(topomap).localize(unseen_views()[0][0], topomap.nodes[0].camera)
    assert isinstance(result, Localization)
    assert [one.name for one in tmp_path.iterdir()] == ["room.topo"]


@pytest.mark.slow
def test_a_real_kitchen(shared: Path, tmp_path: Path):
    """Map 120 frames of 7-Scenes, whose reference poses are about 3 cm off themselves."""
    recording, out = shared / "data/seven_scenes/kitchen/seq-01", tmp_path / "kitchen.topo"
    assert main(["map", f"{recording}@0:120", str(out), "--piece", "60"]) == 0
    sequence = open_sequence(recording)
    truth = dict(zip(sequence.names, sequence.poses, strict=True))
    with TopoMetricMap.load(out) as topomap:
        pairs = [(truth[one.name], one.world_from_cam) for one in topomap.summaries]
        known = [true for true, _ in pairs if true is not None]
        assert len(known) == len(pairs) >= 12
        found = [pose for _, pose in pairs]
        assert absolute_trajectory_errors(known, found).max() < 0.08


def test_faults_have_one_line(
    walk: Path, queries: Path, room_map: Path, tmp_path: Path, complaint: Complaint
):
    assert "it exists; `topoloc update` adds to it" in complaint("map", walk, room_map)
    out = tmp_path / "room.topo"
    assert "at least 20" in complaint("map", walk, out, "--piece", "5", status=2)
    assert "above 0" in complaint("map", walk, out, "--idle", "0", status=2)
    assert "exclude each other" in complaint("map", walk, out, "--live", "--realtime", status=2)
    single = complaint("map", queries, out)
    assert "no piece of it could be mapped" in single
    assert "single" in single or "stereo" in single
    nothing = complaint("map", tmp_path / "none", out, "--live", "--idle", "0.5")
    assert "no such file" in nothing
