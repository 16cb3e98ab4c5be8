"""Find the tile of an atlas that a recording belongs to, by localizing a sample of its images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Tile
from topoloc.errors import TrajectoryError
from topoloc.lifelong.node_localization import sample_evenly
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
    rows = sample_evenly(range(len(sequence)), num_queries)
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
    """Return the tile (of `tiles`, by id) with the most localizations (`answers`) of the
    `num_asked` sampled images of the recording `name`. Raises TrajectoryError if no tile has
    enough, or they are in tiles of several worlds."""
    min_answers = 3  # minimum number of images localized in the tile
    # Minimum share of the localized images that are in the tile or in tiles of the same
    # world.
    min_share = 0.67
    found = (answer.provenance.tile for answer in answers)
    counts = Counter(tile_id for tile_id in found if tile_id is not None)
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
