"""Some frames of a recording: every second one, the first minute, 60 of every 100."""

from __future__ import annotations

import re
from collections.abc import Sequence

from topoloc.errors import RecordingError
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.recording import SequenceView

_SLICE = re.compile(r"(-?\d+)?:(-?\d+)?(?::([1-9]\d*)?)?")
_BLOCK = re.compile(r"(\d+)-(\d+)/([1-9]\d*)")
_INDEX = re.compile(r"-?\d+")


def sequence_subset(sequence: StereoSequence, indices: Sequence[int]) -> StereoSequence:
    """These frames of a sequence, in this order, with their poses; pictures are still read one by one.

    Raises:
        IndexError: an index lies outside the sequence.
    """
    poses = sequence.poses
    return SequenceView(sequence, list(indices), [poses[index] for index in indices])


def parse_selection(text: str, num_frames: int) -> list[int]:
    """Frame numbers, increasing and once each, of a selection such as ``0::2``, ``0:10,50:60``, ``-1`` or ``0-59/100``.

    A slice is Python's, with a positive step; ``FIRST-LAST/PERIOD`` are the frames whose number modulo PERIOD lies in
    FIRST to LAST, both included.

    Raises:
        RecordingError: it is none of these, or a single number lies outside the recording.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        part = part.strip()
        if bounds := _SLICE.fullmatch(part):
            chosen.update(range(num_frames)[slice(*(int(bound) if bound else None for bound in bounds.groups()))])
        elif block := _BLOCK.fullmatch(part):
            first, last, period = (int(number) for number in block.groups())
            chosen.update(index for index in range(num_frames) if first <= index % period <= last)
        elif _INDEX.fullmatch(part):
            if not -num_frames <= int(part) < num_frames:
                raise RecordingError(f"frame {part} of a recording of {num_frames}")
            chosen.add(int(part) % num_frames)
        else:
            raise RecordingError(f"{part!r} chooses no frames; write START:STOP:STEP, a number, or FIRST-LAST/PERIOD")
    return sorted(chosen)
