"""Test `topoloc update`: sessions that extend a map, show changes, or show nothing new, and
sessions that do not fit."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tiny_world import (
    CAMERA,
    Panel,
    path_pose,
    render,
    room,
    smooth_texture,
    tum_line,
    write_stereo_recording,
)
from topoloc import Localizer, TopoMetricMap, open_sequence
from topoloc.apps.cli import main
from topoloc.errors import TrajectoryError
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.lifelong.session_content import is_well_localized
from topoloc.lifelong.update import update_map
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.edit import edit_map
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.recordings.recording import with_poses

ON = np.arange(3.0, 24.0, 0.75)
ELSEWHERE = Rigid3(exp_so3(np.array([0.3, -0.2, 1.1])), np.array([5.0, -3.0, 2.0]))


@pytest.fixture(scope="module")
def first_half(tiny_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("half") / "half.topo"
    build_map(open_sequence(f"{tiny_recording}@0:7"), BuildConfig(other_kinds=())).save(path)
    return path


@pytest.fixture
def map_file(first_half: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(first_half, tmp_path / "room.topo"))


@pytest.fixture(scope="module")
def second_half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording from the mapped half into the other one, with poses in its
    own world frame."""
    folder = write_stereo_recording(tmp_path_factory.mktemp("second") / "on", indices=ON.tolist())
    return _in_another_world(folder)


def _in_another_world(folder: Path, scale: float = 1.0) -> Path:
    sequence = open_sequence(folder)
    poses = [ELSEWHERE @ pose for pose in sequence.poses if pose is not None]
    poses = [Rigid3(pose.rotation, scale * pose.translation) for pose in poses]
    (folder / "truth.tum").write_text(
        "".join(
            tum_line(t / 1e8, pose) + "\n" for t, pose in zip(sequence.t_ns, poses, strict=True)
        )
    )
    return folder


def _answers(
    path: Path, indices: np.ndarray, panels: list[Panel] | None = None
) -> list[Localization | None]:
    with TopoMetricMap.load(path) as topomap:
        localizer, found = Localizer(topomap), []
        for index in indices:
            picture, _ = render(
                panels or room(), path_pose(float(index)), noise_seed=int(5000 + 10 * index)
            )
            result = localizer.localize(picture, CAMERA)
            found.append(result if isinstance(result, Localization) else None)
    return found


def _off(answers: list[Localization | None], indices: np.ndarray) -> list[float]:
    return [
        np.inf if answer is None else translation_error(path_pose(float(k)), answer.world_from_cam)
        for k, answer in zip(indices, answers, strict=True)
    ]


def test_a_session_extends_the_map(
    map_file: Path, second_half: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    before, far = map_file.read_bytes(), np.arange(18.1, 23.0, 1.2)
    known = [0 if answer is None else answer.num_inliers for answer in _answers(map_file, far)]
    joined, said = tmp_path / "joined.tum", tmp_path / "said.json"
    monkeypatch.setattr(
        "topoloc.lifelong.session_content.is_well_localized",
        partial(is_well_localized, min_inliers=250),
    )
    options = ["--joined", str(joined), "--json", str(said)]
    assert main(["update", str(map_file), str(second_half), *options]) == 0
    positions = np.loadtxt(joined)[:, 1:4]
    truth = np.array([path_pose(k).translation for k in ON])
    assert np.linalg.norm(positions - truth, axis=1).max() < 0.02
    answers = _answers(map_file, far)
    assert max(_off(answers, far)) < 0.02
    assert np.median(
        [answer.num_inliers for answer in answers if answer is not None]
    ) > 1.2 * np.median(known)
    changes = json.loads(said.read_text())["updates"][0]
    assert changes["nodes_added"] > 0
    assert changes["agreeing"] >= 5
    assert find_map_damage(map_file) == []
    with TopoMetricMap.load(map_file) as topomap:
        assert [session.name for session in topomap.sessions] == ["room", "on"]
        assert topomap.edits[-1].changes is not None
        assert topomap.edits[-1].changes["nodes_added"] == changes["nodes_added"]
        assert {summary.session_id for summary in topomap.summaries} == {0, 1}
    assert main(["undo", str(map_file)]) == 0
    assert map_file.read_bytes() == before


def test_separate_stretches_are_each_aligned_to_the_map(map_file: Path, second_half: Path):
    """SLAM leaves such stretches if it was lost between them. One that contradicts the map gets no
    poses, and the others keep theirs."""
    sequence = open_sequence(second_half)
    cut, end = 12, 24
    moved = Rigid3(exp_so3(np.array([-0.5, 0.2, 0.4])), np.array([1.0, 2.0, -3.0]))
    first = [pose if k < cut else None for k, pose in enumerate(sequence.poses)]
    second = [
        moved @ pose if pose is not None and cut <= k < end else None
        for k, pose in enumerate(sequence.poses)
    ]
    bent = [pose and Rigid3(pose.rotation, 2.0 * pose.translation) for pose in second]
    truth = [path_pose(float(k)) for k in ON]
    for poses, apart, known in (
        (first, (second,), range(end)),
        (first, (bent,), range(cut)),
        (bent, (first,), range(cut)),
    ):
        with TopoMetricMap.load(map_file) as topomap:
            view = with_poses(sequence, poses, apart)
            update = update_map(topomap, view, "slam")
        posed = update.sequence.poses
        assert [k for k, pose in enumerate(posed) if pose is not None] == list(known)
        assert (
            max(
                translation_error(truth[k], pose)
                for k, pose in enumerate(posed)
                if pose is not None
            )
            < 0.02
        )
    with (
        TopoMetricMap.load(map_file) as topomap,
        pytest.raises(TrajectoryError, match="a metre of its poses is"),
    ):
        update_map(
            topomap,
            with_poses(sequence, bent, ([None] * len(sequence),)),
            "slam",
        )


def test_a_session_that_shows_nothing_new_adds_counts_alone(map_file: Path, tmp_path: Path):
    again = write_stereo_recording(tmp_path / "again", indices=np.arange(0.25, 5.5, 0.25).tolist())
    with TopoMetricMap.load(map_file) as topomap:
        before = [
            (node.points_cam.copy(), len(list(node.session_statistics))) for node in topomap.nodes
        ]
    assert main(["update", str(map_file), str(again)]) == 0
    with TopoMetricMap.load(map_file) as topomap:
        assert len(topomap.summaries) == len(before)
        num_sums = 0
        for node, (points_cam, num) in zip(topomap.nodes, before, strict=True):
            np.testing.assert_array_equal(node.points_cam, points_cam)
            of_session = [
                session_statistics
                for session_statistics in node.session_statistics
                if session_statistics.session_id == 1
            ]
            num_sums += len(list(node.session_statistics)) - num
            for session_statistics in of_session:
                assert (session_statistics.seen <= session_statistics.expected).all()
                assert session_statistics.seen.sum() > 0.3 * session_statistics.expected.sum(), (
                    "what is there is seen again"
                )
        assert num_sums > 0


def test_a_changed_room_is_learnt_from_a_single_camera(
    map_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Two of the five surfaces look different. The camera has neither depth nor poses."""
    panels = room()
    for number in (0, 3):
        old = panels[number]
        panels[number] = Panel(
            old.centre, old.right, old.down, old.half, smooth_texture(7000 + number, old.half)
        )
    asked, indices = np.arange(1.2, 6.0, 0.5), np.arange(0.0, 6.6, 0.2)
    folder = tmp_path / "changed"
    (folder / "images").mkdir(parents=True)
    import cv2

    for number, index in enumerate(indices):
        picture, _ = render(panels, path_pose(float(index)), noise_seed=3000 + number)
        assert cv2.imwrite(str(folder / "images" / f"{number:06d}.png"), picture)
    (folder / "times.txt").write_text(
        "".join(f"{number / 10:.9f}\n" for number in range(len(indices)))
    )
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_json()))
    before = _answers(map_file, asked, panels)
    monkeypatch.setattr(  # all of it is to be learnt
        "topoloc.lifelong.session_content.is_well_localized", lambda answer, d_thresh: False
    )
    assert main(["update", str(map_file), str(folder)]) == 0
    after = _answers(map_file, asked, panels)
    with TopoMetricMap.load(map_file) as topomap:
        assert topomap.sessions[-1].poses_from == "map"
        assert topomap.edits[-1].changes is not None
        assert topomap.edits[-1].changes["frames_with_pose"] == len(indices)
    inliers = [
        [0 if answer is None else answer.num_inliers for answer in answers]
        for answers in (before, after)
    ]
    assert np.median(inliers[1]) > 1.3 * np.median(inliers[0]) + 20
    assert max(_off(after, asked)) < 0.02
    assert find_map_damage(map_file) == []


def test_a_session_that_does_not_fit_changes_nothing(
    map_file: Path, second_half: Path, tmp_path: Path, complaint: Callable[..., str]
):
    before = map_file.read_bytes()
    other = write_stereo_recording(tmp_path / "other", seed=4)
    assert "recognises 0 of" in complaint("update", map_file, other)
    larger = _in_another_world(shutil.copytree(second_half, tmp_path / "larger"), scale=1.3)
    assert "a metre of its poses is 0.7" in complaint(
        "update", map_file, larger, "--poses", "unchecked"
    )
    few = write_stereo_recording(tmp_path / "few", indices=[1.0, 1.5, 2.0])
    assert "too few to join: it takes 5" in complaint("update", map_file, few)
    fx, _, cx, cy = CAMERA.params
    wrong = complaint(
        "update",
        map_file,
        second_half,
        "--camera",
        f"{1.1 * fx},{1.1 * fx},{cx},{cy}",
        "--poses",
        "unchecked",
    )
    assert "of 12 pictures contradict it" in wrong
    assert "the picture says f = 26" in wrong
    assert "nothing to undo" in complaint("undo", map_file)
    assert "at least one recording" in complaint("update", map_file, status=2)
    assert map_file.read_bytes() == before


@pytest.mark.skipif(os.name == "nt", reason="no such permissions")
def test_a_map_that_is_read_only_stays_as_it_is(
    map_file: Path, second_half: Path, complaint: Callable[..., str]
):
    before = map_file.read_bytes()
    map_file.chmod(0o444)
    for words in (("update", map_file, second_half), ("prune", map_file), ("undo", map_file)):
        assert "it is read-only" in complaint(*words)
    assert map_file.read_bytes() == before


@pytest.mark.skipif(os.name == "nt", reason="no locks")
def test_the_second_of_two_updates_at_once_waits_with_a_message(map_file: Path, second_half: Path):
    words = [sys.executable, "-m", "topoloc", "update", str(map_file), str(second_half)]
    with edit_map(map_file) as edit:
        second = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert second.stderr is not None
        assert second.stderr.readline() == "another process edits this map; waiting for it ...\n"
        edit.commit(edit.topomap, "the first")
    printed, complaints = second.communicate(timeout=120)
    assert (second.returncode, complaints) == (0, "")
    assert "joins as session 1" in printed
    with TopoMetricMap.load(map_file) as topomap:
        assert [edit.name for edit in topomap.edits] == ["build", "the first", "update on"]


def test_the_same_session_is_not_doubled(
    map_file: Path, second_half: Path, tiny_recording: Path, complaint: Callable[..., str]
):
    assert "in the map already, as session 0" in complaint(
        "update", map_file, f"{tiny_recording}@0:7"
    )
    assert "in the map already, as session 0" in complaint(
        "update", map_file, f"{tiny_recording}@3:10"
    ), "frames 3 to 6 are"
    assert main(["update", str(map_file), str(second_half)]) == 0
    assert "in the map already, as session 1" in complaint("update", map_file, second_half)


def test_another_day_of_the_same_name_and_clock_is_another_session(map_file: Path, tmp_path: Path):
    """Two recordings named `room` have equal image names and times, but the second
    goes elsewhere."""
    other_day = write_stereo_recording(
        tmp_path / "day2" / "room", indices=[0.5 + k for k in range(7)]
    )
    assert main(["update", str(map_file), str(other_day)]) == 0
    with TopoMetricMap.load(map_file) as topomap:
        assert [session.name for session in topomap.sessions] == ["room", "room"]


def test_the_history_lists_the_updates(
    map_file: Path, second_half: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["update", str(map_file), str(second_half), "--light", "evening"]) == 0
    with TopoMetricMap.load(map_file) as topomap:
        assert [session.light_name for session in topomap.sessions] == [None, "evening"]
    capsys.readouterr()
    assert main(["history", str(map_file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "build" in lines[0]
    assert "update on: session 1" in lines[1]
    assert "nodes added" in lines[1]
    assert "takes the last one back" in lines[2]
    assert main(["history", str(map_file), "--json", "-"]) == 0
    assert [edit["undoable"] for edit in json.loads(capsys.readouterr().out)["edits"]] == [
        False,
        True,
    ]
