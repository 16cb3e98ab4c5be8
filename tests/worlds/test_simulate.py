from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from topoloc.apps.cli import main
from topoloc.errors import MissingExtraError
from topoloc.recordings.open import open_sequence
from topoloc_worlds import recorder, shots
from topoloc_worlds.routes import RouteConfig
from topoloc_worlds.shots import Shot

Complaint = Callable[..., str]


@pytest.fixture
def no_rendering(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace rendered images by grey ones, so that only the command is tested."""

    def grey(shooting: shots.Shooting | None, index: int) -> Shot:
        assert index < 1000
        picture = np.full((32, 48, 3), 100 + index, np.uint8)
        return Shot(picture, picture, np.full((32, 48), 2.0, np.float32))

    monkeypatch.setattr(recorder, "use_best_variant", lambda force=None: "none")
    monkeypatch.setattr(recorder, "version", lambda package: "0")
    monkeypatch.setattr(recorder, "_shooting", lambda *_: None)
    monkeypatch.setattr(recorder, "shoot", grey)


def simulate(*args: object) -> int:
    return main(["simulate", *map(str, args), "--size", "48x32", "--processes", "1"])


@pytest.mark.usefixtures("no_rendering")
def test_it_writes_a_recording_with_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out, facts = tmp_path / "day", tmp_path / "facts.json"
    assert simulate("lab", out, "--num-frames", 3, "--json", facts) == 0
    assert capsys.readouterr().out.startswith(f"{out}: 3 stereo pairs, 0.")
    data = json.loads(facts.read_text())
    assert (data["world"], data["condition"], data["num_frames"], data["num_rendered"]) == (
        "lab",
        "day",
        3,
        3,
    )
    frame = open_sequence(out)[2]
    assert frame.rig is not None
    assert frame.camera is not None
    assert (frame.camera.width, frame.camera.fx) == (48, pytest.approx(380 * 48 / 640))
    assert simulate("lab", out, "--num-frames", 3) == 0
    assert "(3 of them were there)" in capsys.readouterr().out


@pytest.mark.usefixtures("no_rendering")
def test_a_rig_gets_a_recording_for_each_camera_of_one_walk(tmp_path: Path):
    left = [[0.0, 0.0, -1.0, -0.1], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]
    ahead = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    rig, out = tmp_path / "rig.json", tmp_path / "walk"
    cameras = {"ahead": {"rig_from_cam": ahead}, "left": {"rig_from_cam": left}}
    rig.write_text(json.dumps({"cameras": cameras}))
    assert simulate("lab", out, "--num-frames", 2, "--camera", rig) == 0
    recording = open_sequence(out)
    assert [name.split("/")[0] for name in recording.names] == ["ahead", "left"] * 2
    for first in (0, 2):
        forward, sideways = recording.poses[first], recording.poses[first + 1]
        assert forward is not None
        assert sideways is not None
        assert np.allclose((forward.inverse() @ sideways).matrix()[:3], left, atol=1e-6)
        own = open_sequence(out / "left").poses[first // 2]
        assert own is not None
        assert np.allclose(own.matrix(), sideways.matrix(), atol=1e-6)


@pytest.mark.usefixtures("no_rendering")
def test_settings_reach_the_recording(tmp_path: Path):
    words = (
        "--num-frames 2 --condition clear --seed 3 --take 4 --arrangement 5 --lateral 0.1 --reverse"
        " --look 90 --sway hand"
    )
    words += " --start 1 --spacing 0.3 --laps 0.5 --mono --depth --grey --motion-blur --draft"
    assert simulate("lab", tmp_path / "a", *words.split(), "--camera", "40,40,23.5,15.5") == 0
    settings = json.loads((tmp_path / "a" / "world.json").read_text())
    assert [settings[name] for name in ("condition", "seed", "arrangement", "grey", "depth")] == [
        "day",
        3,
        5,
        True,
        True,
    ]
    assert settings["baseline"] is None
    assert settings["num_renderings"] > 1
    assert settings["camera"]["fx"] == 40.0
    route = RouteConfig(**settings["route"])
    assert (route.seed, route.lateral, route.reverse, route.wobble, route.shake) == (
        4,
        0.1,
        True,
        1.0,
        1.0,
    )
    assert (route.start, route.spacing, route.laps) == (1.0, 0.3, 0.5)
    assert route.look == pytest.approx(np.pi / 2)
    assert open_sequence(tmp_path / "a")[0].depth is not None


@pytest.mark.usefixtures("no_rendering")
def test_a_camera_file_and_a_part_of_a_lap(tmp_path: Path):
    camera = tmp_path / "camera.json"
    camera.write_text(
        '{"model": "PINHOLE", "width": 48, "height": 32, "fx": 41, "fy": 41, "cx": 23, "cy": 15}'
    )
    assert (
        simulate("corridor", tmp_path / "a", "--camera", camera, "--laps", 0.0125, "--sway", "none")
        == 0
    )
    sequence = open_sequence(tmp_path / "a")
    assert sequence[0].camera is not None
    assert sequence[0].camera.fx == 41
    first, last = sequence.poses[0], sequence.poses[-1]
    assert first is not None
    assert last is not None
    assert 0.4 < np.linalg.norm(first.translation - last.translation) < 0.9


@pytest.mark.usefixtures("no_rendering")
def test_an_interruption_names_the_command_to_resume(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    whole = recorder.shoot

    def interrupted(shooting: None, index: int) -> Shot:
        if index == 2:
            raise KeyboardInterrupt
        return whole(shooting, index)  # type: ignore[arg-type]

    monkeypatch.setattr(recorder, "shoot", interrupted)
    assert simulate("lab", tmp_path / "a", "--num-frames", 4) == 1
    error = capsys.readouterr().err
    assert (
        error
        == f"error: interrupted (2 of 4 frames are in {tmp_path / 'a'}; the same command goes on"
        " from there)\n"
    )
    monkeypatch.setattr(recorder, "shoot", whole)
    assert simulate("lab", tmp_path / "a", "--num-frames", 4) == 0
    assert "4 stereo pairs (2 of them were there)" in capsys.readouterr().out


def test_unknown_worlds_and_conditions_get_the_list(complaint: Complaint, tmp_path: Path):
    assert "lab, corridor, hospital, street" in complaint("simulate", "moon", tmp_path / "a")
    assert "day, evening, night, cloudy, rain" in complaint(
        "simulate", "lab", tmp_path / "a", "--condition", "fog"
    )


@pytest.mark.usefixtures("no_rendering")
def test_bad_settings_are_named_before_anything_is_written(complaint: Complaint, tmp_path: Path):
    out = tmp_path / "a"
    assert "--size" in complaint("simulate", "lab", out, "--size", "40", status=2)
    assert "--baseline" in complaint("simulate", "lab", out, "--mono", "--baseline", 0.1, status=2)
    assert "four numbers" in complaint("simulate", "lab", out, "--camera", "1,2,3")
    assert "no such camera file" in complaint(
        "simulate", "lab", out, "--camera", tmp_path / "none.json"
    )
    assert "spacing" in complaint("simulate", "lab", out, "--spacing", -1)
    assert "bends" in complaint("simulate", "lab", out, "--lateral", 40)
    assert "JPEG" in complaint("simulate", "lab", out, "--jpeg", 200)


@pytest.mark.usefixtures("no_rendering")
def test_folders_of_others_and_other_settings_are_left_alone(complaint: Complaint, tmp_path: Path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("years of work")
    assert "holds other files" in complaint("simulate", "lab", mine)
    assert "cannot write" in complaint("simulate", "lab", mine / "thesis.tex" / "out")
    assert simulate("lab", tmp_path / "a", "--num-frames", 1) == 0
    assert "condition was" in complaint(
        "simulate",
        "lab",
        tmp_path / "a",
        "--num-frames",
        1,
        "--condition",
        "night",
        "--size",
        "48x32",
    )
    assert (
        simulate("lab", tmp_path / "a", "--num-frames", 1, "--condition", "night", "--overwrite")
        == 0
    )


def test_without_mitsuba_it_is_named(
    complaint: Complaint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert "pip install mitsuba" in complaint("simulate", "lab", tmp_path / "a")
    with pytest.raises(MissingExtraError):
        recorder.use_best_variant()
