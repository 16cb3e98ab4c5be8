"""Define the sessions and edits of a map."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.retrieval.coarse import Image

_YEAR_2000_NS = 946_684_800 * 1_000_000_000
"""Earlier times belong to clocks that start at 0 and have no date."""


@dataclass(frozen=True)
class Illumination:
    """Hold the illumination of a session, averaged over its images. Grey levels are 0 to 1.

    `level` is the mean grey level, `contrast` the standard deviation of grey levels within an
    image. `dark` and `bright` are the shares of pixels below 1/16 and above 15/16. `red` and `blue`
    are the mean levels of these colours divided by green, 1 in grey images.
    """

    level: float
    contrast: float
    dark: float
    bright: float
    red: float
    blue: float

    @staticmethod
    def of_image(image: Image) -> Illumination:
        """Measure the illumination of an image (uint8) on every fourth pixel in each direction."""
        sample = image[::4, ::4].astype(np.float64) / 255.0
        grey, colours = sample, np.ones(3)
        if sample.ndim == 3:
            grey = sample @ np.array([0.299, 0.587, 0.114])
            colours = sample.reshape(-1, 3).mean(axis=0) + 1e-3
        red, blue = colours[0] / colours[1], colours[2] / colours[1]
        parts = grey.mean(), grey.std(), (grey < 1 / 16).mean(), (grey > 15 / 16).mean(), red, blue
        return Illumination(*map(float, parts))


@dataclass(frozen=True)
class Session:
    """Hold one recording of the map.

    `session_id` never changes and is never reused. Two sessions may have the same name. `recording`
    is the folder or file, if known. `poses_from` is `truth`, `slam`, `map`, the name of a
    trajectory file, or `given` if the caller provided the poses. Times are those of the first and
    last mapping image, in nanoseconds of the recording's clock. `camera` is that of its images
    before rectification. `light` is measured, and `light_name` is set by the user.
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
        """Return the ISO date and time (UTC) of the first mapping image, or None if the recording's
        clock has no date."""
        return _format_date(self.start_ns)

    @property
    def end_date(self) -> str | None:
        """Return the ISO date and time (UTC) of the last mapping image, or None as `start_date`."""
        return _format_date(self.end_ns)


@dataclass(frozen=True)
class Edit:
    """Hold one edit of the map.

    This is: its name, its day (ISO, UTC), the schema of the file it was written in, and its changes
    (numbers and texts by name).
    """

    edit_id: int
    name: str
    date: str
    schema: int
    changes: Mapping[str, Any] | None = None


def today() -> str:
    """Return the day (ISO, UTC). SOURCE_DATE_EPOCH (seconds) replaces the current time if set, for
    byte-identical builds."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    now = datetime.fromtimestamp(int(epoch), UTC) if epoch.isdigit() else datetime.now(UTC)
    return now.date().isoformat()


def average_illumination(lights: Sequence[Illumination]) -> Illumination | None:
    """Return the mean illumination, rounded to four decimals, or None if `lights` is empty."""
    if not lights:
        return None
    rows = np.array([astuple(light) for light in lights])
    return Illumination(*(round(float(value), 4) for value in rows.mean(axis=0)))


def _format_date(t_ns: int | None) -> str | None:
    if t_ns is None or t_ns < _YEAR_2000_NS:
        return None
    try:
        return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="seconds")
    except (OverflowError, ValueError, OSError):
        return None
