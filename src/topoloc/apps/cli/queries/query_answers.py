"""Results of queries: printed lines, the trajectory and the exit status."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from topoloc import (
    Localization,
    NotLocalized,
    Rigid3,
    StreamedPose,
    Trajectory,
    check_camera_calibrations,
)


@dataclass(frozen=True, eq=False)
class QueryAnswer:
    """Hold a query with the time of its frame, and `streamed` if it is part of a stream."""

    query: str
    t_ns: int
    result: Localization | NotLocalized
    streamed: StreamedPose | None = None

    def to_json(self) -> dict[str, Any]:
        return (self.streamed or self.result).to_json(self.query)

    def pose(self, smoothed: bool) -> Rigid3 | None:
        """Return world_from_cam as measured in this image, None if the pose is only predicted."""
        if not isinstance(self.result, Localization):
            return None
        return (
            self.streamed.smoothed
            if smoothed and self.streamed is not None
            else self.result.world_from_cam
        )


def to_trajectory(answers: list[QueryAnswer], smoothed: bool) -> Trajectory:
    """Return the poses in the order of the queries. If the times do not increase, the numbers of
    the queries are the seconds."""
    times = [answer.t_ns for answer in answers]
    if any(after <= before for before, after in pairwise(times)):
        times = [number * 1_000_000_000 for number in range(len(answers))]
    poses = [(t_ns, answer.pose(smoothed)) for t_ns, answer in zip(times, answers, strict=True)]
    found = [(t_ns, pose) for t_ns, pose in poses if pose is not None]
    return Trajectory([world_from_cam for _, world_from_cam in found], [t_ns for t_ns, _ in found])


def exit_status(answers: list[QueryAnswer]) -> int:
    """Return the exit status. Unreadable images cost one line on standard error."""
    details = [
        a.result.detail
        for a in answers
        if isinstance(a.result, NotLocalized) and a.result.reason == "unreadable"
    ]
    if not details:
        return 0
    if len(details) == len(answers):
        more = (
            f" (and the other {len(details) - 1} could not be read either)"
            if len(details) > 1
            else ""
        )
        print(f"error: {details[0]}{more}", file=sys.stderr)
        return 1
    print(
        f"warning: {len(details)} of {len(answers)} images could not be read; the first:"
        f" {details[0]}",
        file=sys.stderr,
    )
    return 0


def report_calibrations(answers: list[QueryAnswer]) -> None:
    """Print a warning for each camera whose calibration the images contradict together."""
    for verdict in check_camera_calibrations(answer.result for answer in answers):
        if verdict.is_contradicted:
            print(f"warning: {verdict}", file=sys.stderr)


def format_answer(answer: QueryAnswer) -> str:
    """Return one readable line."""
    result, state = (
        answer.result,
        f"{answer.streamed.state}  " if answer.streamed is not None else "",
    )
    ms = f"  {result.times_ms['total']:.0f} ms" if result.times_ms else ""
    if isinstance(result, NotLocalized):
        evidence = f"  ({result.num_inliers} of {result.num_matches} matches)"
        if result.reason == "unreadable" or (
            answer.streamed is not None and answer.streamed.state == "ambiguous"
        ):
            evidence = f"  ({len(result.alternatives)} alternatives)" if result.alternatives else ""
        return f"{answer.query}  {state}not localized: {result.reason}{evidence}{ms}"
    focal = "" if result.focal_length_px is None else f"  f {result.focal_length_px:.0f} px (found)"
    tile = "" if result.provenance.tile is None else f"  tile {result.provenance.tile}"
    x, y, z = result.world_from_cam.translation
    w, i, j, k = result.world_from_cam.quat_wxyz()
    return (
        f"{answer.query}  {state}at {x:.3f} {y:.3f} {z:.3f} m, quat wxyz {w:.4f} {i:.4f} {j:.4f}"
        f" {k:.4f}  p {result.probability:.2f}{tile}  node {result.node_id}  ({result.num_inliers}"
        f" of {result.num_matches} matches){focal}{ms}"
    )


def summarize_stream(answers: list[QueryAnswer], seconds: float) -> str:
    """Return the count of each state, and the frames per second."""
    states = Counter(answer.streamed.state for answer in answers if answer.streamed is not None)
    counts = ", ".join(
        f"{states[state]} {state}"
        for state in ("localized", "tracked", "predicted", "ambiguous", "lost")
    )
    return f"{states.total()} frames: {counts}; {len(answers) / seconds:.1f} frames a second"
