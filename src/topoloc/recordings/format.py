"""Define the interface of a recording format, and lists of images and times that formats share."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from warnings import warn

from topoloc.errors import RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.image_io import IMAGE_SUFFIXES
from topoloc.recordings.named_poses import has_pose_matrices
from topoloc.recordings.text_files import parse_times, read_rows
from topoloc.recordings.trajectory import Trajectory, has_answers

_DATE = re.compile(r"(?<!\d)(\d{9,10})\.(\d{1,9})(?=\.\D)")
_FIRST_DATE_NS, _LAST_DATE_NS = 946_684_800 * 10**9, 4_102_444_800 * 10**9  # 2000 to 2100


@dataclass(frozen=True)
class RecordingFormat:
    """Hold the functions that recognise and open recordings of a format."""

    expected_files: str
    can_open: Callable[[Path], bool]
    open: Callable[..., StereoSequence]
    open_options: tuple[str, ...] = ()
    """Keywords that `open` accepts. `topics`: the topics of a bag. `images`: the image folder of a
    model. `calibration`: a calibration, if recordings of the format may lack one (otherwise
    `open_sequence` replaces the format's own). `calibration_file`: the path of a calibration,
    passed on as `calibration`."""


@cache
def load_reader(place: str) -> Any:
    """Return what ``module:attribute`` names. The module is imported at the first use."""
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(module), attribute)


def list_images(folder: Path, suffix: str = "") -> list[Path]:
    """Return the image files of a folder in natural order (2 before 10). A `suffix` limits them to
    names that end with it.

    Raises:
        RecordingError: the folder is missing or contains no image.
    """
    with RecordingError.at(folder, OSError):
        paths = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in IMAGE_SUFFIXES
            and path.stem.endswith(suffix)
            and not path.name.startswith(".")
        ]
    if not paths:
        raise RecordingError(f"{folder}: no pictures in this folder")
    return sorted(paths, key=lambda path: natural_key(path.name))


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a sort key that compares numbers inside names as numbers of any length. The decimals
    of a date in seconds are compared as such."""
    name = _DATE.sub(lambda date: f"{date[1]}.{date[2]:0<9}", name)
    return [
        (len(number := part.lstrip("0")), number) if part.isdigit() else (-1, part)
        for part in re.split(r"([0-9]+)", name)
    ]


def complete_lists(times: Path | None, *lists: list[Path]) -> list[list[Path]]:
    """Return lists of images that correspond frame by frame, by the last number of each name.
    Missing images are listed as well: partners, and gaps in the numbers if the file `times` has a
    time for each.

    Raises:
        RecordingError: less than half of the numbers are in all lists, or `times` is empty.
    """
    num = len(read_rows(times, RecordingError)) if times and times.is_file() else None
    series = [list(map(_number, paths)) for paths in lists]
    found = [dict(zip(*pair, strict=True)) for pair in zip(series, lists, strict=True)]
    is_unique = all(map(len, lists)) and list(map(len, found)) == list(map(len, lists))
    numbers = series[0]
    if any(numbered != numbers for numbered in series):
        every = {number for by_number in found for number in by_number}
        num_common = sum(all(number in by_number for by_number in found) for number in every)
        if not is_unique or 2 * num_common < len(every):
            raise RecordingError(
                f"{lists[0][0].parent}: {len(lists[0])} pictures here but {len(lists[1])} in"
                f" {lists[1][0].parent.name}, {num_common} with the same last number in their"
                " names; every picture needs its partner"
            )
        numbers = numbers if len(numbers) == num else sorted(every, key=natural_key)
    if is_unique and num is not None and len(numbers) < num and all(numbers):
        numbers = _fill_gaps(numbers, num)
    if numbers == series[0] == series[-1]:
        return list(lists)
    return [
        [by_number.get(number) or _renumbered(paths[0], number) for number in numbers]
        for by_number, paths in zip(found, lists, strict=True)
    ]


def _fill_gaps(numbers: list[str], num: int) -> list[str]:
    """Return `num` numbers: the given ones and those between, or after them if they begin at 0.
    Return the given ones if that is not their number."""
    first, last = int(numbers[0]), int(numbers[-1])
    if last - first + 1 != num and (first != 0 or last >= num):
        return numbers
    width = min(map(len, numbers))
    return [f"{number:0{width}}" for number in range(first, first + num)]


def _number(path: Path) -> str:
    """Return the last number of the name of an image, as it is written. Empty if there is none."""
    return "".join(re.findall(r"\d+", path.stem)[-1:])


def _renumbered(path: Path, number: str) -> Path:
    """Return the image with another last number."""
    *_, last = re.finditer(r"\d+", path.stem)
    return path.with_name(path.name[: last.start()] + number + path.name[last.end() :])


def times_from_rate(num_frames: int, rate_hz: int = 10) -> list[int]:
    """Return times in nanoseconds at a constant rate, starting at 0."""
    return [index * 1_000_000_000 // rate_hz for index in range(num_frames)]


def times_from_names(paths: Sequence[Path]) -> list[int] | None:
    """Return the times (nanoseconds) that the names of images are: seconds with equally many
    decimals, or dates in any unit. Return None if they are no increasing times."""
    rows = [(0, [path.stem]) for path in paths]
    if not all(re.fullmatch(r"\d{1,19}(\.\d{1,9})?", stem) for _, (stem,) in rows):
        return None
    with suppress(RecordingError):
        t_ns = parse_times(rows, paths[0], RecordingError)
        num_decimals = {len(stem.partition(".")[2]) for _, (stem,) in rows}
        are_dates = _FIRST_DATE_NS <= t_ns[0] <= t_ns[-1] < _LAST_DATE_NS
        if are_dates or (len(num_decimals) == 1 and 0 not in num_decimals):
            return t_ns
    return None


def read_times(path: Path, num_frames: int) -> list[int]:
    """Read times in nanoseconds from a file with one time in seconds per line. Without a file the
    rate is 10 Hz.

    Raises:
        RecordingError: the file is malformed, times do not increase, or their number differs from
            `num_frames`.
    """
    if not path.is_file():
        return times_from_rate(num_frames)
    t_ns = parse_times(read_rows(path, RecordingError), path, RecordingError)
    if len(t_ns) != num_frames:
        raise RecordingError(f"{path}: {len(t_ns)} times for {num_frames} pictures")
    return t_ns


def read_ground_truth(
    first: Path, others: list[Path], t_ns: list[int], names: Sequence[str] = ()
) -> list[Rigid3 | None]:
    """Return the pose of each frame from the first existing file: TUM by time, KITTI rows by frame,
    rows with names, or a folder of matrices by the `names` of images. Return None for all frames if
    no file exists. Answers of a map are no ground truth; a warning names them.

    Raises:
        TrajectoryError: the file is malformed, or matches no frame.
    """
    for path in (first, *others):
        if has_answers(path):
            text = f"{path}: answers of a map, no ground truth; delete its first line to use them"
            warn(text, stacklevel=2)
        elif path.is_file() or has_pose_matrices(path):
            return Trajectory.read(path).match_frames(t_ns, path, names)
    return [None] * len(t_ns)
