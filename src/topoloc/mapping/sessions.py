"""Where a map comes from: the sessions in which its pictures were taken, and the edits that made it
what it is."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.recordings.frame import Image, StereoSequence
from topoloc.recordings.recording import Recording, SequenceView

_YEAR_2000_NS = 946_684_800 * 1_000_000_000
"""Recordings whose clock begins at 0 tell no date."""


@dataclass(frozen=True)
class Illumination:
    """The light of a session as its pictures show it, means over them; grey levels are 0 to 1.

    `level` is the mean grey level, `contrast` the standard deviation of the grey levels within a
    picture, `dark` and `bright` the shares of pixels below 1/16 and above 15/16. `red` and `blue`
    are the mean levels of these colours divided by that of green, 1 in grey pictures.
    """

    level: float
    contrast: float
    dark: float
    bright: float
    red: float
    blue: float

    @staticmethod
    def of_image(image: Image) -> Illumination:
        """The light in one picture (uint8), of every fourth pixel each way."""
        sample = image[::4, ::4].astype(np.float64) / 255.0
        grey = sample if sample.ndim == 2 else sample @ np.array([0.299, 0.587, 0.114])
        red, green, blue = (
            (1.0, 1.0, 1.0) if sample.ndim == 2 else sample.reshape(-1, 3).mean(axis=0) + 1e-3
        )
        dark, bright = float((grey < 1 / 16).mean()), float((grey > 15 / 16).mean())
        return Illumination(
            float(grey.mean()),
            float(grey.std()),
            dark,
            bright,
            float(red / green),
            float(blue / green),
        )


@dataclass(frozen=True)
class Session:
    """One recording that the map was made from.

    `session_id` never changes and is never used again; two sessions may have one name. `recording`
    is the folder or file, as far as known. `poses_from` is `truth`, `slam`, the name of a
    trajectory file, or `given` where the caller brought the poses. Times are those of the first and
    the last mapping image, nanoseconds of the recording's clock. `light` is measured, `light_name`
    what the user calls it.
    """

    session_id: int
    name: str
    recording: str | None = None
    poses_from: str = "given"
    start_ns: int | None = None
    end_ns: int | None = None
    camera: Camera | None = None
    light: Illumination | None = None
    light_name: str | None = None

    @property
    def start_date(self) -> str | None:
        """ISO date and time (UTC); None where the recording's clock tells none."""
        return _format_date(self.start_ns)

    @property
    def end_date(self) -> str | None:
        return _format_date(self.end_ns)


@dataclass(frozen=True)
class Edit:
    """One change of the map: its name, the day (ISO, UTC), the schema of the file that it was
    written in, and what it changed: numbers and texts by their names."""

    edit_id: int
    name: str
    date: str
    schema: int
    changes: Mapping[str, Any] | None = None


def today() -> str:
    """The day (ISO, UTC); SOURCE_DATE_EPOCH (seconds), where it is set, stands for now: builds can
    then be repeated to the byte."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(epoch), UTC) if epoch.isdigit() else datetime.now(UTC)
    return now.date().isoformat()


def find_source_path(sequence: StereoSequence) -> str | None:
    """The folder or file that a sequence was opened from, where it has one."""
    while isinstance(sequence, SequenceView):
        sequence = sequence.base
    return str(sequence.root) if isinstance(sequence, Recording) else None


def find_pose_source(sequence: StereoSequence) -> str:
    """`truth` where the poses are those that the recording came with, else `given`."""
    if isinstance(sequence, SequenceView):
        before = sequence.base.poses
        is_same = all(
            pose is before[index]
            for index, pose in zip(sequence.indices, sequence.poses, strict=True)
        )
        return find_pose_source(sequence.base) if is_same else "given"
    return "truth" if isinstance(sequence, Recording) else "given"


def average_illumination(lights: Sequence[Illumination]) -> Illumination | None:
    """The mean of many, rounded to what is worth reading."""
    if not lights:
        return None
    rows = np.array(
        [
            [light.level, light.contrast, light.dark, light.bright, light.red, light.blue]
            for light in lights
        ]
    )
    return Illumination(*(round(float(value), 4) for value in rows.mean(axis=0)))


def sessions_from_names(names: Sequence[str]) -> list[Session]:
    """A session for each distinct name, in the order of their first mention: all that an older map
    knows of them."""
    return [Session(number, name) for number, name in enumerate(dict.fromkeys(names))]


def _format_date(t_ns: int | None) -> str | None:
    if t_ns is None or t_ns < _YEAR_2000_NS:
        return None
    try:
        return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None
