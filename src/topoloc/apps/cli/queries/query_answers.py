"""Localize the images of queries, alone or as a stream: answers, printed lines, the trajectory."""

from __future__ import annotations

import json
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from textwrap import shorten
from typing import Any

from topoloc import (
    Localization,
    NotLocalized,
    Rigid3,
    SharedCameras,
    StereoFrame,
    StreamedPose,
    TopolocError,
    Tracker,
    Trajectory,
    UncalibratedCamera,
    UnreadableImageError,
    check_camera_calibrations,
)
from topoloc.apps.cli.output import print_line, print_warning, write_text
from topoloc.apps.core_names import format_length
from topoloc.apps.formats.live import LiveSource
from topoloc.apps.query_camera import CameraOfSize, select_frame_camera


@dataclass(frozen=True, eq=False)
class QueryFrame:
    """An image to localize. `read` returns it or raises UnreadableImageError. Photos have no time.
    `odom_from_cam` is the pose of external odometry."""

    name: str
    t_ns: int
    read: Callable[[], StereoFrame]
    has_time: bool = True
    odom_from_cam: Rigid3 | None = None

    def localize(
        self, cameras: SharedCameras, tracker: Tracker | None, camera_of_size: CameraOfSize | None
    ) -> QueryAnswer:
        """Localize the image, with a tracker as the next of a stream. Raises QueryError: the size
        of the image is not that of its camera."""
        t_ns = self.t_ns if self.has_time else None
        try:
            frame = self.read()
        except UnreadableImageError as error:
            refusal = NotLocalized("unreadable", detail=str(error))
            refusal, streamed = cameras.localizer.with_provenance(refusal, t_ns=t_ns), None
            if tracker is not None:
                streamed = tracker.process_missing(self.t_ns, refusal, self.odom_from_cam)
            return QueryAnswer(self.name, t_ns, refusal, streamed)
        camera = select_frame_camera(frame, camera_of_size)
        if tracker is not None:
            streamed = tracker.process(frame.image, camera, self.t_ns, self.odom_from_cam)
            return QueryAnswer(self.name, self.t_ns, streamed.result, streamed)
        if isinstance(camera, UncalibratedCamera):
            result = cameras.localize(frame.image, camera, t_ns)
        else:
            result = cameras.localizer.localize(frame.image, camera, t_ns=t_ns)
        return QueryAnswer(self.name, t_ns, result)


def learn_cameras(
    cameras: SharedCameras, frames: Sequence[QueryFrame], camera_of_size: CameraOfSize | None
) -> None:
    """Estimate the camera of frames without calibration from images spread over them."""
    golden_ratio = 0.618034  # any first few are spread, too
    for row in dict.fromkeys(int(k * golden_ratio % 1.0 * len(frames)) for k in range(20)):
        try:
            frame = frames[row].read()
        except UnreadableImageError:
            continue
        camera = select_frame_camera(frame, camera_of_size)
        if not isinstance(camera, UncalibratedCamera):
            return
        cameras.localize(frame.image, camera)


def capture_frames(live: LiveSource, stop: threading.Event) -> Iterator[QueryFrame]:
    """Yield the newest image of a live source each time, with this machine's time, until `stop`."""
    live.stop = stop
    for picture in live:
        frame = StereoFrame(f"{picture.number:06d}", picture.t_ns, picture.image, None)
        yield QueryFrame(frame.name, frame.t_ns, lambda frame=frame: frame)


@dataclass(frozen=True, eq=False)
class QueryAnswer:
    """Hold a query with the time of its frame, None of a photo, and `streamed` if it is part of a
    stream."""

    query: str
    t_ns: int | None
    result: Localization | NotLocalized
    streamed: StreamedPose | None = None

    def to_json(self) -> dict[str, Any]:
        return (self.streamed or self.result).to_json(self.query)

    def pose(self, smoothed: bool) -> Rigid3 | None:
        """Return world_from_cam as measured in this image, None if the pose is only predicted."""
        if not isinstance(self.result, Localization):
            return None
        if smoothed and self.streamed is not None:
            return self.streamed.smoothed
        return self.result.world_from_cam


def to_trajectory(answers: list[QueryAnswer], smoothed: bool) -> Trajectory:
    """Return the poses in the order of the queries. If there are photos, or the times do not
    increase, the numbers of the queries are the seconds."""
    times = [answer.t_ns for answer in answers if answer.t_ns is not None]
    if len(times) < len(answers) or any(after <= before for before, after in pairwise(times)):
        times = [number * 1_000_000_000 for number in range(len(answers))]
    return Trajectory.of_frames([answer.pose(smoothed) for answer in answers], times)


def exit_status(answers: list[QueryAnswer]) -> int:
    """Return the exit status. Unreadable images cost one line on standard error."""
    details = [
        a.result.detail
        for a in answers
        if isinstance(a.result, NotLocalized) and a.result.reason == "unreadable"
    ]
    if details and len(details) == len(answers):
        others = f" (and the other {len(details) - 1} could not be read either)"
        print_line(f"error: {details[0]}{others if len(details) > 1 else ''}", sys.stderr)
        return 1
    if details:
        count = f"{len(details)} of {len(answers)}"
        print_warning(f"{count} images could not be read; the first: {details[0]}")
    return 0


def report_calibrations(answers: list[QueryAnswer]) -> None:
    """Print a warning for each camera whose calibration the images contradict together."""
    for verdict in check_camera_calibrations(answer.result for answer in answers):
        if verdict.is_contradicted:
            print_warning(str(verdict))
    found = [(a.query, a.result) for a in answers if isinstance(a.result, Localization)]
    doubts = [(name, one.calibration_doubt) for name, one in found]
    scaled = [(name, doubt) for name, doubt in doubts if doubt and "height" in doubt.of]
    if scaled:
        name, doubt = scaled[0]
        print_warning(
            f"{len(scaled)} of {len(answers)} images were not scaled as their calibration; {name}:"
            f" {doubt}; give the camera of these images"
        )


def report_cameras(cameras: SharedCameras, path: str | None, stream: Any) -> None:
    """Print the cameras that were estimated, and write the only one to a file. Raises TopolocError:
    it is not one."""
    known = cameras.known
    for camera, shared in known.items():
        print_line(f"camera of the images of {camera.width}x{camera.height}: {shared}", stream)
    if path is None:
        return
    if len(known) != 1:
        fault = f"the images are of {len(known)} cameras, localize them one by one"
        if not known:
            fault = (
                "no camera was estimated; that takes images without calibration, at least five"
                " localized at four places"
            )
        raise TopolocError(f"{path}: not written: {fault}")
    (shared,) = known.values()
    write_text(Path(path), json.dumps(shared.camera.to_json()) + "\n")


def format_answer(answer: QueryAnswer) -> str:
    """Return one readable line."""
    result, stream_state = answer.result, answer.streamed.state if answer.streamed else None
    state = f"{stream_state}  " if stream_state else ""
    ms = f"  {result.times_ms['total']:.0f} ms" if result.times_ms else ""
    if isinstance(result, NotLocalized):
        evidence = f"  ({result.num_inliers} of {result.num_matches} matches)"
        if result.reason == "unreadable" or stream_state == "ambiguous":
            evidence = f"  ({len(result.alternatives)} alternatives)" if result.alternatives else ""
        reason = shorten(": ".join(filter(None, (result.reason, result.detail))), 160)
        return f"{answer.query}  {state}not localized: {reason}{evidence}{ms}"
    focal = "" if result.focal_length_px is None else f"  f {result.focal_length_px:.0f} px (found)"
    tile = "" if result.provenance.tile is None else f"  tile {result.provenance.tile}"
    x, y, z = result.world_from_cam.translation
    w, i, j, k = result.world_from_cam.quat_wxyz()
    has_scale = result.provenance.has_scale
    at = f"at {x:.3f} {y:.3f} {z:.3f} {'m' if has_scale else 'units'}"
    length = format_length(result.position_sigma_m) if has_scale else result.position_sigma_text
    sigmas = f"{length} {result.rotation_sigma_deg:.2f} deg"
    return (
        f"{answer.query}  {state}{at}, quat wxyz {w:.4f} {i:.4f} {j:.4f}"
        f" {k:.4f}  p {result.probability:.2f}  sigma {sigmas}{tile}  node {result.node_id} "
        f" ({result.num_inliers} of {result.num_matches} matches){focal}{ms}"
    )


def summarize_stream(answers: list[QueryAnswer], seconds: float) -> str:
    """Return the count of each state, and the frames per second."""
    states = Counter(answer.streamed.state for answer in answers if answer.streamed is not None)
    names = ("localized", "tracked", "predicted", "ambiguous", "lost")
    counts = ", ".join(f"{states[state]} {state}" for state in names)
    return f"{states.total()} frames: {counts}; {len(answers) / seconds:.1f} frames a second"
