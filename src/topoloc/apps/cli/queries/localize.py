"""topoloc localize MAP|ATLAS INPUT ..."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
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
    Rigid3,
    StereoSequence,
    TopolocError,
    Tracker,
    TrackerConfig,
    Trajectory,
    UncalibratedCamera,
    UnreadableImageError,
)
from topoloc.apps.cli.features_option import QUERY_FEATURES, open_localizer, parse_camera
from topoloc.apps.cli.output import (
    File,
    Flag,
    Format,
    Topics,
    UsageError,
    check_outputs,
    interruptible,
    open_recording,
    print_warning,
    progress_bar,
    write_text,
)
from topoloc.apps.cli.queries.live_localization import (
    NEEDS_CALIBRATION,
    find_live_input,
    localize_live,
)
from topoloc.apps.cli.queries.query_answers import (
    QueryAnswer,
    exit_status,
    format_answer,
    report_calibrations,
    summarize_stream,
    to_trajectory,
)
from topoloc.apps.cli.settings_file import Settings, read_settings, with_option
from topoloc.apps.query_camera import CameraOfSize, select_frame_camera
from topoloc.plugin import as_monocular, find_format, find_source_path, match_frame_poses


@dataclass(frozen=True, eq=False)
class _Query:
    """Hold an input: its images, whether they are a stream, the odometry pose of each, and whether
    they have times."""

    path: str
    sequence: StereoSequence
    is_stream: bool
    odom_from_cams: list[Rigid3 | None]
    has_times: bool


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
    max_jump: Annotated[float | None, tyro.conf.arg(metavar="METRES", help_behavior_hint="")] = None
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
        str | None,
        tyro.conf.arg(
            metavar="FILE|fx,fy,cx,cy|map|unknown",
            help_behavior_hint="(default: that of the recording)",
        ),
    ] = None
    """Calibration of the queries: a camera.json, YAML of OpenCV or Kalibr, `fx,fy,cx,cy` in pixels,
    `map` for the map's camera, `unknown` to estimate the focal length."""
    format: Format = None
    """Format of the recordings: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap,
    rosbag, mcap, zed, video or folder."""
    topics: Topics = None
    """Topics of a bag: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    coarse: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the map's)")
    ] = None
    """Coarse localizer to use. `topoloc info` lists those of the map."""
    features: QUERY_FEATURES = None
    """Feature types of the map to use, in order. The next one is used if the pose is unclear."""
    max_ms: Annotated[
        float | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: no limit)")
    ] = None
    """Time limit for an image in milliseconds. The first hypothesis is always tested."""
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
        self._check_usage()
        check_outputs(
            [self.json, self.tum],
            inputs=[
                path
                for path in (self.map, *self.inputs, self.streams.odometry, self.config)
                if path
            ],
        )
        near, settings = self._parse_near, read_settings(self.config)
        tracking = self._create_tracker(settings.of(TrackerConfig))
        localizer = self._localizer(settings, near)
        camera = (
            None
            if self.camera is None or self._stereo_calibration
            else parse_camera(localizer, self.camera)
        )
        live = find_live_input(self.inputs)
        queries = [] if live else [self._open_query(path) for path in self.inputs]
        total = sum(len(query.sequence) for query in queries)
        coming = _localize_queries(localizer, tracking, queries, camera)
        if live:
            if camera is None:
                raise UsageError(f"{live} has no calibration: --camera gives it")
            tracker = None if self.streams.single else Tracker(localizer, tracking)
            coming = localize_live(localizer, tracker, live, camera)
        start = time.perf_counter()
        answers = self._print_answers(coming, total)
        self._write_files(answers)
        if any(answer.streamed for answer in answers) and self.json != "-":
            print(summarize_stream(answers, time.perf_counter() - start))
        report_calibrations(answers)
        return exit_status(answers)

    def _print_answers(self, coming: Iterator[QueryAnswer], total: int) -> list[QueryAnswer]:
        """Print each answer when it comes, and return all. If the queries are interrupted, the
        files hold the answers so far."""
        answers = list[QueryAnswer]()
        try:
            with interruptible(), progress_bar() as progress:
                for answer in coming:
                    answers.append(answer)
                    as_json = self.json == "-"
                    print(
                        json.dumps(answer.to_json()) if as_json else format_answer(answer),
                        flush=True,
                    )
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

    def _localizer(self, settings: Settings, near: GeoPositionPrior | None) -> Localizer:
        config = with_option(settings.of(LocalizerConfig), "coarse", self.coarse, "--coarse")
        config = with_option(config, "max_ms", self.max_ms, "--max-ms")
        localizer = open_localizer(self.map, config, self.features, settings.of(AtlasConfig))
        return localizer if near is None else localizer.near(near)

    @property
    def _parse_near(self) -> GeoPositionPrior | None:
        try:
            return None if self.near is None else GeoPositionPrior.parse(self.near)
        except AtlasError as error:
            raise UsageError(f"--near: {error}") from None

    def _check_usage(self) -> None:
        if self.streams.stream and self.streams.single:
            raise UsageError("--stream and --single exclude each other")
        if self.streams.odometry is not None and (
            len(self.inputs) > 1 or find_live_input(self.inputs)
        ):
            raise UsageError("--odometry needs one recorded stream as the only input")

    def _open_query(self, path: str) -> _Query:
        """Open an input. Recordings and videos are streams. Images and folders of images are single
        unless --stream is given."""
        is_stream = self.streams.stream or (
            not self.streams.single and find_format(path, self.format) != "folder"
        )
        sequence = as_monocular(
            open_recording(path, self.format, self._stereo_calibration, self.topics)
        )
        is_stream = is_stream and len(sequence) > 1
        odometry = None
        if self.streams.odometry is not None:
            if not is_stream:
                raise UsageError(
                    f"--odometry needs a stream, and {path} is none; --stream makes it one"
                )
            odometry = match_frame_poses(
                Trajectory.read(Path(self.streams.odometry)),
                sequence.t_ns,
                Path(self.streams.odometry),
            )
        has_times = is_stream or find_format(path, self.format) != "folder" or _has_times(sequence)
        return _Query(path, sequence, is_stream, odometry or [None] * len(sequence), has_times)

    @property
    def _stereo_calibration(self) -> str | None:
        """Return `--camera` if it calibrates a stereo pair; the recording is opened with it."""
        return self.camera if self.camera is not None and self.camera.endswith(".conf") else None

    def _create_tracker(self, config: TrackerConfig) -> TrackerConfig:
        config = with_option(config, "max_jump", self.streams.max_jump, "--max-jump")
        return config if self.streams.max_jump is None else replace(config, mode="paper")

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
            to_trajectory(answers, self.streams.smoothed).write_tum(Path(self.tum))
            files.append(self.tum)
        return files


def _localize_queries(
    localizer: Localizer,
    tracking: TrackerConfig,
    queries: list[_Query],
    camera_of_size: CameraOfSize | None,
) -> Iterator[QueryAnswer]:
    for query in queries:
        tracker = Tracker(localizer, tracking) if query.is_stream else None
        for i, frame_name in enumerate(query.sequence.names):
            name = (
                frame_name
                if len(queries) == 1
                else query.path
                if len(query.sequence) == 1
                else f"{query.path}/{frame_name}"
            )
            try:
                answer = _localize_frame(name, query, i, localizer, tracker, camera_of_size)
            except (QueryError, CalibrationError) as error:
                if query.is_stream or len(queries) == len(query.sequence) == 1:
                    raise type(error)(f"{name}: {error}") from error
                # One image has another size than its camera; the others are localized.
                answer = QueryAnswer(
                    name,
                    query.sequence.t_ns[i],
                    NotLocalized("unreadable", detail=f"{name}: {error}"),
                )
            yield answer


def _has_times(photos: StereoSequence) -> bool:
    """Return whether the images have times. Photos and folders without times.txt have none."""
    root = find_source_path(photos)
    return root is None or (photos.names != [photos.name] and (Path(root) / "times.txt").is_file())


def _localize_frame(
    name: str,
    query: _Query,
    index: int,
    localizer: Localizer,
    tracker: Tracker | None,
    camera_of_size: CameraOfSize | None,
) -> QueryAnswer:
    """Localize one image, alone or as the next of a stream."""
    t_ns, odom_from_cam = query.sequence.t_ns[index], query.odom_from_cams[index]
    try:
        frame = query.sequence[index]
    except UnreadableImageError as error:
        unreadable = localizer.with_provenance(
            NotLocalized("unreadable", detail=str(error)), t_ns=t_ns if query.has_times else None
        )
        return QueryAnswer(
            name,
            t_ns,
            unreadable,
            tracker.process_missing(t_ns, unreadable, odom_from_cam)
            if tracker is not None
            else None,
        )
    camera = select_frame_camera(frame, camera_of_size)
    if tracker is None:
        return QueryAnswer(
            name,
            t_ns,
            localizer.localize(frame.image, camera, t_ns=t_ns if query.has_times else None),
        )
    if isinstance(camera, UncalibratedCamera):
        raise CalibrationError(NEEDS_CALIBRATION)
    streamed = tracker.process(frame.image, camera, t_ns, odom_from_cam)
    return QueryAnswer(name, t_ns, streamed.result, streamed)
