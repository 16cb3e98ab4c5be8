"""Define the interface of a recording format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from topoloc.recordings.frame import StereoSequence


@dataclass(frozen=True)
class RecordingFormat:
    """Hold the functions that recognise and open recordings of a format."""

    expected_files: str
    can_open: Callable[[Path], bool]
    open: Callable[..., StereoSequence]
    open_options: tuple[str, ...] = ()
    """Keywords that `open` accepts. `topics`: the topics of a bag. `images`: the image folder of a
    model. `calibration`: a calibration, if recordings of the format may lack one (otherwise
    `open_sequence` replaces the format's own). `calibration_file`: the path of a calibration,
    passed on as `calibration`."""
