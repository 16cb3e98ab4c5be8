"""Which tile of an atlas is a recording of? A sample of its pictures is asked of the atlas; what
most answers name takes it, clearly or not at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from topoloc.atlas.atlas_localizer import AtlasLocalizer
from topoloc.atlas.manifest import Tile
from topoloc.bounds import Between, check_bounds
from topoloc.errors import TrajectoryError
from topoloc.lifelong.session_poses import Progress
from topoloc.localization.result import Localization
from topoloc.recordings.frame import StereoSequence


@dataclass(frozen=True)
class TileSelectionConfig:
    """When a recording is of a tile."""

    num_asked: Annotated[int, Between(1, 10_000)] = 12
    """Pictures of the recording, evenly chosen, that are asked of the atlas."""
    min_answers: Annotated[int, Between(1, 10_000)] = 3
    """So many of them at least must be localized in the tile, ..."""
    min_share: Annotated[float, Between(0.5, 1)] = 0.67
    """... and this share of those that are localized in it, or in tiles of one world with it."""


def find_tile_of_recording(
    localizer: AtlasLocalizer,
    sequence: StereoSequence,
    config: TileSelectionConfig,
    progress: Progress,
) -> Tile:
    """The tile that a recording's pictures are of: of several of one world the one in which most of
    them are localized.

    Raises:
        ConfigError: a setting is out of its bounds.
        TrajectoryError: too few of them are localized, or in tiles of several worlds.
        UnreadableImageError, QueryError, AtlasError: as of `AtlasLocalizer.localize`.
    """
    check_bounds(config)
    rows = np.unique(
        np.linspace(0, max(len(sequence) - 1, 0), min(config.num_asked, len(sequence)))
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
    return select_tile(sequence.name, len(rows), answers, localizer.atlas.manifest.by_id, config)


def select_tile(
    name: str,
    num_asked: int,
    answers: Sequence[Localization],
    tiles: Mapping[str, Tile],
    config: TileSelectionConfig,
) -> Tile:
    """The tile that these answers of so many pictures of the recording `name` speak for. Raises
    TrajectoryError."""
    counts = Counter(
        answer.provenance.tile for answer in answers if answer.provenance.tile is not None
    )
    if not counts or max(counts.values()) < config.min_answers:
        raise TrajectoryError(
            f"{name}: no tile recognises it: {_format_counts(counts)} of {num_asked} pictures"
            " asked; the atlas stays as it is"
        )
    best = min(counts, key=lambda tile_id: (-counts[tile_id], tile_id))
    world = tiles[best].in_joint_world.joint
    of_world = sum(
        number for tile_id, number in counts.items() if tiles[tile_id].in_joint_world.joint == world
    )
    if of_world < config.min_share * counts.total():
        raise TrajectoryError(
            f"{name}: it looks like several tiles: {_format_counts(counts)} of {num_asked} pictures"
            " asked; the atlas stays as it is"
        )
    return tiles[best]


def _format_counts(counts: Counter[str]) -> str:
    """How many pictures each tile knows, the most first."""
    return (
        ", ".join(f"{tile_id} knows {number}" for tile_id, number in counts.most_common(4))
        or "none knows any"
    )
