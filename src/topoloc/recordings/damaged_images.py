"""Leave frames out of a recording whose image files are missing, empty or truncated."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from topoloc.errors import RecordingError, UnreadableImageError
from topoloc.recordings.frame import SequenceView, StereoSequence, sequence_subset
from topoloc.recordings.image_io import read_depth_image, read_image


def leave_out_damaged(
    sequence: StereoSequence, warn: Callable[[str], object] | None = None
) -> StereoSequence:
    """Return a recording of image files without the frames that have a missing, empty or truncated
    file. `warn` is called with their number. Raises RecordingError: more than half have one."""
    base, rows = sequence, list(range(len(sequence)))
    while isinstance(base, SequenceView):
        base, rows = base.base, [base.indices[row] for row in rows]
    paths_of: Callable[[int], list[Path]] | None = getattr(base, "paths_of", None)
    if paths_of is None:
        return sequence
    damaged = [next(filter(_is_damaged, paths_of(row)), None) for row in rows]
    whole = [k for k, path in enumerate(damaged) if path is None]
    if len(whole) == len(rows):
        return sequence
    first = next(path for path in damaged if path is not None)
    num = f"{sequence.name}: {len(rows) - len(whole)} of {len(rows)} frames"
    if 2 * len(whole) < len(rows):
        raise RecordingError(
            f"{num} have a missing or damaged image (first: {first}); copy the recording again"
        )
    if warn is not None:
        warn(f"{num} left out: image missing or damaged (first: {first})")
    return sequence_subset(sequence, whole)


def _is_damaged(path: Path) -> bool:
    """Return whether an image or depth image is missing, empty or truncated. PNG and JPEG that end
    as their format does are not decoded. The end of a thumbnail may stand before it."""
    ends = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}
    with suppress(OSError), path.open("rb") as file:
        start = file.read(4)
        file.seek(max(0, file.seek(0, os.SEEK_END) - 8))
        tail = file.read()
        if any(start.startswith(magic) and tail.endswith(end) for magic, end in ends.items()):
            return False
    for read in (read_image, lambda path: read_depth_image(path, 1.0)):
        try:
            read(path)
        except UnreadableImageError:
            continue
        except RecordingError:  # depth of another unit
            pass
        return False
    return True
