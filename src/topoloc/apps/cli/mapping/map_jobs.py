"""Build a map from recordings: the source of their poses, their conventions and all settings.

`topoloc build` builds one map here, or sends one `MapJob` for each recording, or piece of a
recording, to other machines.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from topoloc import (
    BuildConfig,
    PoseConventions,
    RecordingError,
    StereoSequence,
    TopolocError,
    TopoMetricMap,
    align_to_trajectory,
    build_map,
    open_sequence,
    run_slam,
    with_pose_conventions,
    with_trajectory,
)
from topoloc.apps.cli.output import UsageError, describe_recording, open_recording, print_line
from topoloc.apps.cluster.remote import Progress
from topoloc.apps.core_names import (
    find_format,
    has_scale,
    keep_frames,
    scale_poses,
    split_selection,
)
from topoloc.apps.formats.colmap import estimate_metric_scale
from topoloc.apps.reconstruction.kept_back import check_kept_back
from topoloc.apps.reconstruction.key_frames import select_key_frames
from topoloc.apps.reconstruction.photos import reconstruct
from topoloc.apps.reconstruction.scale import NO_SCALE, find_scale, normalize_unit
from topoloc.apps.reconstruction.work_folders import open_work_folder
from topoloc.plugin import cache_folder

MIN_OVERLAP = 3


@dataclass(frozen=True)
class PoseOptions:
    """Source and conventions of poses, as the options of `topoloc build`.

    `trajectory` has one entry for all recordings or one for each. If it is empty, the truth is used
    if all recordings have one, else SLAM; `photos` if they are single images. `tag` is the side of
    printed tags, metres.
    """

    trajectory: tuple[str, ...] = ()
    poses: str | None = None
    scale: tuple[str, ...] = ()
    allow_gaps: bool = False
    tag: float | None = None


def parse_conventions(poses: str | None) -> tuple[PoseConventions, bool]:
    """Parse the option `--poses`, and return False if it contains `unchecked`: the poses are not
    compared with the images. Raises TrajectoryError."""
    names = (poses or "").split(",")
    read = PoseConventions.parse(",".join(name for name in names if name != "unchecked"))
    return read, "unchecked" not in names


@dataclass(frozen=True)
class MapJob:
    """One map of one or several recordings. It can be pickled."""

    recordings: tuple[str, ...]
    pose_options: PoseOptions
    build: BuildConfig
    format: str | None = None
    camera: str | None = None
    images: str | None = None
    topics: str | None = None
    mask: str | None = None

    def make(
        self, progress: Progress, tell: Callable[[str], None] | None = None
    ) -> tuple[TopoMetricMap, list[str]]:
        """Return the map and the source of each recording's poses. Warnings go to standard error.
        `tell` is called with how each recording was understood. Raises UsageError: the options
        contradict each other or the recordings; TopolocError: see `open_sequence`, `run_slam` and
        `build_map`."""
        sequences, poses_from = self._open(tell)
        is_slam, is_computed = poses_from[0] == "slam", poses_from[0] in ("slam", "photos")
        build = self.build
        if poses_from[0] == "photos":
            sequences, scale_sigma = self._reconstruct(sequences, progress, tell)
            build = replace(build, scale_sigma=scale_sigma)
        if is_slam:
            result = run_slam(sequences, progress, _warn)
            sequences = result.apply(sequences)
            if apart := result.num_submaps - result.num_joined:
                _warn(f"{apart} of {result.num_submaps} sub-maps share no distinct view with any")
        for sequence in sequences:
            num_without = sum(pose is None for pose in sequence.poses)
            if num_without and poses_from[0] != "photos":
                count = f"{num_without} of {len(sequence)}"
                _warn(f"{sequence.name}: {count} frames have no pose and are left out")
        options = self.pose_options
        are_checked = parse_conventions(options.poses)[1] and poses_from[0] != "photos"
        checks = are_checked, not (options.allow_gaps or is_computed)
        topomap = build_map(sequences, build, progress, poses_from, *checks, _warn)
        if poses_from[0] == "photos":
            check_kept_back(topomap, sequences, tell, _warn)
        return topomap, poses_from

    def _reconstruct(
        self,
        sequences: list[StereoSequence],
        progress: Progress,
        tell: Callable[[str], None] | None,
    ) -> tuple[list[StereoSequence], float | None]:
        """Return single images with computed poses in metres, and the relative sigma of these. It
        is None without a scale, and lengths are then in units that follow from the depth."""
        options, images = self.pose_options, replace(self, pose_options=PoseOptions())
        measured = re.split("[,=]", ",".join(options.scale))
        for k, path in enumerate(self.recordings):
            if find_format(path, self.format) == "video":
                sequences[k] = keep_frames(select_key_frames(sequences[k], measured, progress))
        digest = replace(images, build=BuildConfig()).digest()
        names = "\n".join([digest, *(name for one in sequences for name in one.names)])
        work = sha256(names.encode("utf-8", "surrogateescape")).hexdigest()[:32]
        opened = open_work_folder(work, lambda: _warn("waiting for a build of the same images"))
        with RecordingError.at(f"cannot write {cache_folder()}", OSError), opened as path:
            found = reconstruct(sequences, path, progress, _warn)
        if options.scale == (NO_SCALE,):
            factor = normalize_unit(found)
            return [scale_poses(one, factor) for one in found.sequences], None
        scale = find_scale(found, options.scale, options.tag, tell, _warn)
        return [scale_poses(one, scale.metres) for one in found.sequences], scale.sigma

    def split_by_recording(self) -> list[MapJob]:
        """Return one job for each recording. Raises UsageError if the number of trajectories is
        wrong."""
        given = self.pose_options.trajectory
        pairs = zip(self.recordings, self._for_each(given), strict=True)
        options = self.pose_options
        return [
            replace(self, recordings=(one,), pose_options=replace(options, trajectory=source))
            for one, source in ((one, (name,) if given else ()) for one, name in pairs)
        ]

    def digest(self) -> str:
        """Return the digest of settings, versions, and names, sizes and times of all files, 64
        hexadecimal digits. Raises RecordingError if a recording is missing."""
        files = [path for text in self.recordings for path in _list_files(split_selection(text)[0])]
        for text in (*self.pose_options.trajectory, self.camera, self.images, self.mask):
            if text and os.path.exists(text):
                files += _list_files(Path(text))
        facts = {
            "settings": asdict(self),
            "versions": [version("topoloc"), TopoMetricMap.schema_version],
            "files": sorted(
                (os.path.abspath(path), path.stat().st_size, path.stat().st_mtime_ns)
                for path in files
            ),
        }
        text = json.dumps(facts, sort_keys=True)
        return sha256(text.encode("utf-8", "surrogateescape")).hexdigest()

    def _for_each(self, trajectories: tuple[str, ...]) -> tuple[str, ...]:
        """Return one trajectory for each recording. Raises UsageError."""
        if len(trajectories) < 2:
            return (trajectories or ("",)) * len(self.recordings)
        if len(trajectories) != len(self.recordings):
            raise UsageError(
                f"{len(self.recordings)} recordings but {len(trajectories)} trajectories"
            )
        return trajectories

    def _open(self, tell: Callable[[str], None] | None) -> tuple[list[StereoSequence], list[str]]:
        """Return the recordings with their poses and the sources of these. With `slam` the poses
        are computed later."""
        how = self.format, self.camera, self.topics, self.images, True, self.mask
        sequences = [keep_frames(open_recording(path, *how)) for path in self.recordings]
        if tell is not None:
            for path, sequence in zip(self.recordings, sequences, strict=True):
                tell(describe_recording(path, self.format, self.camera, sequence))
        has_truth = all(any(sequence.poses) for sequence in sequences)
        first = sequences[0][0]
        is_single = first.right is None and first.depth is None
        default = ("truth" if has_truth else "photos" if is_single else "slam",)
        trajectories = self._for_each(self.pose_options.trajectory or default)
        if self.pose_options.tag is not None and set(trajectories) != {"photos"}:
            raise UsageError("--tag gives the scale of images without poses (--trajectory photos)")
        if "photos" in trajectories:
            self._check_photo_options(trajectories)
            return sequences, list(trajectories)
        if NO_SCALE in self.pose_options.scale:
            raise UsageError("--scale none is for images without poses (--trajectory photos)")
        if "slam" in trajectories:
            if self.pose_options.poses is not None:
                raise UsageError("--poses needs given poses; slam computes its own")
            if set(trajectories) != {"slam"}:
                raise UsageError("--trajectory slam applies to all recordings or to none")
            if self.pose_options.scale:
                raise UsageError("--scale needs the recordings' own poses; slam computes its own")
            return sequences, list(trajectories)
        pairs = zip(sequences, trajectories, strict=True)
        return [self._with_poses(sequence, name) for sequence, name in pairs], list(trajectories)

    def _check_photo_options(self, trajectories: Sequence[str]) -> None:
        if set(trajectories) != {"photos"}:
            raise UsageError("--trajectory photos applies to all recordings or to none")
        if self.pose_options.poses is not None:
            raise UsageError("--poses needs given poses; those of photos are computed")
        if any("=" not in text and text != NO_SCALE for text in self.pose_options.scale):
            raise UsageError(
                "--scale METRES needs the recordings' own poses; photos take a distance, --tag, or"
                " --scale none"
            )

    def _with_poses(self, sequence: StereoSequence, trajectory: str) -> StereoSequence:
        conventions, _ = parse_conventions(self.pose_options.poses)
        scale = self.pose_options.scale
        if trajectory.endswith(".json"):
            raise UsageError(
                f"--trajectory takes a TUM or KITTI file; the poses of {trajectory} belong to the"
                f" images that it names: map {trajectory} itself, as the recording"
            )
        if trajectory == "truth":
            if scale:
                sequence = scale_poses(sequence, estimate_metric_scale(scale, sequence))
            return with_pose_conventions(sequence, conventions)
        if scale:
            raise UsageError(
                "--scale needs the recordings' own poses, but --trajectory gives others"
            )
        if has_scale(sequence):
            return with_trajectory(sequence, Path(trajectory), conventions)
        return align_to_trajectory(sequence, Path(trajectory))


def _warn(text: str) -> None:
    print_line(text, sys.stderr)


def _list_files(path: Path) -> Iterator[Path]:
    """Yield the file, or all files below the folder. Raises RecordingError."""
    if not os.path.exists(path):  # no error for a name that is too long
        raise RecordingError(f"{path}: no such file or folder")
    if path.is_file():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder) / name for name in names if (Path(folder) / name).is_file())


@dataclass(frozen=True)
class SplitOptions:
    """Maximum number of frames of a piece, and minimum number shared with the next one. Raises
    UsageError: the numbers do not fit together."""

    num_frames: int
    num_shared: int

    def __post_init__(self) -> None:
        if not MIN_OVERLAP <= self.num_shared <= self.num_frames // 2:
            raise UsageError(
                "--split FRAMES,SHARED: successive pieces must share at least"
                f" {MIN_OVERLAP} frames and at most half, not {self.num_shared} of"
                f" {self.num_frames}"
            )

    @staticmethod
    def parse(text: str | None) -> SplitOptions | None:
        """Parse the option, `500` or `500,50`. By default a tenth is shared. Raises UsageError."""
        if text is None:
            return None
        parts = re.fullmatch(r"([0-9]{1,9})(?:,([0-9]{1,9}))?", text)
        if parts is None:
            raise UsageError(f"--split takes frames, such as 500 or 500,50, not {text[:40]!r}")
        num_frames = int(parts[1])
        return SplitOptions(num_frames, int(parts[2] or max(num_frames // 10, MIN_OVERLAP)))

    def ranges(self, total: int) -> list[tuple[int, int]]:
        """Return the first frame, and the one after the last, of each piece of `total` frames. All
        pieces have the same length."""
        if total <= self.num_frames:
            return [(0, total)]
        step = self.num_frames - self.num_shared
        num = 1 + -(-(total - self.num_frames) // step)
        starts = [round(k * (total - self.num_frames) / (num - 1)) for k in range(num)]
        return [(start, start + self.num_frames) for start in starts]


@dataclass(frozen=True)
class MapPieces:
    """The maps of successive pieces of a recording, and the world of its own poses. The world is
    None without such poses, and for a single map."""

    piece_jobs: list[MapJob]
    world: str | None = None


def split_recording(map_job: MapJob, tile_id: str, split: SplitOptions) -> MapPieces:
    """Split the recording of `map_job`.

    A short recording stays whole, and one that cannot be opened, so that its own task fails.
    `tile_id`: tile id of the whole recording. Raises UsageError: the recording is long, and frames
    of it are selected.
    """
    (recording,) = map_job.recordings
    try:
        sequence = open_sequence(
            recording, map_job.format, map_job.camera, map_job.images, map_job.topics
        )
    except TopolocError:
        return MapPieces([map_job])
    ranges = split.ranges(len(sequence))
    if len(ranges) == 1:
        return MapPieces([map_job])
    options = map_job.pose_options
    if not options.trajectory and any(sequence.poses):  # also for pieces without a pose
        options = replace(options, trajectory=("truth",))
    path, selection = split_selection(recording)
    if selection is not None:
        raise UsageError(
            f"--split takes whole recordings, but frames of {path} are selected ({selection[:40]})"
        )
    pieces = [
        replace(map_job, recordings=(f"{path}@{start}:{stop}",), pose_options=options)
        for start, stop in ranges
    ]
    if options.trajectory in ((), ("slam",)):
        return MapPieces(pieces)
    digest = sha256(os.fsencode(os.path.abspath(recording))).hexdigest()  # unique by recording
    return MapPieces(pieces, f"{tile_id[:80]}-{digest[:8]}")
