"""A whole evaluation: recordings with truth, and recordings of other places, against a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from topoloc.evaluation.metrics import EvaluatedQuery, group_by_recording, summarize
from topoloc.evaluation.query_localization import localize_out_of_map, localize_queries
from topoloc.evaluation.world_alignment import WorldFit, fit_worlds
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.image_calibration_check import check_camera_calibrations
from topoloc.localization.localizer import Localizer
from topoloc.mapping.build import Progress
from topoloc.recordings.frame import StereoSequence


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The answers to all queries; `to_json` gives the figures: counts, medians, recall."""

    answers: list[EvaluatedQuery]

    @cached_property
    def by_recording(self) -> dict[str, list[EvaluatedQuery]]:
        """The answers of each recording by its name, in the order of the queries."""
        return group_by_recording(self.answers)

    @cached_property
    def world_fits(self) -> list[WorldFit]:
        """For each recording whose errors one rigid transform explains, that transform: its truth
        is then given in another world than the map's."""
        fits = [fit_worlds(answers) for answers in self.by_recording.values()]
        return [fit for fit in fits if fit is not None]

    def calibrations(self) -> list[dict[str, Any]]:
        """Return, for each camera of each recording, whether the answers confirm its calibration,
        as JSON."""
        return [
            {"recording": name} | verdict.to_json()
            for name, answers in self.by_recording.items()
            for verdict in check_camera_calibrations(
                answer.result for answer in answers if answer.world_from_cam is not None
            )
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the figures of all answers and, under `recordings`, of each recording: counts,
        medians (m, degrees, ms), recall, false accepts."""
        return summarize(self.answers)


def evaluate(
    localizer: Localizer,
    sequences: Sequence[StereoSequence],
    out_of_map: Sequence[StereoSequence] = (),
    map_from_truth: Rigid3 | None = None,
    progress: Progress | None = None,
    tile_id: str | None = None,
) -> Evaluation:
    """Localize recordings with known poses, and recordings of other places.

    Args:
        localizer: localizes in a map or an atlas.
        sequences: recordings with truth; only their left (or colour) images are queried.
        out_of_map: recordings of other places: every pose given for one is a false accept.
        map_from_truth: transform from the world of the truth into the map's (m), if they differ.
        progress: called with a recording's name, queries done and queries in all.
        tile_id: the tile in whose world the truth is. It may be None if there is only one.

    Raises:
        AtlasError: there is no such tile.
        TrajectoryError: a recording of `sequences` has no poses.
        CalibrationError: a recording has no camera.
    """
    answers = list[EvaluatedQuery]()
    for sequence in sequences:
        answers += localize_queries(localizer, sequence, map_from_truth, progress, tile_id=tile_id)
    for sequence in out_of_map:
        answers += localize_out_of_map(localizer, sequence, progress)
    return Evaluation(answers)
