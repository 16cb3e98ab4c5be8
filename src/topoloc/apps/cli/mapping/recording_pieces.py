"""Split long recordings into overlapping pieces: `topoloc build --ray ... --split`."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from hashlib import sha256

from topoloc import TopolocError, open_sequence
from topoloc.apps.cli.mapping.map_jobs import MapJob
from topoloc.apps.cli.output import UsageError
from topoloc.plugin import split_selection

MIN_OVERLAP = 3


@dataclass(frozen=True)
class SplitOptions:
    """Maximum number of frames of a piece, and minimum number shared with the next one.

    Raises:
        UsageError: the numbers do not fit together.
    """

    num_frames: int
    num_shared: int

    def __post_init__(self) -> None:
        if not MIN_OVERLAP <= self.num_shared <= self.num_frames // 2:
            raise UsageError(
                "--split FRAMES,SHARED: successive pieces must share at least"
                f" {MIN_OVERLAP} frames and at most half, not {self.num_shared} of"
                f" {self.num_frames}"
            )

    @staticmethod
    def of(text: str | None) -> SplitOptions | None:
        """Parse the option, `500` or `500,50`. By default a tenth is shared. Raises UsageError."""
        if text is None:
            return None
        parts = re.fullmatch(r"([0-9]{1,9})(?:,([0-9]{1,9}))?", text)
        if parts is None:
            raise UsageError(f"--split takes frames, such as 500 or 500,50, not {text[:40]!r}")
        num_frames = int(parts[1])
        return SplitOptions(num_frames, int(parts[2] or max(num_frames // 10, MIN_OVERLAP)))

    def ranges(self, total: int) -> list[tuple[int, int]]:
        """Return the first frame, and the one after the last, of each piece of `total` frames. All
        pieces have the same length."""
        if total <= self.num_frames:
            return [(0, total)]
        step = self.num_frames - self.num_shared
        num = 1 + -(-(total - self.num_frames) // step)
        starts = [round(k * (total - self.num_frames) / (num - 1)) for k in range(num)]
        return [(start, start + self.num_frames) for start in starts]


@dataclass(frozen=True)
class Pieces:
    """The maps of successive pieces of a recording, and the world of its own poses. The world is
    None without such poses, and for a single map."""

    piece_jobs: list[MapJob]
    world: str | None = None


def split_recording(map_job: MapJob, tile_id: str, split: SplitOptions) -> Pieces:
    """Split the recording of `map_job`.

    A short recording stays whole, and one that cannot be opened, so that its own task fails.

    Args:
        tile_id: tile id of the whole recording.

    Raises:
        UsageError: the recording is long, and frames of it are selected.
    """
    (recording,) = map_job.recordings
    try:
        sequence = open_sequence(
            recording, map_job.format, map_job.camera, map_job.images, map_job.topics
        )
    except TopolocError:
        return Pieces([map_job])
    ranges = split.ranges(len(sequence))
    if len(ranges) == 1:
        return Pieces([map_job])
    options = map_job.pose_options
    if not options.trajectory and any(sequence.poses):  # also for pieces without a pose
        options = replace(options, trajectory=("truth",))
    path, selection = split_selection(recording)
    if selection is not None:
        raise UsageError(
            f"--split takes whole recordings, but frames of {path} are selected ({selection[:40]})"
        )
    pieces = [
        replace(map_job, recordings=(f"{path}@{start}:{stop}",), pose_options=options)
        for start, stop in ranges
    ]
    if options.trajectory in ((), ("slam",)):
        return Pieces(pieces)
    digest = sha256(os.fsencode(os.path.abspath(recording))).hexdigest()  # unique by recording
    return Pieces(pieces, f"{tile_id[:80]}-{digest[:8]}")
