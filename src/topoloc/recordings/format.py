"""The interface of a recording format: how it is recognised and opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from topoloc.recordings.frame import StereoSequence


@dataclass(frozen=True)
class RecordingFormat:
    """A recording format: the function that recognises it and the function that opens it."""

    expected_files: str
    can_open: Callable[[Path], bool]
    open: Callable[..., StereoSequence]
    open_options: tuple[str, ...] = ()
    """Keywords that `open` accepts: the `topics` of a bag, the folder of a model's `images`, a
    `calibration` if the format may have none (otherwise `open_sequence` replaces the format's own
    calibration), or the file of a calibration as it is (`calibration_file`)."""
