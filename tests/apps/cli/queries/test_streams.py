"""Test `topoloc localize` on recordings and videos: states, trajectories, odometry,
broken streams."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from room_stream import room_stream
from tiny_world import CAMERA
from topoloc.apps.cli import main
from topoloc.geometry.alignment import translation_error
from topoloc.recordings.trajectory import Trajectory

NUM_FRAMES = 15
STATES = {"t_ns", "state", "smoothed", "smoothed_covariance"}


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the rendered stream as a recording of one camera, with a video beside
    it. Read-only."""
    folder = tmp_path_factory.mktemp("stream") / "walk"
    (folder / "image_0").mkdir(parents=True)
    writer = cv2.VideoWriter(
        str(folder / "walk.avi"),
        cv2.VideoWriter_fourcc(*"MJPG"),
        30.0,
        (CAMERA.width, CAMERA.height),
    )
    writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 98)
    for number, (_, grey, _) in enumerate(room_stream()[:NUM_FRAMES]):
        assert cv2.imwrite(str(folder / "image_0" / f"{number:06d}.png"), grey)
        writer.write(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    writer.release()
    projection = np.column_stack([CAMERA.matrix(), np.zeros(3)])
    (folder / "calib.txt").write_text("P0: " + " ".join(map(str, projection.ravel())) + "\n")
    (folder / "times.txt").write_text(
        "".join(f"{t_ns / 1e9:.9f}\n" for t_ns, _, _ in room_stream()[:NUM_FRAMES])
    )
    (folder / "camera.json").write_text(json.dumps(CAMERA.to_json()))
    return folder


def _lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


@pytest.mark.parametrize("kind", ["recording", "video"])
def test_recordings_and_videos_are_streams(
    room_map: Path, stream: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
):
    source = stream if kind == "recording" else stream / "walk.avi"
    results, raw, smoothed = (
        tmp_path / name for name in ("results.jsonl", "raw.tum", "smoothed.tum")
    )
    assert (
        main(["localize", str(room_map), str(source), "--json", str(results), "--tum", str(raw)])
        == 0
    )
    printed = capsys.readouterr()
    assert printed.err == ""
    summary = printed.out.splitlines()[-1]
    assert summary.startswith(f"{NUM_FRAMES} frames: ")
    assert summary.endswith("frames a second")
    lines = _lines(results)
    assert len(lines) == NUM_FRAMES
    assert {line["state"] for line in lines} == {"localized", "tracked"}
    assert all(line.keys() >= STATES for line in lines)
    assert main(["localize", str(room_map), str(source), "--tum", str(smoothed), "--smoothed"]) == 0
    for path, key in ((raw, "world_from_cam"), (smoothed, "smoothed")):
        found = Trajectory.read(path)
        assert len(found) == NUM_FRAMES
        for pose, line, (_, _, truth) in zip(
            found.world_from_cam, lines, room_stream(), strict=False
        ):
            np.testing.assert_allclose(pose.translation, line[key]["translation"], atol=1e-9)
            assert translation_error(pose, truth) < 0.03


def test_json_lines_on_standard_output_are_nothing_else(
    room_map: Path, stream: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["localize", str(room_map), f"{stream}@0:4", "--json", "-"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["query"] for line in lines] == [f"image_0/{number:06d}.png" for number in range(4)]


def test_single_and_stream_can_be_forced(
    room_map: Path, stream: Path, queries: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["localize", str(room_map), f"{stream}@0:3", "--single", "--json", "-"]) == 0
    assert all("state" not in json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert main(["localize", str(room_map), str(queries), "--stream", "--json", "-"]) == 0
    assert all("state" in json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert main(["localize", str(room_map), str(queries), "--json", "-"]) == 0
    assert all("state" not in json.loads(line) for line in capsys.readouterr().out.splitlines())


def test_the_papers_rule_refuses_jumps(
    room_map: Path, stream: Path, capsys: pytest.CaptureFixture[str]
):
    assert (
        main(["localize", str(room_map), f"{stream}@0::5", "--max-jump", "0.05", "--json", "-"])
        == 0
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["state"] for line in lines] == ["localized", "predicted", "predicted"]
    assert [line.get("reason") for line in lines] == [None, "jump", "jump"]
    assert lines[1]["smoothed"] == lines[0]["smoothed"]


def test_odometry_is_read_by_time(
    room_map: Path, stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    odometry = tmp_path / "odometry.tum"
    rows = [
        (t_ns, pose.translation, pose.quat_wxyz()) for t_ns, _, pose in room_stream()[:NUM_FRAMES]
    ]
    odometry.write_text(
        "".join(
            f"{t / 1e9:.9f} {x} {y} {z} {i} {j} {k} {w}\n" for t, (x, y, z), (w, i, j, k) in rows
        )
    )
    assert (
        main(["localize", str(room_map), str(stream), "--odometry", str(odometry), "--json", "-"])
        == 0
    )
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert all(line["localized"] for line in lines)


def test_a_broken_picture_is_predicted_and_the_stream_goes_on(
    room_map: Path, stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    broken = Path(shutil.copytree(stream, tmp_path / "broken"))
    (broken / "image_0" / "000006.png").write_bytes(b"")
    assert cv2.imwrite(str(broken / "image_0" / "000009.png"), np.zeros((100, 100), np.uint8))
    assert main(["localize", str(room_map), str(broken), "--json", "-"]) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("warning: 2 of 15 images could not be read")
    lines = [json.loads(line) for line in printed.out.splitlines()]
    assert [number for number, line in enumerate(lines) if line["state"] == "predicted"] == [6, 9]
    assert "100x100 pixels" in lines[9]["detail"]
    assert all(line["localized"] for number, line in enumerate(lines) if number not in (6, 9))


def test_invalid_streams_are_one_line(
    room_map: Path, stream: Path, tmp_path: Path, complaint: Callable[..., str]
):
    broken = Path(shutil.copytree(stream, tmp_path / "broken"))
    times = (broken / "times.txt").read_text().splitlines()
    times[7] = times[2]
    (broken / "times.txt").write_text("\n".join(times) + "\n")
    assert "times.txt" in complaint("localize", room_map, broken)
    (tmp_path / "film.mp4").write_bytes(b"no film")
    assert "film.mp4" in complaint("localize", room_map, tmp_path / "film.mp4")


def test_a_video_without_calibration(room_map: Path, stream: Path, tmp_path: Path):
    shutil.copy(stream / "walk.avi", tmp_path / "alone.avi")
    words = [str(room_map), str(tmp_path / "alone.avi"), "--json", str(tmp_path / "a.json")]
    assert main(["localize", *words]) == 0
    lines = [json.loads(line) for line in (tmp_path / "a.json").read_text().splitlines()]
    assert {line["state"] for line in lines} == {"localized"}
    focals = [line["focal_length_px"] for line in lines]
    assert np.median(focals) == pytest.approx(CAMERA.fx, rel=0.02)


def test_options_that_contradict_are_wrong_usage(
    room_map: Path, stream: Path, queries: Path, complaint: Callable[..., str]
):
    assert "--single" in complaint("localize", room_map, stream, "--single", "--stream", status=2)
    assert "--max-jump" in complaint("localize", room_map, stream, "--max-jump", "-1", status=2)
    assert "--max-ms" in complaint("localize", room_map, stream, "--max-ms", "-1", status=2)
    assert "--odometry" in complaint(
        "localize", room_map, stream, queries, "--odometry", "a.tum", status=2
    )
    assert "--stream" in complaint("localize", room_map, queries, "--odometry", "a.tum", status=2)
