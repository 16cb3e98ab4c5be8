"""Test `topoloc update` with a session of a single camera in other light: the demo's lab, mapped by
day, by night."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import topoloc.demo
from topoloc import Localizer, TopoMetricMap, open_sequence
from topoloc.apps.cli import main
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.single_camera_poses import localize_between
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.trajectory import Trajectory

LAB = Path(topoloc.demo.__file__).with_name("lab")
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
    """Return the position errors of localized images, infinite without a true pose."""
    errors, sequence = list[float](), open_sequence(recording)
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        for frame in (sequence[k] for k in range(len(sequence))):
            result = localizer.localize(frame.image, frame.camera)
            if isinstance(result, Localization):
                true = frame.world_from_cam
                off = (
                    np.inf if true is None else result.world_from_cam.translation - true.translation
                )
                errors.append(float(np.linalg.norm(off)))
    return errors


def test_a_night_is_learned_in_the_room_that_the_map_takes(
    map_file: Path, capsys: pytest.CaptureFixture[str]
):
    before, night, day = map_file.read_bytes(), open_sequence(ASKED), f"{LAB / 'day'}@0::4"
    known_by_day = _errors_m(map_file, day)
    assert _errors_m(map_file, f"{LAB / 'night'}@13:16:2") == []
    assert main(["update", str(map_file), TAUGHT]) == 0
    assert "it learned the light of 5 images: they show" in capsys.readouterr().out
    errors = _errors_m(map_file, ASKED)
    assert len(errors) >= len(night) - 1  # one has a probability of about a half
    assert max(errors) < 0.03
    assert len(_errors_m(map_file, f"{LAB / 'night'}@13:16:2")) == 2
    assert map_file.stat().st_size <= len(before)
    by_day = _errors_m(map_file, day)
    assert len(by_day) == len(known_by_day)
    assert max(by_day) < max(known_by_day) + 0.002
    assert _errors_m(map_file, LAB / "street") == []
    assert main(["history", str(map_file)]) == 0
    assert "learned 5" in capsys.readouterr().out
    assert main(["info", str(map_file)]) == 0
    assert "map_lap1 (47 nodes), night (5 nodes)" in capsys.readouterr().out
    assert main(["undo", str(map_file)]) == 0
    assert map_file.read_bytes() == before


def test_a_session_that_extends_the_map_keeps_its_room(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Images beyond the border of the map recognise more of each other than of the map."""
    path = tmp_path / "half.topo"
    half = open_sequence(f"{LAB / 'map_lap1'}@0:20")
    build_map(half, BuildConfig(other_kinds=())).save(path)
    before = path.stat().st_size
    assert main(["update", str(path), str(LAB / "map_lap2")]) == 0
    said = capsys.readouterr().out
    assert "learned" not in said
    assert "made room" not in said
    assert path.stat().st_size > 1.3 * before
    assert len(_errors_m(path, f"{LAB / 'day'}@0::4")) == 8


@pytest.mark.parametrize(
    ("move", "fault"),
    [
        (
            Rigid3(exp_so3(np.array([0.0, 0.17, 0.0])), np.zeros(3)),
            "do not agree with the map; give",
        ),
        # the adjusted poses agree within centimetres, but not with the images
        (Rigid3(np.eye(3), np.array([0.0, 2.0, 0.0])), "taught it nothing"),
        (
            Rigid3(exp_so3(np.array([0.17, 0.0, 0.0])), np.zeros(3)),
            "agree with its poses; no map is",
        ),
        (Rigid3(np.eye(3), np.array([1.0, 0.0, 0.0])), "a metre of its poses is 0.5"),
    ],
)
def test_cameras_that_are_turned_or_shifted_teach_nothing(
    map_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], move: Rigid3, fault: str
):
    with TopoMetricMap.load(map_file) as topomap:
        before = [node.points_cam for node in topomap.nodes]
    night, file = open_sequence(TAUGHT), tmp_path / "wrong.tum"
    Trajectory.of_frames([pose and pose @ move for pose in night.poses], night.t_ns).write_tum(file)
    words = ["--trajectory", str(file), "--poses", "unchecked"]
    status = main(["update", str(map_file), TAUGHT, *words])
    said = capfd.readouterr()
    assert fault in said.out + said.err
    assert (said.out + said.err).count("\n") == 1
    assert status == ("no map" in said.err)
    with TopoMetricMap.load(map_file) as topomap:
        np.testing.assert_equal([node.points_cam for node in topomap.nodes], before)


def test_a_walk_elsewhere_is_refused(map_file: Path, complaint: Callable[..., str]):
    before = map_file.read_bytes()
    assert "recognises 0 of" in complaint("update", map_file, LAB / "street")
    day = shutil.copy(LAB / "day" / "truth.tum", map_file.with_suffix(".tum"))
    assert "are not the poses'" in complaint("update", map_file, TAUGHT, "--trajectory", day)
    assert map_file.read_bytes() == before


def test_images_that_contradict_their_poses_teach_nothing(
    map_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The map recognises the other images, and their poses are right."""
    night, ahead = open_sequence(TAUGHT), Rigid3(np.eye(3), np.array([0.0, 0.0, 0.3]))
    poses = [pose and (pose @ ahead if 6 <= k <= 8 else pose) for k, pose in enumerate(night.poses)]
    file = tmp_path / "wrong.tum"
    Trajectory.of_frames(poses, night.t_ns).write_tum(file)
    words = ["update", str(map_file), TAUGHT, "--trajectory", str(file), "--poses", "unchecked"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "0 nodes added" in said
    assert "poorly recognised images taught it nothing: they show" in said


def test_an_image_is_searched_between_its_neighbours(by_day: Path):
    """A missing frame gets a pose only if the map finds one near the middle of its neighbours."""
    walk = open_sequence(LAB / "day")
    with TopoMetricMap.load(by_day) as topomap:
        localizer = Localizer(topomap)
        answers = dict[int, Localization]()
        for k in (0, 2, 20):
            result = localizer.localize(walk[k].image, walk[k].camera)
            assert isinstance(result, Localization)
            answers[k] = result
        for ends, is_found in (((0, 2), True), ((2, 2), False), ((0, 20), False)):
            known = {
                2 * k: (answers[end].world_from_cam, answers[end]) for k, end in enumerate(ends)
            }
            localize_between(walk[0:3], localizer, known)
            assert (1 in known) == is_found
            if is_found:
                true = walk[1].world_from_cam
                assert true is not None
                assert np.linalg.norm(known[1][0].translation - true.translation) < 0.01
