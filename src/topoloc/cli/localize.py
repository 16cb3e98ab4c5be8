"""topoloc localize MAP INPUT ..."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.cli.output import UsageError, check_outputs, interruptible, progress_bar, write_text
from topoloc.errors import CalibrationError, QueryError, TopolocError, UnreadableImageError
from topoloc.geometry.camera import Camera
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.sequences.camera_json import read_camera_json
from topoloc.sequences.frame import StereoFrame, StereoSequence
from topoloc.sequences.open import open_sequence
from topoloc.sequences.trajectory import Trajectory, write_tum

# The camera of a picture of this width and height (pixels).
CameraOfSize = Callable[[int, int], Camera]


@dataclass(frozen=True, eq=False)
class _Answer:
    """A query with the time of its frame."""

    query: str
    t_ns: int
    result: Localization | NotLocalized


@dataclass(frozen=True)
class Command:
    """What `topoloc localize` takes."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP")]
    """The map file."""
    inputs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="INPUT ...", help_behavior_hint="(required)")] = ()
    """Images, folders of images, recordings. PATH@0:100 takes the first hundred frames of PATH."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="FILE|fx,fy,cx,cy|map", help_behavior_hint="(default: that of the recording)")] = (
        None
    )
    """The queries' calibration: a camera.json, `fx,fy,cx,cy` in pixels, or `map` for the camera that the map was made with."""
    format: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: recognised)")] = None
    """The recordings' format: kitti, euroc, tum, seven_scenes or folder."""
    coarse: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the map's)")] = None
    """Which of the map's coarse localizers is asked; `topoloc info` names them."""
    json: Annotated[str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Write one JSON line a query to this file (- for standard output)."""
    tum: Annotated[str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the poses found to this file, TUM format, world_from_cam. Single photos have no times: t is then the query's number."""
    config: LocalizerConfig = field(default_factory=LocalizerConfig)

    def run(self) -> int:
        if not self.inputs:
            raise UsageError("localize takes a map and at least one image, folder or recording")
        check_outputs([self.json, self.tum], inputs=[self.map, *self.inputs])
        topomap = TopoMetricMap.load(self.map)
        camera = None if self.camera is None else _camera_of_size(self.camera, topomap)
        sequences = [open_sequence(path, self.format) for path in self.inputs]
        localizer = Localizer(topomap, replace(self.config, coarse=self.coarse or self.config.coarse))
        answers: list[_Answer] = []
        total = sum(map(len, sequences))
        try:
            with interruptible(), progress_bar() as progress:
                for answer in self._answers(localizer, sequences, camera):
                    answers.append(answer)
                    as_json = self.json == "-"
                    print(json.dumps(answer.result.to_json(answer.query)) if as_json else _line(answer), flush=True)
                    progress("queries", len(answers), total)
        except (KeyboardInterrupt, TopolocError) as stopped:
            files = self._write_files(answers) if answers else []
            if not files:
                raise
            what = "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)
            raise TopolocError(f"{what} (results of the {len(answers)} queries before: {', '.join(files)})") from stopped
        self._write_files(answers)
        return _status(answers)

    def _answers(self, localizer: Localizer, sequences: list[StereoSequence], camera_of_size: CameraOfSize | None) -> Iterator[_Answer]:
        for path, sequence in zip(self.inputs, sequences, strict=True):
            for i, name in enumerate(sequence.names):
                query = name if len(self.inputs) == 1 else path if len(sequence) == 1 else f"{path}/{name}"
                try:
                    frame = sequence[i]
                except UnreadableImageError as error:
                    yield _Answer(query, sequence.t_ns[i], NotLocalized("unreadable", detail=str(error)))
                    continue
                try:
                    result = localizer.localize(frame.image, _camera_of_frame(frame, camera_of_size))
                except (QueryError, CalibrationError) as error:
                    raise type(error)(f"{query}: {error}") from error
                yield _Answer(query, frame.t_ns, result)

    def _write_files(self, answers: list[_Answer]) -> list[str]:
        """The paths written."""
        files = []
        if self.json is not None and self.json != "-":
            write_text(Path(self.json), "".join(json.dumps(a.result.to_json(a.query)) + "\n" for a in answers))
            files.append(self.json)
        if self.tum is not None:
            write_tum(Path(self.tum), _trajectory(answers))
            files.append(self.tum)
        return files


def _camera_of_frame(frame: StereoFrame, camera_of_size: CameraOfSize | None) -> Camera:
    if camera_of_size is not None:
        height, width = frame.image.shape[:2]
        return camera_of_size(width, height)
    if frame.camera is None:
        raise CalibrationError("no calibration; give --camera FILE, --camera fx,fy,cx,cy or --camera map (the map's own camera)")
    return frame.camera


def _camera_of_size(text: str, topomap: TopoMetricMap) -> CameraOfSize:
    """What `--camera` says. Raises CalibrationError."""
    if text == "map":
        return _rescaled(topomap.nodes[0].camera)
    if "," in text and not Path(text).exists():
        try:
            fx, fy, cx, cy = map(float, text.split(","))
        except ValueError:
            raise CalibrationError(f"--camera {text}: neither a file nor four numbers fx,fy,cx,cy") from None
        Camera.pinhole(1, 1, fx, fy, cx, cy)  # complains before the first picture is read
        return lambda width, height: Camera.pinhole(width, height, fx, fy, cx, cy)
    camera = read_camera_json(Path(text)).camera
    return lambda width, height: camera


def _rescaled(camera: Camera) -> CameraOfSize:
    def of_size(width: int, height: int) -> Camera:
        if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):  # more than a pixel's rounding
            raise QueryError(f"the image is {width}x{height}, the map's camera {camera.width}x{camera.height}: not of one shape")
        return camera.rescaled(width, height)

    return of_size


def _trajectory(answers: list[_Answer]) -> Trajectory:
    """The poses found, in the order of the queries; their numbers are their seconds where the times do not increase."""
    times = [answer.t_ns for answer in answers]
    if any(after <= before for before, after in pairwise(times)):
        times = [number * 1_000_000_000 for number in range(len(answers))]
    found = [(t_ns, a.result.world_from_cam) for t_ns, a in zip(times, answers, strict=True) if isinstance(a.result, Localization)]
    return Trajectory([world_from_cam for _, world_from_cam in found], [t_ns for t_ns, _ in found])


def _status(answers: list[_Answer]) -> int:
    """The exit status; one line on stderr where pictures could not be read."""
    details = [a.result.detail for a in answers if isinstance(a.result, NotLocalized) and a.result.reason == "unreadable"]
    if not details:
        return 0
    if len(details) == len(answers):
        more = f" (and the other {len(details) - 1} could not be read either)" if len(details) > 1 else ""
        print(f"error: {details[0]}{more}", file=sys.stderr)
        return 1
    print(f"warning: {len(details)} of {len(answers)} images could not be read; the first: {details[0]}", file=sys.stderr)
    return 0


def _line(answer: _Answer) -> str:
    """One query for people."""
    result = answer.result
    ms = f"  {result.times_ms['total']:.0f} ms" if result.times_ms else ""
    if isinstance(result, NotLocalized):
        evidence = "" if result.reason == "unreadable" else f"  ({result.num_inliers} of {result.num_matches} matches)"
        return f"{answer.query}  not localized: {result.reason}{evidence}{ms}"
    x, y, z = result.world_from_cam.translation
    w, i, j, k = result.world_from_cam.quat_wxyz()
    return (
        f"{answer.query}  at {x:.3f} {y:.3f} {z:.3f} m, quat wxyz {w:.4f} {i:.4f} {j:.4f} {k:.4f}  p {result.probability:.2f}"
        f"  node {result.node_id}  ({result.num_inliers} of {result.num_matches} matches){ms}"
    )
