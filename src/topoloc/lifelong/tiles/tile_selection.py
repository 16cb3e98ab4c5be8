"""Find the tile of an atlas that a recording belongs to, by localizing a sample of its images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Tile
from topoloc.errors import TrajectoryError
from topoloc.lifelong.session_poses import Progress
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.recordings.frame import StereoSequence


def find_tile_of_recording(
    atlas: Atlas, localizer: Localizer, sequence: StereoSequence, progress: Progress
) -> Tile:
    """Return the tile in which most sampled images of a recording are localized.

    Raises:
        TrajectoryError: too few images are localized, or they are in tiles of several worlds.
        UnreadableImageError, QueryError, AtlasError: raised by `Localizer.localize`.
    """
    # Number of images of the recording, evenly spaced, that are localized in the atlas.
    num_queries = 12
    rows = np.unique(
        np.linspace(0, max(len(sequence) - 1, 0), min(num_queries, len(sequence)))
        .round()
        .astype(int)
    ).tolist()
    answers = list[Localization]()
    for done, row in enumerate(rows):
        frame = sequence[row]
        result = localizer.localize(frame.image, frame.camera)
        if isinstance(result, Localization):
            answers.append(result)
        progress("which tile", done + 1, len(rows))
    return select_tile(sequence.name, len(rows), answers, atlas.manifest.by_id)


def select_tile(
    name: str, num_asked: int, answers: Sequence[Localization], tiles: Mapping[str, Tile]
) -> Tile:
    """Return the tile with the most localizations.

    Args:
        name: the recording's name, for error messages.
        num_asked: the number of sampled images.
        answers: the localizations of the sampled images.
        tiles: the tiles by id.

    Raises:
        TrajectoryError: no tile has enough localizations, or they are in tiles of several worlds.
    """
    min_answers = 3  # minimum number of images localized in the tile
    # Minimum share of the localized images that are in the tile or in tiles of the same
    # world.
    min_share = 0.67
    counts = Counter(
        answer.provenance.tile for answer in answers if answer.provenance.tile is not None
    )
    if not counts or max(counts.values()) < min_answers:
        raise TrajectoryError(
            f"{name}: no tile recognises it: {_format_counts(counts)} of {num_asked} pictures"
            " asked; the atlas stays as it is"
        )
    best = min(counts, key=lambda tile_id: (-counts[tile_id], tile_id))
    world = tiles[best].in_joint_world.joint
    of_world = sum(
        number for tile_id, number in counts.items() if tiles[tile_id].in_joint_world.joint == world
    )
    if of_world < min_share * counts.total():
        raise TrajectoryError(
            f"{name}: it looks like several tiles: {_format_counts(counts)} of {num_asked} pictures"
            " asked; the atlas stays as it is"
        )
    return tiles[best]


def _format_counts(counts: Counter[str]) -> str:
    """Format the number of localized images per tile, the largest first."""
    return (
        ", ".join(f"{tile_id} knows {number}" for tile_id, number in counts.most_common(4))
        or "none knows any"
    )
