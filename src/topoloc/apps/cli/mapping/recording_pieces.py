"""Long recordings in pieces that overlap, each mapped by itself: `topoloc build --ray ...
--split`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256

from topoloc import TopolocError, open_sequence
from topoloc.apps.cli.mapping.map_jobs import MapJob
from topoloc.apps.cli.output import UsageError
from topoloc.plugin import split_selection

MIN_OVERLAP = 3


@dataclass(frozen=True)
class SplitOptions:
    """Pieces of at most so many frames, and how many of these a piece shares with the next one at
    least.

    Raises:
        UsageError: they cannot be so.
    """

    num_frames: int
    num_shared: int

    def __post_init__(self) -> None:
        if not MIN_OVERLAP <= self.num_shared <= self.num_frames // 2:
            raise UsageError(
                "--split takes the frames of a piece and, behind a comma, how many of these the"
                f" next one shares: {MIN_OVERLAP} at least and at most half, not"
                f" {self.num_shared} of {self.num_frames}"
            )

    @staticmethod
    def of(text: str | None) -> SplitOptions | None:
        """As the option says it, `500` or `500,50`: a tenth is shared where that is not said.
        Raises UsageError."""
        if text is None:
            return None
        parts = text.split(",")
        if len(parts) > 2 or not all(
            part.isascii() and part.isdigit() and len(part) < 10 for part in parts
        ):
            raise UsageError(f"--split takes frames, such as 500 or 500,50, not {text[:40]!r}")
        num_frames = int(parts[0])
        return SplitOptions(
            num_frames, int(parts[1]) if len(parts) == 2 else max(num_frames // 10, MIN_OVERLAP)
        )

    def ranges(self, total: int) -> list[tuple[int, int]]:
        """First frame and the one after the last of each piece of so many frames in all; all are of
        one length."""
        if total <= self.num_frames:
            return [(0, total)]
        step = self.num_frames - self.num_shared
        num = 1 + -(-(total - self.num_frames) // step)
        starts = [round(k * (total - self.num_frames) / (num - 1)) for k in range(num)]
        return [(start, start + self.num_frames) for start in starts]


@dataclass(frozen=True)
class Pieces:
    """The maps to make of one recording, one after the other along it, and the world that they
    share by its own poses; None where it has none, or there is but one map."""

    piece_jobs: list[MapJob]
    world: str | None = None


def split_recording(map_job: MapJob, tile_id: str, split: SplitOptions) -> Pieces:
    """The pieces of a recording, that of `map_job`; as it is where it is short, or cannot be
    opened, of which its own task tells.

    Args:
        tile_id: what the tile of the whole recording would be called.

    Raises:
        UsageError: it is long, and frames of it are chosen.
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
    asked = map_job.asked
    if not asked.trajectory and any(sequence.poses):
        asked = replace(
            asked, trajectory=("truth",)
        )  # of every piece, also where one happens to have no pose
    has_poses = asked.trajectory not in ((), ("slam",))
    named = _select_frames(recording, ranges)
    made = [replace(map_job, recordings=(name,), asked=asked) for name in named]
    return Pieces(made, _world_name(recording, tile_id) if has_poses else None)


def _select_frames(recording: str, ranges: Sequence[tuple[int, int]]) -> list[str]:
    """The recording with these of its frames chosen. Raises UsageError."""
    path, selection = split_selection(recording)
    if selection is not None:
        raise UsageError(
            f"--split takes whole recordings, but frames are chosen of {path} ({selection[:40]})"
        )
    return [f"{path}@{start}:{stop}" for start, stop in ranges]


def _world_name(recording: str, tile_id: str) -> str:
    """A name for the world of a recording's own poses that no other recording's has."""
    return f"{tile_id[:80]}-{sha256(os.fsencode(os.path.abspath(recording))).hexdigest()[:8]}"
