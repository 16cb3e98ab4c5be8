"""`topoloc update` with a session of a single camera in another light: the demo's lab, mapped by
day, by night."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from topoloc import Localizer, StereoSequence, TopoMetricMap, open_sequence
from topoloc.apps.cli import main
from topoloc.demo import lab
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.trajectory import Trajectory

LAB = Path(next(iter(lab.__path__)))
TAUGHT, ASKED = f"{LAB / 'night'}@0::2", f"{LAB / 'night'}@1::2"


@pytest.fixture(scope="module")
def by_day(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lab") / "day.topo"
    build_map(open_sequence(LAB / "map_lap1"), BuildConfig(other_kinds=())).save(path)
    return path


@pytest.fixture
def map_file(by_day: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(by_day, tmp_path / "lab.topo"))


def _errors_m(path: Path, recording: str | Path) -> list[float]:
    """Of the images that get a pose; infinite without a true one."""
    errors, sequence = list[float](), open_sequence(recording)
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        for frame in (sequence[k] for k in range(len(sequence))):
            result = localizer.localize(frame.image, frame.camera)
            if isinstance(result, Localization):
                true = frame.world_from_cam
                off = np.inf if true is None else result.world_from_cam.translation - true.translation
                errors.append(float(np.linalg.norm(off)))
    return errors


def _write_poses(sequence: StereoSequence, poses: list[Rigid3], path: Path) -> Path:
    Trajectory.of_frames(poses, sequence.t_ns).write_tum(path)
    return path


def test_a_night_is_learned_in_the_room_that_the_map_takes(
    map_file: Path, capsys: pytest.CaptureFixture[str]
):
    before, night, day = map_file.read_bytes(), open_sequence(ASKED), f"{LAB / 'day'}@0::2"
    known_by_day = _errors_m(map_file, day)
    assert len(_errors_m(map_file, ASKED)) < len(night)
    assert main(["update", str(map_file), TAUGHT]) == 0
    assert "it learned the light of 3 images: they show" in capsys.readouterr().out
    errors = _errors_m(map_file, ASKED)
    assert len(errors) == len(night)
    assert max(errors) < 0.03
    assert map_file.stat().st_size <= len(before)
    by_day = _errors_m(map_file, day)
    assert len(by_day) == len(known_by_day)
    assert max(by_day) < max(known_by_day) + 0.002
    assert _errors_m(map_file, LAB / "street") == []
    assert main(["history", str(map_file)]) == 0
    assert "learned 3" in capsys.readouterr().out
    assert main(["info", str(map_file)]) == 0
    assert "map_lap1 (47 nodes), night (3 nodes)" in capsys.readouterr().out
    assert main(["undo", str(map_file)]) == 0
    assert map_file.read_bytes() == before


def test_a_session_of_another_place_or_with_wrong_poses_is_refused(
    map_file: Path, tmp_path: Path, complaint: Callable[..., str]
):
    before, night = map_file.read_bytes(), open_sequence(TAUGHT)
    true = [pose for pose in night.poses if pose is not None]
    turn = Rigid3(exp_so3(np.array([0.0, np.radians(10.0), 0.0])), np.zeros(3))
    aside = Rigid3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    for fault, poses in (
        ("agree with its poses", [pose @ turn for pose in true]),
        ("its poses", [pose @ aside for pose in true]),
    ):
        file = _write_poses(night, poses, tmp_path / "wrong.tum")
        said = complaint("update", map_file, TAUGHT, "--trajectory", file, "--poses", "unchecked")
        assert fault in said
    assert "recognises 0 of" in complaint("update", map_file, LAB / "street")
    assert map_file.read_bytes() == before


def test_poses_of_another_walk_teach_nothing(
    map_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Where the map recognises images, it corrects their poses. The others contradict theirs."""
    night = open_sequence(TAUGHT)
    true = [pose for pose in night.poses if pose is not None]
    wrong = [
        pose @ Rigid3(np.eye(3), np.array([0.0, 0.0, 0.3 * (6 <= k <= 8)]))
        for k, pose in enumerate(true)
    ]
    file = _write_poses(night, wrong, tmp_path / "wrong.tum")
    words = ["update", str(map_file), TAUGHT, "--trajectory", str(file), "--poses", "unchecked"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "0 nodes added" in said
    assert "poorly recognised images taught it nothing" in said
