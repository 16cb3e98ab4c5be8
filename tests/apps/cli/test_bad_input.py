"""Check that each known failure prints one line with fault and place, exits with 1 and
changes no file."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc import TopoMetricMap
from topoloc.apps.cli import main
from topoloc.mapping.storage.schema import SCHEMA_VERSION

Complaint = Callable[..., str]


def test_a_missing_calibration(recording: Path, tmp_path: Path, complaint: Complaint):
    (recording / "calib.txt").unlink()
    (recording / "camera.json").unlink()
    assert "calib.txt: no calibration here" in complaint("build", recording, tmp_path / "room.topo")


def test_too_few_images_for_a_camera(
    room_map: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    photos, camera = tmp_path / "photos", tmp_path / "camera.json"
    photos.mkdir()
    for picture in queries.glob("view0[0-2].png"):
        (photos / picture.name).write_bytes(picture.read_bytes())
    said = complaint("localize", room_map, photos, "--save-camera", camera)
    assert "camera.json: not written: no camera was estimated" in said
    assert not camera.exists()


def test_most_left_pictures_without_right_ones(
    recording: Path, tmp_path: Path, complaint: Complaint
):
    for number in range(8):
        (recording / "image_1" / f"{number:06d}.png").unlink()
    assert "14 pictures here but 6 in image_1" in complaint(
        "build", recording, tmp_path / "room.topo"
    )


@pytest.mark.parametrize("content", [b"", None], ids=["empty", "half"])
def test_most_pictures_cannot_be_read(
    content: bytes | None, recording: Path, tmp_path: Path, complaint: Complaint
):
    for number in range(8):
        picture = recording / "image_0" / f"{number:06d}.png"
        whole = picture.read_bytes()
        picture.write_bytes(whole[: len(whole) // 2] if content is None else content)
    said = complaint("build", recording, tmp_path / "room.topo")
    assert "8 of 14 frames" in said
    assert "000000.png" in said


@pytest.mark.parametrize("command", ["info", "localize", "evaluate"])
def test_a_map_cut_in_half(
    command: str, room_map: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    half = tmp_path / "half.topo"
    half.write_bytes(room_map.read_bytes()[: room_map.stat().st_size // 2])
    inputs = [] if command == "info" else [queries]
    assert "half.topo is truncated" in complaint(
        command, half, *inputs, "--json", tmp_path / "result.json"
    )


def test_a_map_of_a_later_schema(room_map: Path, tmp_path: Path, complaint: Complaint):
    later = tmp_path / "later.topo"
    later.write_bytes(room_map.read_bytes())
    database = sqlite3.connect(later)
    database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    database.close()
    assert f"schema {SCHEMA_VERSION + 1}" in complaint("info", later)


def test_a_file_that_is_no_map(queries: Path, complaint: Complaint):
    assert "is not a topoloc map" in complaint("info", queries / "view00.png")


@pytest.mark.parametrize("where", ["--trajectory", "truth.tum"])
def test_nan_in_a_trajectory(where: str, recording: Path, tmp_path: Path, complaint: Complaint):
    lines = (recording / "truth.tum").read_text().splitlines()
    lines[4] = lines[4].replace(lines[4].split()[1], "nan", 1)
    broken = recording / "truth.tum" if where == "truth.tum" else tmp_path / "broken.tum"
    broken.write_text("\n".join(lines) + "\n")
    options = ["--trajectory", broken] if where == "--trajectory" else []
    assert f"{broken.name}, line 5" in complaint(
        "build", *options, recording, tmp_path / "room.topo"
    )


def test_a_missing_map(queries: Path, tmp_path: Path, complaint: Complaint):
    for command in (["info"], ["localize", queries], ["evaluate", queries]):
        assert "cannot open map" in complaint(command[0], tmp_path / "no.topo", *command[1:])


def test_a_missing_recording(room_map: Path, tmp_path: Path, complaint: Complaint):
    assert "nowhere: no such file or folder" in complaint(
        "build", tmp_path / "nowhere", tmp_path / "room.topo"
    )
    assert "nowhere: no such file or folder" in complaint(
        "localize", room_map, tmp_path / "nowhere"
    )
    assert "nowhere: no such file or folder" in complaint(
        "evaluate", room_map, tmp_path / "nowhere"
    )
    too_long = "9" * 3000
    for command in (
        ["build", too_long, "room.topo"],
        ["localize", room_map, too_long],
        ["localize", too_long, "a.png"],
        ["info", too_long],
    ):
        assert too_long in complaint(*command)


def test_a_folder_that_is_no_recording(tmp_path: Path, complaint: Complaint):
    (tmp_path / "letters").mkdir()
    assert "letters: no known recording: the folder is empty" in complaint(
        "build", tmp_path / "letters", tmp_path / "room.topo"
    )
    (tmp_path / "letters/one.txt").write_text("Dear reader,")
    said = complaint("build", tmp_path / "letters", tmp_path / "room.topo")
    assert said.endswith(
        "letters: no known recording: here is one.txt; formats: docs/recordings.md\n"
    )
    for name in ("left", "two.txt", "three.txt", "times.txt"):
        (tmp_path / "letters" / name).mkdir()
    said = complaint("build", tmp_path / "letters", tmp_path / "room.topo")
    assert "here is left, one.txt, three.txt, times.txt ...; nearest is folder: " in said
    assert len(said) - len(str(tmp_path)) < 400
    said = complaint("build", tmp_path / "letters" / "one.txt", tmp_path / "room.topo")
    assert "one.txt: no known recording: here is a file of another kind; formats:" in said
    assert "there are euroc, tum" in complaint(
        "build", tmp_path / "letters", tmp_path / "room.topo", "--format", "betamax"
    )


OUTPUTS = [
    ("build", "--json"),
    ("localize", "--json"),
    ("localize", "--tum"),
    ("evaluate", "--json"),
    ("evaluate", "--report"),
]
OUTPUTS += [("info", "--json"), ("build", "MAP")]


@pytest.fixture
def command_with_output(
    recording: Path, room_map: Path, queries: Path, tmp_path: Path
) -> Callable[[str, str, Path], list[object]]:
    """Return a function that makes the arguments of a command, one of whose outputs
    is a given path."""

    def arguments(command: str, option: str, output: Path) -> list[object]:
        if option == "MAP":
            return [command, recording, output]
        inputs = {"build": [recording, tmp_path / "room.topo"], "info": [room_map]}.get(
            command, [room_map, queries]
        )
        return [command, *inputs, option, output]

    return arguments


@pytest.mark.parametrize(("command", "option"), OUTPUTS)
def test_an_output_folder_that_does_not_exist(
    command: str, option: str, command_with_output: Callable, tmp_path: Path, complaint: Complaint
):
    arguments = command_with_output(command, option, tmp_path / "nowhere" / "out")
    assert f"cannot write {tmp_path / 'nowhere' / 'out'}: folder" in complaint(*arguments)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
@pytest.mark.parametrize(("command", "option"), OUTPUTS)
def test_a_read_only_output_folder(
    command: str, option: str, command_with_output: Callable, tmp_path: Path, complaint: Complaint
):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    assert "is read-only" in complaint(*command_with_output(command, option, locked / "out"))


@pytest.mark.parametrize(("command", "option"), OUTPUTS[:-1])
def test_outputs_never_replace_inputs_or_folders(
    command: str,
    option: str,
    command_with_output: Callable,
    room_map: Path,
    tmp_path: Path,
    complaint: Complaint,
):
    assert "it is a folder" in complaint(*command_with_output(command, option, tmp_path))
    target = tmp_path / "room.topo" if command == "build" else room_map
    assert "used twice" in complaint(*command_with_output(command, option, target))


def test_ctrl_c_in_mid_build(
    recording: Path, tmp_path: Path, complaint: Complaint, monkeypatch: pytest.MonkeyPatch
):
    target = tmp_path / "room.topo"
    target.write_bytes(b"")  # a map that was there before

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("topoloc.mapping.mapping_frames.extract_features", interrupted)
    assert complaint("build", recording, target) == "error: interrupted; no file is incomplete\n"


def test_ctrl_c_in_mid_evaluation(
    room_map: Path,
    queries: Path,
    tmp_path: Path,
    complaint: Complaint,
    monkeypatch: pytest.MonkeyPatch,
):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("topoloc.apps.cli.queries.remote_queries.localize_queries", interrupted)
    files = ["--json", tmp_path / "a.json", "--report", tmp_path / "a.html"]
    assert "interrupted" in complaint("evaluate", room_map, queries, *files)


def test_ctrl_c_in_a_compiled_function_is_no_bug(
    recording: Path, tmp_path: Path, complaint: Complaint, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object, **__: object) -> None:
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr("topoloc.apps.cli.mapping.map_jobs.build_map", interrupted)
    assert "interrupted" in complaint("build", recording, tmp_path / "room.topo")


@pytest.mark.parametrize(
    "last",
    [
        "recording",
        "recording@0:5",
        "recording/image_0",
        "recording/image_0/000000.png",
        "recording/truth.tum",
    ],
)
def test_a_forgotten_map_argument(last: str, recording: Path, tmp_path: Path, complaint: Complaint):
    assert "was MAP forgotten?" in complaint("build", recording, tmp_path / last, status=2)


def test_too_few_arguments_are_wrong_usage(
    recording: Path, room_map: Path, tmp_path: Path, complaint: Complaint
):
    assert "last, the map file" in complaint("build", recording, status=2)
    assert "at least one image" in complaint("localize", room_map, status=2)
    assert "at least one recording" in complaint("evaluate", room_map, status=2)
    two = ["--trajectory", recording / "truth.tum", "--trajectory", "truth"]
    assert "1 recordings but 2 trajectories" in complaint(
        "build", *two, recording, tmp_path / "room.topo", status=2
    )


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ("500,500,320", "neither a file nor four numbers"),
        ("500,500,x,200", "neither a file nor four numbers"),
        ("nan,500,320,240", "not finite"),
        ("0,500,320,240", "positive"),
        ("nowhere.json", "nowhere.json: no such camera file"),
        ('{"width": 320}', "missing required field `height`"),
        (
            '{"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 320, "cy": 240}',
            "the image is 320x240, its camera 640x480",
        ),
        ("not json", "not JSON"),
    ],
)
def test_a_camera_that_is_none(
    camera: str, says: str, room_map: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    if " " in camera:
        (tmp_path / "camera.json").write_text(camera)
        camera = str(tmp_path / "camera.json")
    if "320" in says:
        says = f"view00.png: {says}"
    assert says in complaint("localize", room_map, queries / "view00.png", "--camera", camera)


def test_the_maps_camera_for_a_picture_of_another_shape(
    room_map: Path, square_picture: Path, complaint: Complaint
):
    assert "300x300, the map's camera 320x240: not of one shape" in complaint(
        "localize", room_map, square_picture, "--camera", "map"
    )


@pytest.fixture
def square_picture(tmp_path: Path) -> Path:
    """Return the path of a square image."""
    path = tmp_path / "square.pgm"
    path.write_bytes(b"P5 300 300 255\n" + bytes(90000))
    return path


def test_an_unknown_coarse_localizer(room_map: Path, queries: Path, complaint: Complaint):
    assert "no coarse localizer 'vlad-nn' (it has: surf-vlad)" in complaint(
        "localize", room_map, queries, "--coarse", "vlad-nn"
    )


def test_no_truth_to_judge_against(room_map: Path, queries: Path, complaint: Complaint):
    assert "no frame has a known pose" in complaint("evaluate", room_map, queries / "view00.png")


@pytest.mark.parametrize(
    "content",
    [
        "[[1, 2], [3, 4]]",
        '{"a": 1}',
        "{",
        json.dumps([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]),
    ],
)
def test_a_map_from_truth_that_is_no_transform(
    content: str, room_map: Path, queries: Path, tmp_path: Path, complaint: Complaint
):
    path = tmp_path / "map_from_truth.json"
    path.write_text(content)
    assert "map_from_truth.json" in complaint(
        "evaluate", room_map, queries, "--map-from-truth", path
    )


def test_bugs_are_not_hidden(room_map: Path, monkeypatch: pytest.MonkeyPatch):
    for kind in (ZeroDivisionError, SystemError):

        def bug(*_: object, kind: type[Exception] = kind) -> None:
            raise kind

        monkeypatch.setattr(TopoMetricMap, "describe", bug)
        with pytest.raises(kind):
            main(["info", str(room_map)])


@pytest.mark.parametrize("megabytes", [600, 1000])
def test_too_little_address_space_is_one_line(megabytes: int, tmp_path: Path):
    command = (
        f"ulimit -v {megabytes * 1000}; exec {sys.executable} -m topoloc info"
        f" {tmp_path / 'no.topo'}"
    )
    run = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert run.stderr.startswith("error: too little memory")
    assert len(run.stderr.splitlines()) == 1
