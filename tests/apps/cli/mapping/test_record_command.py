"""Test `topoloc record`: each source, the recorded folder, signals, and refused inputs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from topoloc.apps.cli import main
from topoloc.recordings.open import open_sequence

NUMBERS = "fx=350\nfy=350\ncx=335.5\ncy=187.5\n"
CONF = f"[LEFT_CAM_VGA]\n{NUMBERS}k1=-0.17\n[RIGHT_CAM_VGA]\n{NUMBERS}[STEREO]\nBaseline=120\n"


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a video of two VGA images side by side: grey 10 k, the right image 100 brighter."""
    path = tmp_path_factory.mktemp("film") / "camera.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 30.0, (1344, 376))
    for index in range(6):
        picture = np.full((376, 1344, 3), 10 * index, np.uint8)
        picture[:, 672:] += 100
        writer.write(picture)
    writer.release()
    return path


def record(*args: object) -> int:
    return main(["record", *map(str, args)])


def test_a_webcam(film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert (
        record(
            "webcam",
            tmp_path / "out",
            "--source",
            film,
            "--camera",
            "700,700,671.5,187.5",
            "--json",
            "-",
        )
        == 0
    )
    facts = json.loads(capsys.readouterr().out)
    assert facts == {
        "out": str(tmp_path / "out"),
        "num_frames": 6,
        "stereo": False,
        "depth": False,
        "poses": False,
    }
    read = open_sequence(tmp_path / "out")
    assert [int(frame.image[5, 5, 0]) for frame in read] == pytest.approx(
        [10 * index for index in range(6)], abs=2
    )
    assert read[0].camera is not None
    assert read[0].camera.fx == 700.0


def test_a_zed_as_usb_camera(film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "SN7.conf").write_text(CONF)
    options = ("--source", film, "--camera", tmp_path / "SN7.conf", "--frames", 3, "--jpeg", 95)
    assert record("zed", tmp_path / "out", *options) == 0
    assert "3 frames (stereo)" in capsys.readouterr().out
    frame = open_sequence(tmp_path / "out")[2]
    assert frame.right is not None
    assert frame.rig is not None
    assert (int(frame.image[5, 5, 0]), int(frame.right[5, 5, 0])) == pytest.approx((20, 120), abs=3)
    assert frame.rig.left.params[4] == -0.17
    assert frame.rig.baseline == pytest.approx(0.12)


def test_few_frames_a_second(film: Path, tmp_path: Path):
    assert record("webcam", tmp_path / "out", "--source", film, "--fps", 0.01) == 0
    assert len(open_sequence(tmp_path / "out")) == 1


def test_the_recording_before_stays(film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert record("webcam", tmp_path / "out", "--source", film, "--frames", 1) == 0
    assert record("webcam", tmp_path / "out", "--source", film) == 1
    assert "is not empty" in capsys.readouterr().err
    assert len(open_sequence(tmp_path / "out")) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_in_good_order(film: Path, tmp_path: Path, number: signal.Signals):
    pipe = tmp_path / "endless"  # endless images: MJPEG through a pipe
    os.mkfifo(pipe)
    command = [
        sys.executable,
        "-m",
        "topoloc",
        "record",
        "webcam",
        str(tmp_path / "out"),
        "--source",
        str(pipe),
    ]
    recorder = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        with pipe.open("wb") as file:
            data = cv2.imencode(
                ".jpg", np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
            )[1].tobytes()
            deadline = time.monotonic() + 30.0
            while not (tmp_path / "out/times.txt").exists() and time.monotonic() < deadline:
                file.write(data)
            recorder.send_signal(number)
            while recorder.poll() is None and time.monotonic() < deadline:
                try:
                    file.write(data)
                except BrokenPipeError:
                    break
        out, err = recorder.communicate(timeout=20.0)
    except BrokenPipeError:
        out, err = recorder.communicate(timeout=20.0)
    finally:
        recorder.kill()
    assert (recorder.returncode, err) == (0, "")
    read = open_sequence(tmp_path / "out")
    assert f"{len(read)} frames" in out
    assert all(frame.image.shape == (48, 64, 3) for frame in read)


@pytest.mark.parametrize(
    ("args", "status", "said"),
    [
        (("webcam", "--source", "/dev/video99"), 1, "does not answer"),
        (("zed",), 1, "--camera SN12345.conf records it as a USB camera"),
        (("carla", "--server", "127.0.0.1"), 2, "no HOST:PORT"),
        (("carla", "--source", "0"), 2, "not for CARLA"),
        (("webcam", "--lane-offset", "1"), 2, "do not apply to webcam"),
        (("webcam", "--size", "big"), 2, "no WIDTHxHEIGHT"),
        (("webcam", "--fps", "0"), 2, "above 0"),
        (("webcam", "--frames", "0"), 2, "at least 1"),
        (("webcam", "--jpeg", "101"), 2, "from 1 to 100"),
    ],
)
def test_invalid_sources_are_refused(
    args: tuple[str, ...],
    status: int,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    kind, *options = args
    assert record(kind, tmp_path / "out", *options) == status
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_single_images_are_no_pairs(film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "SN7.conf").write_text(CONF.replace("VGA", "HD"))
    assert record("zed", tmp_path / "out", "--source", film, "--camera", tmp_path / "SN7.conf") == 1
    assert "no calibration of VGA" in capsys.readouterr().err


def test_no_carla_server_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("carla", reason="CARLA's client (extra carla) is not installed")
    monkeypatch.setattr("topoloc.apps.formats.carla._CONNECT_S", 0.5)
    assert record("carla", tmp_path / "out", "--server", "127.0.0.1:9") == 1
    assert capsys.readouterr().err.splitlines() == [
        "error: no CARLA server answers at 127.0.0.1:9; start CarlaUE4.sh (or its container) first"
    ]
