"""Test SVO files: the error without Stereolabs' SDK, and the SDK calls with a stand-in module."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tiny_recordings import assert_slices
from topoloc.apps.formats.recording_writer import RecordingWriter
from topoloc.apps.formats.svo import sdk_frames
from topoloc.errors import MissingExtraError, RecordingError
from topoloc.recordings.open import find_format, open_sequence
from topoloc.recordings.recording import as_monocular

NUM_FRAMES = 4


class StandInCamera:
    """Return frames whose grey is their number. The right images are 100 brighter."""

    position = 0

    def open(self, settings: Any) -> str:
        return (
            "SUCCESS"
            if not settings.path or settings.path.endswith("/walk.svo2")
            else "INVALID SVO FILE"
        )

    def close(self) -> None:
        self.position = -1

    def set_svo_position(self, position: int) -> None:
        self.position = position

    def grab(self) -> str:
        self.now = self.position
        self.position += 1
        return "SUCCESS" if self.now < NUM_FRAMES else "END OF SVO FILE"

    def get_timestamp(self, reference: str) -> SimpleNamespace:
        assert reference == "IMAGE"
        return SimpleNamespace(get_nanoseconds=lambda: 10**18 + self.now * 66_000_000)

    def retrieve_image(self, mat: Any, view: str) -> None:
        grey = self.now + (100 if view == "RIGHT" else 0)
        mat.get_data = lambda: np.full((376, 672, 4), (1, 2, grey, 255), np.uint8)

    def get_camera_information(self) -> SimpleNamespace:
        left = SimpleNamespace(fx=260.0, fy=260.0, cx=336.0, cy=188.0)
        calibration = SimpleNamespace(left_cam=left, get_camera_baseline=lambda: 0.12)
        size = SimpleNamespace(width=672, height=376)
        return SimpleNamespace(
            camera_configuration=SimpleNamespace(
                calibration_parameters=calibration, resolution=size
            )
        )


class Settings:
    path = ""

    def set_from_svo_file(self, path: str) -> None:
        self.path = path


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> None:
    sl = ModuleType("pyzed.sl")
    names = {
        "ERROR_CODE": ["SUCCESS"],
        "VIEW": ["LEFT", "RIGHT"],
        "DEPTH_MODE": ["NONE"],
        "UNIT": ["METER"],
        "TIME_REFERENCE": ["IMAGE"],
    }
    for name, members in names.items():
        setattr(sl, name, SimpleNamespace(**{member: member for member in members}))
    for name, kind in (
        ("Camera", StandInCamera),
        ("InitParameters", Settings),
        ("Mat", SimpleNamespace),
    ):
        setattr(sl, name, kind)
    package = ModuleType("pyzed")
    package.sl = sl  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "pyzed", package)
    monkeypatch.setitem(sys.modules, "pyzed.sl", sl)


def test_without_the_sdk_the_error_names_the_export(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "pyzed", None)
    path = tmp_path / "walk.svo2"
    path.write_bytes(b"svo")
    assert find_format(path) == "zed"
    with pytest.raises(
        MissingExtraError,
        match=(
            r"pyzed of Stereolabs' ZED SDK, .* export .* left/ and right/ with a"
            r" camera\.json"
        ),
    ):
        open_sequence(path)


@pytest.mark.usefixtures("sdk")
def test_frames_in_any_order(tmp_path: Path):
    path = tmp_path / "walk.svo2"
    path.write_bytes(b"svo")
    sequence = open_sequence(path)
    assert sequence.t_ns == [10**18 + index * 66_000_000 for index in range(NUM_FRAMES)]
    for index in (0, 1, 3, 1, -1):
        frame = sequence[index]
        assert frame.image[0, 0].tolist() == [index % NUM_FRAMES, 2, 1]
        assert frame.right is not None
        assert frame.right[0, 0].tolist() == [index % NUM_FRAMES + 100, 2, 1]
        assert frame.rig is not None
        assert frame.rig.baseline == pytest.approx(0.12)
    assert as_monocular(sequence)[2].image[0, 0, 0] == 2
    assert sequence[0].image[0, 0, 0] == 0
    assert_slices(sequence)


@pytest.mark.usefixtures("sdk")
def test_a_file_that_the_sdk_cannot_open(tmp_path: Path):
    path = tmp_path / "broken.svo"
    path.write_bytes(b"svo")
    with pytest.raises(RecordingError, match=r"the ZED SDK cannot open .*broken"):
        open_sequence(path)


@pytest.mark.usefixtures("sdk")
def test_a_zed_that_is_plugged_in(tmp_path: Path):
    frames = sdk_frames(threading.Event())
    with RecordingWriter(tmp_path / "out") as writer:
        for _ in range(NUM_FRAMES):
            writer.write(next(frames))
    with pytest.raises(RecordingError, match="gives no more images"):
        next(frames)
    read = open_sequence(tmp_path / "out")
    assert read.t_ns == [10**18 + index * 66_000_000 for index in range(NUM_FRAMES)]
    last = read[NUM_FRAMES - 1]
    assert last.right is not None
    assert last.rig is not None
    assert last.rig.baseline == pytest.approx(0.12)
    assert (last.image[0, 0].tolist(), last.right[0, 0].tolist()) == ([3, 2, 1], [103, 2, 1])


@pytest.mark.usefixtures("sdk")
def test_a_plugged_in_zed_is_let_go():
    stop, num_frames = threading.Event(), 0
    for _ in sdk_frames(stop):
        num_frames += 1
        stop.set()
    assert num_frames == 1


def test_a_zed_without_its_sdk(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pyzed", None)
    with pytest.raises(MissingExtraError, match="a ZED needs pyzed"):
        next(sdk_frames(threading.Event()))
