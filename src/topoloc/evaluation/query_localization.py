"""Localize recordings with ground truth in a map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.atlas.evaluated_tile import EvaluatedTile
from topoloc.errors import CalibrationError, TrajectoryError
from topoloc.evaluation.metrics import EvaluatedQuery
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.nodes import NodePoses, node_distances
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import Image, StereoFrame, StereoSequence

# A node within this many D_thresh counts as a neighbour of the query.
NEIGHBOUR_RADIUS = 1.5


QueriedMap = Localizer | EvaluatedTile
"""A map, or an atlas evaluated in the world of one tile."""


def localize_queries(
    localizer: QueriedMap,
    sequence: StereoSequence,
    map_from_truth: Rigid3 | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    label: str | None = None,
    frames: Sequence[int] | None = None,
) -> list[EvaluatedQuery]:
    """Localize every frame with a known pose. The localizer receives only the left (or colour)
    image.

    Args:
        localizer: the localizer of the map, or an evaluated tile.
        sequence: the recording.
        map_from_truth: the transform from the recording's world to the map's, if they differ.
        progress: is called with the label, frames done and all frames.
        label: the name of the recording in the results. Defaults to its own name.
        frames: localize only these frames, in this order. Their poses must be known.

    Raises:
        TrajectoryError: the recording has no ground truth.
        CalibrationError: the recording has no camera model.
    """
    nodes = NodePoses.of([summary.world_from_cam for summary in localizer.topomap.summaries])
    lambda_rot = localizer.topomap.config.lambda_rot
    frames = find_frames_with_truth(sequence) if frames is None else frames
    label = label or sequence.name
    answers = []
    for done, i in enumerate(frames):
        frame = sequence[i]
        assert frame.world_from_cam is not None
        world_from_cam = (map_from_truth or Rigid3.identity()) @ frame.world_from_cam
        distances = node_distances(world_from_cam, nodes, lambda_rot)
        nearest = localizer.topomap.summaries[int(np.argmin(distances))].node_id
        near = find_neighbour_ids(localizer.topomap, distances)
        result = _localize(localizer, frame)
        answer = EvaluatedQuery(
            frame.name,
            result,
            world_from_cam,
            nearest,
            label,
            create_image_reader(sequence, i),
            frame.camera,
            near,
        )
        answers.append(_to_answered_world(localizer, answer))
        if progress:
            progress(label, done + 1, len(frames))
    return answers


def localize_out_of_map(
    localizer: QueriedMap,
    sequence: StereoSequence,
    progress: Callable[[str, int, int], None] | None = None,
    label: str | None = None,
    frames: Sequence[int] | None = None,
) -> list[EvaluatedQuery]:
    """Localize out-of-map images. Every pose of the results is false.

    Args:
        localizer: the localizer of the map, or an evaluated tile.
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
        frame = sequence[i]
        result = _localize(localizer, frame)
        answers.append(
            EvaluatedQuery(
                sequence.names[i],
                result,
                None,
                None,
                label,
                create_image_reader(sequence, i),
                frame.camera,
            )
        )
        if progress:
            progress(f"{label} (elsewhere)", done + 1, len(frames))
    return answers


def find_frames_with_truth(sequence: StereoSequence) -> list[int]:
    """Return the frames with a known pose. Raises TrajectoryError if there are none."""
    frames = [i for i, pose in enumerate(sequence.poses) if pose is not None]
    if not frames:
        raise TrajectoryError(f"{sequence.name}: no frame has a known pose to judge against")
    return frames


def create_image_reader(sequence: StereoSequence, index: int) -> Callable[[], Image]:
    """Return a function that reads the image of a frame again."""
    return lambda: sequence[index].image


def find_neighbour_ids(
    topomap: TopoMetricMap, distances: Float[np.ndarray, " nodes"]
) -> frozenset[int]:
    """Return the ids of nodes connected to the nearest node by an edge, and of nodes within 1.5
    D_thresh. `distances` holds D_total to each node (metres, Eq. 1)."""
    nearest = topomap.summaries[int(np.argmin(distances))].node_id
    along = {edge.target_id for edge in topomap.edges if edge.source_id == nearest}
    along |= {edge.source_id for edge in topomap.edges if edge.target_id == nearest}
    rows = np.flatnonzero(distances <= NEIGHBOUR_RADIUS * topomap.config.d_thresh)
    return frozenset(along | {topomap.summaries[int(row)].node_id for row in rows})


def _to_answered_world(localizer: QueriedMap, answer: EvaluatedQuery) -> EvaluatedQuery:
    """Transform the ground truth to the world of the tile in the result, if it is another tile of
    an atlas. The nearest node is then not evaluated."""
    if (
        isinstance(localizer, Localizer)
        or answer.world_from_cam is None
        or answer.result.provenance.tile in (None, localizer.tile_id)
    ):
        return answer
    truth = localizer.truth_in_result_world(answer.result, answer.world_from_cam)
    if truth is None:
        return replace(
            answer, is_in_other_world=True, nearest_node_id=None, neighbour_ids=frozenset()
        )
    return replace(answer, world_from_cam=truth, nearest_node_id=None, neighbour_ids=frozenset())


def _localize(localizer: QueriedMap, frame: StereoFrame) -> Localization | NotLocalized:
    if frame.camera is None:
        raise CalibrationError(
            f"{frame.name}: no calibration; put a camera.json into the recording's folder"
        )
    return localizer.localize(frame.image, frame.camera, t_ns=frame.t_ns)
