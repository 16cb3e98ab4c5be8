"""topoloc localize MAP|ATLAS INPUT ..."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import (
    AtlasConfig,
    AtlasError,
    CalibrationError,
    GeoPositionPrior,
    Localizer,
    LocalizerConfig,
    NotLocalized,
    QueryError,
    SharedCameras,
    StereoSequence,
    TopolocError,
    Tracker,
    TrackerConfig,
    Trajectory,
)
from topoloc.apps.cli.features_option import (
    QUERY_FEATURES,
    CoarseOption,
    open_localizer,
    parse_camera,
)
from topoloc.apps.cli.output import (
    File,
    Flag,
    Format,
    MaskOption,
    Topics,
    UsageError,
    catch_stop_signals,
    check_outputs,
    interruptible,
    open_recording,
    option,
    print_line,
    print_warning,
    progress_bar,
    write_text,
)
from topoloc.apps.cli.queries.query_answers import (
    QueryAnswer,
    QueryFrame,
    capture_frames,
    exit_status,
    format_answer,
    learn_cameras,
    report_calibrations,
    report_cameras,
    summarize_stream,
    to_trajectory,
)
from topoloc.apps.cli.queries.rig_queries import localize_rigs, write_rig_answers
from topoloc.apps.cli.settings_file import Settings, read_settings, with_option
from topoloc.apps.core_names import as_monocular, find_format, split_selection
from topoloc.apps.formats.live import LiveSource, is_live
from topoloc.apps.formats.rig import is_rig
from topoloc.apps.query_camera import CameraOfSize


@dataclass(frozen=True)
class StreamOptions:
    """Streams: each image helps to localize the next. Videos and recordings are streams."""

    stream: Flag = False
    """Treat folders of images as streams, too."""
    single: Flag = False
    """Localize each image alone, also of videos and recordings."""
    smoothed: Flag = False
    """Write smoothed poses to --tum instead of raw ones."""
    odometry: File = None
    """Poses of the stream from external odometry (TUM format, any world). They predict the next
    pose."""
    max_jump: Annotated[float | None, option("METRES")] = None
    """Use the paper's rule instead of the motion model: a pose farther than this from the previous
    one is replaced by it."""


@dataclass(frozen=True)
class Command:
    """Hold the arguments of `topoloc localize`."""

    map: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MAP|ATLAS")]
    """A map file, or an atlas."""
    inputs: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="INPUT ...", help_behavior_hint="(required)"),
    ] = ()
    """Images, folders of images, videos, recordings. PATH@0:100 selects the first hundred frames of
    PATH. Or one live camera: a device number, rtsp:// or http:// URL, or GStreamer pipeline."""
    camera: Annotated[
        str | None, option("FILE|fx,fy,cx,cy|map|unknown", "that of the recording")
    ] = None
    """Calibration of the queries: a camera.json, YAML of OpenCV or Kalibr, `fx,fy,cx,cy` in pixels,
    `map` for the map's camera, `unknown` to estimate it from all images of one size."""
    mask: MaskOption = None
    rig: Annotated[str | None, option("FILE|equirectangular", "one camera")] = None
    """A rig.json, if the inputs, folders with one recording for each camera, hold none.
    `equirectangular`: inputs are panoramas of 360 x 180 degrees."""
    save_camera: File = None
    """Write the camera that is estimated from images without calibration to this file
    (camera.json)."""
    format: Format = None
    topics: Topics = None
    coarse: CoarseOption = None
    features: QUERY_FEATURES = None
    max_ms: Annotated[float | None, option("N", "no limit")] = None
    """Time limit for an image in milliseconds. The first hypothesis is always tested."""
    tolerance: Annotated[str | None, option("METRES,DEGREES", "that of the weights, 0.25,2")] = None
    """Maximum error of a pose. Poses with larger standard deviations are refused as `imprecise`,
    wider tolerances forgive more. The result holds the pose."""
    near: Annotated[
        str | None, tyro.conf.arg(metavar="LAT,LON,METRES", help_behavior_hint="(atlases only)")
    ] = None
    """Skip tiles of an atlas that are known to lie farther from this position."""
    json: File = None
    """Write one JSON line for each query to this file (- for standard output)."""
    tum: File = None
    """Write the poses to this file (TUM format, world_from_cam). Single photos have no times; t is
    then the number of the query."""
    streams: Annotated[tyro.conf.OmitArgPrefixes[StreamOptions], tyro.conf.arg(name="stream")] = (
        field(default_factory=StreamOptions)
    )
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config localize`."""

    def run(self) -> int:
        if not self.inputs:
            raise UsageError("localize takes a map and at least one image, folder or recording")
        live = next((path for path in self.inputs if is_live(path)), None)
        self._check_usage(live)
        inputs = (self.map, *self.inputs, self.streams.odometry, self.config, self.mask)
        check_outputs([self.json, self.tum, self.save_camera], inputs)
        near, settings = self._parse_near(), read_settings(self.config)
        tracking = settings.get(TrackerConfig)
        if self.streams.max_jump is not None:
            tracking = with_option(tracking, "max_jump", self.streams.max_jump, "--max-jump")
            tracking = replace(tracking, mode="paper")
        localizer, camera = self._open_localizer(settings, near), None
        if self._is_rig:
            rigs = localize_rigs(localizer, self.inputs, self.rig, self.json)
            write_rig_answers(rigs, self.json, self.tum)
            return 0
        if self.camera is not None and not self._stereo_calibration:
            camera = parse_camera(localizer, self.camera)
        if live and len(self.inputs) > 1:
            raise UsageError(f"{live} is a live source, which must be the only input")
        queries = [] if live else [self._open_query(path) for path in self.inputs]
        total = sum(len(query.frames) for query in queries)
        cameras = SharedCameras(localizer)
        coming = _localize_queries(cameras, tracking, queries, camera)
        if live:
            tracker = None if self.streams.single else Tracker(localizer, tracking, cameras)
            coming = _localize_live(cameras, tracker, live, camera)
        start, answers = time.perf_counter(), self._print_answers(coming, total)
        self._write_files(answers)
        if any(answer.streamed for answer in answers) and self.json != "-":
            print(summarize_stream(answers, time.perf_counter() - start))
        report_calibrations(answers)
        report_cameras(cameras, self.save_camera, sys.stderr if self.json == "-" else sys.stdout)
        return exit_status(answers)

    def _print_answers(self, coming: Iterator[QueryAnswer], total: int) -> list[QueryAnswer]:
        """Print each answer when it comes, and return all. If the queries are interrupted, the
        files hold the answers so far."""
        answers, as_json = list[QueryAnswer](), self.json == "-"
        try:
            with interruptible(), progress_bar() as progress:
                for answer in coming:
                    answers.append(answer)
                    line = json.dumps(answer.to_json()) if as_json else format_answer(answer)
                    print_line(line)
                    progress("queries", len(answers), total or len(answers))
        except (KeyboardInterrupt, TopolocError) as stopped:
            files = self._write_files(answers) if answers else []
            if not files:
                raise
            what = "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)
            raise TopolocError(
                f"{what} (results of the {len(answers)} queries before: {', '.join(files)})"
            ) from stopped
        return answers

    def _open_localizer(self, settings: Settings, near: GeoPositionPrior | None) -> Localizer:
        config = with_option(settings.get(LocalizerConfig), "coarse", self.coarse, "--coarse")
        config = with_option(config, "max_ms", self.max_ms, "--max-ms")
        config = with_option(config, "mask", self.mask, "--mask")
        config = with_option(config, "evidence.tolerance", self._parse_tolerance(), "--tolerance")
        localizer = open_localizer(self.map, config, self.features, settings.get(AtlasConfig))
        return localizer if near is None else localizer.near(near)

    def _parse_tolerance(self) -> tuple[float, ...] | None:
        try:
            words = () if self.tolerance is None else self.tolerance.split(",")
            return tuple(map(float, words)) or None
        except ValueError:
            raise UsageError("--tolerance takes metres and degrees, such as 0.5,5") from None

    def _parse_near(self) -> GeoPositionPrior | None:
        with UsageError.at("--near", AtlasError):
            return None if self.near is None else GeoPositionPrior.parse(self.near)

    def _check_usage(self, live: str | None) -> None:
        if self.streams.stream and self.streams.single:
            raise UsageError("--stream and --single exclude each other")
        if self._is_rig and (live or self.camera or self.streams != StreamOptions()):
            raise UsageError("--rig takes no --camera, live camera or options of streams")
        if self.streams.odometry is not None and (len(self.inputs) > 1 or live):
            raise UsageError("--odometry needs one recorded stream as the only input")

    def _open_query(self, path: str) -> _Query:
        """Open an input. Recordings and videos are streams. Images and folders of images are single
        unless --stream is given."""
        is_folder = find_format(path, self.format) == "folder"
        recording = open_recording(path, self.format, self._stereo_calibration, self.topics)
        sequence = as_monocular(recording)
        is_stream = self.streams.stream or not (self.streams.single or is_folder)
        is_stream, poses = is_stream and len(sequence) > 1, [None] * len(sequence)
        if self.streams.odometry is not None:
            if not is_stream:
                raise UsageError(
                    f"--odometry needs a stream, and {path} is none; --stream makes it one"
                )
            odometry = Path(self.streams.odometry)
            poses = Trajectory.read(odometry).match_frames(sequence.t_ns, odometry)
        has_times = is_stream or not is_folder or _has_times(path, sequence)
        frames = [
            QueryFrame(name, t_ns, lambda row=row: sequence[row], has_times, pose)
            for row, (name, t_ns, pose) in enumerate(
                zip(sequence.names, sequence.t_ns, poses, strict=True)
            )
        ]
        return _Query(path, frames, is_stream)

    @property
    def _is_rig(self) -> bool:
        """Return whether the inputs are images of rigs."""
        return self.rig is not None or any(map(is_rig, self.inputs))

    @property
    def _stereo_calibration(self) -> str | None:
        """Return `--camera` if it calibrates a stereo pair; the recording is opened with it."""
        return self.camera if self.camera is not None and self.camera.endswith(".conf") else None

    def _write_files(self, answers: list[QueryAnswer]) -> list[str]:
        """Write the files and return their paths."""
        files = []
        if self.json is not None and self.json != "-":
            write_text(Path(self.json), "".join(json.dumps(a.to_json()) + "\n" for a in answers))
            files.append(self.json)
        if self.tum is not None:
            tiles = {answer.result.provenance.tile for answer in answers if answer.result.localized}
            if len(tiles) > 1:
                print_warning(f"{self.tum}: poses of {len(tiles)} tiles, each in its tile's world")
            poses = to_trajectory(answers, self.streams.smoothed)
            poses.write_tum(Path(self.tum), are_answers=True)
            files.append(self.tum)
        return files


@dataclass(frozen=True, eq=False)
class _Query:
    """The images of an input, and whether they are a stream."""

    path: str
    frames: Sequence[QueryFrame]
    is_stream: bool


def _localize_queries(
    cameras: SharedCameras,
    tracking: TrackerConfig,
    queries: list[_Query],
    camera_of_size: CameraOfSize | None,
) -> Iterator[QueryAnswer]:
    learn_cameras(cameras, [one for query in queries for one in query.frames], camera_of_size)
    for query in queries:
        tracker = Tracker(cameras.localizer, tracking, cameras) if query.is_stream else None
        for frame in query.frames:
            if len(queries) > 1:
                name = query.path if len(query.frames) == 1 else f"{query.path}/{frame.name}"
                frame = replace(frame, name=name)
            try:
                yield frame.localize(cameras, tracker, camera_of_size)
            except (QueryError, CalibrationError) as error:
                text = f"{frame.name}: {error}"
                if query.is_stream or len(queries) == len(query.frames) == 1:
                    raise type(error)(text) from error
                # One image has another size than its camera; the others are localized.
                refusal = NotLocalized("unreadable", detail=text)
                yield QueryAnswer(frame.name, frame.t_ns if frame.has_time else None, refusal)


def _localize_live(
    cameras: SharedCameras,
    tracker: Tracker | None,
    source: str,
    camera_of_size: CameraOfSize | None,
) -> Iterator[QueryAnswer]:
    """Yield results until the source ends or the process is interrupted. Images that arrive during
    a query are skipped. Raises RecordingError if the source does not respond or stalls."""
    with ExitStack() as stack:
        live = stack.enter_context(LiveSource(source))
        stop, count = stack.enter_context(catch_stop_signals()), 0
        for frame in capture_frames(live, stop):
            yield frame.localize(cameras, tracker, camera_of_size)
            count += 1
        if not stop.is_set():
            print_warning(f"{source} ended after {live.num_read} images, {count} were localized")


def _has_times(path: str, photos: StereoSequence) -> bool:
    """Return whether the images have times. Photos and folders without times.txt have none."""
    return photos.names != [photos.name] and (split_selection(path)[0] / "times.txt").is_file()
