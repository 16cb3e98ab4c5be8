"""Localize recordings with ground truth, and recordings of other places, in a map."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from topoloc.errors import CalibrationError, TrajectoryError
from topoloc.evaluation.metrics import (
    EvaluatedQuery,
    WorldFit,
    find_quarters,
    fit_worlds,
    group_by_recording,
    summarize,
)
from topoloc.geometry.alignment import rotation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.localization.image_calibration_check import check_camera_calibrations
from topoloc.localization.localizer import Localizer
from topoloc.mapping.certificate import Quarter
from topoloc.mapping.config import Progress
from topoloc.mapping.nodes import node_distances
from topoloc.mapping.storage.entries import Illumination
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import NodeId, Row, as_rows
from topoloc.recordings.frame import Image, StereoFrame, StereoSequence
from topoloc.rigs.rig import RigFrame
from topoloc.rigs.rig_localizer import RigLocalizer
from topoloc.rigs.rig_result import as_image


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation(OneLine):
    """The answers to all queries; `to_json` gives the figures: counts, medians, recall."""

    answers: list[EvaluatedQuery]

    @cached_property
    def by_recording(self) -> dict[str, list[EvaluatedQuery]]:
        """Return the answers of each recording by its name, in the order of the queries."""
        return group_by_recording(self.answers)

    @cached_property
    def world_fits(self) -> list[WorldFit]:
        """Return, for each recording whose errors one rigid transform explains, that transform: its
        truth is then given in another world than the map's."""
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

    @cached_property
    def quarters(self) -> list[Quarter]:
        """Return the quarters of the poses by difficulty, the hardest first."""
        return find_quarters(self.answers)


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


# A node within this many D_thresh counts as a neighbour of the query.
NEIGHBOUR_RADIUS = 1.5
LogLight: TypeAlias = Float[np.ndarray, " 3"]


def localize_queries(
    localizer: Localizer,
    sequence: StereoSequence,
    map_from_truth: Rigid3 | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    label: str | None = None,
    frames: Sequence[int] | None = None,
    tile_id: str | None = None,
) -> list[EvaluatedQuery]:
    """Localize every frame with a known pose. The localizer receives only the left (or colour)
    image.

    Args:
        localizer: the localizer of the map or atlas.
        sequence: the recording.
        map_from_truth: the transform from the recording's world to the map's, if they differ.
        progress: is called with the label, frames done and all frames.
        label: the name of the recording in the results. Defaults to its own name.
        frames: localize only these frames, in this order. Their poses must be known.
        tile_id: the tile in whose world the true poses are. It may be None if there is only one.

    Raises:
        AtlasError: there is no such tile.
        TrajectoryError: the recording has no ground truth.
        CalibrationError: the recording has no camera model.
    """
    with localizer.in_tile(tile_id) as in_tile:
        topomap, tile_id = in_tile.topomap, in_tile.tile_ids[0]
        nodes = topomap.node_poses
    frames = find_frames_with_truth(sequence) if frames is None else frames
    label, answers, lights = label or sequence.name, [], dict[Row, LogLight]()
    for done, i in enumerate(frames):
        frame, pose = sequence[i], sequence.poses[i]
        answer = _localize(localizer, frame, partial(_read_image, sequence, i), label)
        if pose is None:
            raise TrajectoryError(f"{answer.query}: no known pose to judge against")
        world_from_cam = pose if map_from_truth is None else map_from_truth @ pose
        answer = replace(answer, world_from_cam=world_from_cam)
        if not isinstance(frame, RigFrame):  # a rig looks in several directions
            distances = node_distances(world_from_cam, nodes, topomap.config.lambda_rot)
            nearest = topomap.summaries[int(np.argmin(distances))]
            reach = max(NEIGHBOUR_RADIUS * topomap.config.d_thresh, float(distances.min()))
            with localizer.in_tile(tile_id) as in_tile:
                rows = as_rows(np.flatnonzero(distances <= reach).tolist())
                light_ratio = _find_light_ratio(frame.image, in_tile.topomap, rows, lights)
            answer = replace(
                answer,
                nearest_node_id=nearest.node_id,
                neighbour_ids=find_neighbour_ids(topomap, distances),
                angle_deg=math.degrees(rotation_error(world_from_cam, nearest.world_from_cam)),
                light_ratio=light_ratio,
            )
        answers.append(_to_answered_world(localizer, answer, tile_id))
        if progress:
            progress(label, done + 1, len(frames))
    return answers


def localize_out_of_map(
    localizer: Localizer,
    sequence: StereoSequence,
    progress: Callable[[str, int, int], None] | None = None,
    label: str | None = None,
    frames: Sequence[int] | None = None,
) -> list[EvaluatedQuery]:
    """Localize out-of-map images. Every pose of the results is false.

    Args:
        localizer: the localizer of the map or atlas.
        sequence: the recording.
        progress: is called with the label, frames done and all frames.
        label: the name of the recording in the results. Defaults to its own name.
        frames: localize only these frames, in this order.

    Raises:
        CalibrationError: the recording has no camera model.
    """
    label, frames = label or sequence.name, range(len(sequence)) if frames is None else frames
    answers = []
    for done, i in enumerate(frames):
        answers.append(_localize(localizer, sequence[i], partial(_read_image, sequence, i), label))
        if progress:
            progress(f"{label} (out of map)", done + 1, len(frames))
    return answers


def find_frames_with_truth(sequence: StereoSequence) -> list[int]:
    """Return the frames with a known pose. Raises TrajectoryError if there are none."""
    frames = [i for i, pose in enumerate(sequence.poses) if pose is not None]
    if not frames:
        raise TrajectoryError(f"{sequence.name}: no frame has a known pose to judge against")
    return frames


def find_neighbour_ids(
    topomap: TopoMetricMap, distances: Float[np.ndarray, " nodes"]
) -> frozenset[NodeId]:
    """Return the ids of nodes connected to the nearest node by an edge, and of nodes within 1.5
    D_thresh. `distances` holds D_total to each node (metres, Eq. 1)."""
    nearest = topomap.summaries[int(np.argmin(distances))].node_id
    along = {edge.target_id for edge in topomap.edges if edge.source_id == nearest}
    along |= {edge.source_id for edge in topomap.edges if edge.target_id == nearest}
    rows = np.flatnonzero(distances <= NEIGHBOUR_RADIUS * topomap.config.d_thresh)
    return frozenset(along | {topomap.summaries[int(row)].node_id for row in rows})


def _to_answered_world(
    localizer: Localizer, answer: EvaluatedQuery, tile_id: str
) -> EvaluatedQuery:
    """Transform the ground truth to the world of the tile in the result, if it is another tile of
    an atlas. The nearest node is then not evaluated."""
    answered = answer.result.provenance.tile
    if answered in (None, tile_id) or answer.world_from_cam is None:
        return answer
    truth = localizer.to_world_of(tile_id, answered, answer.world_from_cam)
    return replace(
        answer,
        world_from_cam=answer.world_from_cam if truth is None else truth,
        is_in_other_world=truth is None,
        nearest_node_id=None,
        neighbour_ids=frozenset(),
        angle_deg=math.nan,
        light_ratio=math.nan,
    )


def _find_light_ratio(
    image: Image, topomap: TopoMetricMap, rows: Sequence[Row], lights: dict[Row, LogLight]
) -> float:
    """Return the ratio of light between an image and the likest of some nodes: the largest, 1 or
    more, of those of grey level, red and blue. NaN if no node keeps an image. `lights` keeps those
    of nodes read before."""
    for row in rows:
        if row not in lights and (stored := topomap.nodes[row].read_image()) is not None:
            lights[row] = _measure_light(stored)
    own = _measure_light(image)
    logs = [float(np.nanmax(abs(lights[row] - own))) for row in rows if row in lights]
    return math.exp(min(logs, default=math.nan))


def _measure_light(image: Image) -> LogLight:
    """Return the logarithms of mean grey level, red and blue over green; NaN of a grey image."""
    light = Illumination.of_image(image)
    colours = (light.red, light.blue) if image.ndim == 3 else (math.nan, math.nan)
    return np.log(np.maximum((light.level, *colours), 1 / 255))  # a level of 0 has no ratio


def _read_image(sequence: StereoSequence, index: int) -> Image:
    return sequence[index].image


def _localize(
    localizer: Localizer, frame: StereoFrame, read_image: Callable[[], Image], label: str
) -> EvaluatedQuery:
    """Localize a frame. Return the result without ground truth."""
    if isinstance(frame, RigFrame):
        of_rig = RigLocalizer(localizer, frame.mounted).localize(frame.images)
        named = EvaluatedQuery(frame.name, as_image(of_rig), None, recording=label)
        return replace(named, read_image=read_image, of_rig=of_rig)
    if frame.camera is None:
        raise CalibrationError(
            f"{frame.name}: no calibration; put a camera.json into the recording's folder"
        )
    return EvaluatedQuery(
        frame.name,
        localizer.localize(frame.image, frame.camera, t_ns=frame.t_ns),
        None,
        recording=label,
        read_image=read_image,
        camera=frame.camera,
    )
