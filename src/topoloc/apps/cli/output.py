"""Common parts of the commands: options, checks of output paths, progress, tables, JSON output."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import tyro

import topoloc  # most names of it load OpenCV; `topoloc doctor` must run without
from topoloc import MissingExtraError, TopolocError
from topoloc.apps import core_names
from topoloc.apps.cli import discard_output, printable
from topoloc.apps.core_names import remove_stale_files
from topoloc.apps.quality.certificate_texts import QUARTER_COLUMNS, quarter_cells
from topoloc.apps.report.plotting import load_matplotlib
from topoloc.plugin import write_text


def option(metavar: str, default: str = "", **more: Any) -> Any:
    """Describe an option of a command: its placeholder in the help, and its default in words if
    that is not a value. `more` are further arguments of `tyro.conf.arg`."""
    hint = f"(default: {default})" if default else ""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint, **more)


# A switch: no `--no-...`, and no "(default: False)" in the help.
Flag = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help_behavior_hint="")]
# An optional path.
File = Annotated[str | None, option("FILE")]
Format = Annotated[
    str | None,
    option(
        "NAME",
        "recognised",
        help="Format of the recordings: kitti, euroc, tum, seven_scenes, scannet,"
        " arkitscenes, nerfstudio, stray_scanner, record3d, colmap, opensfm, kapture,"
        " colmap_database, rosbag, mcap, zed, video, rig, equirectangular or folder.",
    ),
]
CameraOption = Annotated[
    str | None,
    option(
        "FILE|fx,fy,cx,cy",
        "that of the recording",
        help="Calibration instead of their own: camera.json, OpenCV's or Kalibr's"
        " YAML, COLMAP's cameras.txt, SN*.conf, or `fx,fy,cx,cy`.",
    ),
]
MaskOption = Annotated[
    str | None,
    option(
        "FILE",
        "none",
        help="Image that is black where the camera sees what moves with it (its robot),"
        " and white elsewhere.",
    ),
]
Topics = Annotated[
    str | None,
    option(
        "ROLE=TOPIC,...",
        "guessed",
        help="Topics of a bag: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom.",
    ),
]
# A Ray cluster.
RayOption = Annotated[str | None, option("HOST:PORT|auto|local", "none")]
PosesOption = Annotated[str | None, option("CONVENTION[,CONVENTION]", "world_from_cam, metres")]
_COLUMNS = (
    "recording",
    "localized",
    "median error",
    "in 5 cm, 5 deg",
    "in 25 cm, 2 deg",
    "false accepts",
    "ms",
)


def open_recording(
    path: str,
    format: str | None,
    camera: str | None = None,
    topics: str | None = None,
    images: str | None = None,
    whole_only: bool = False,
    mask: str | None = None,
) -> topoloc.StereoSequence:
    """Open a recording and print its notes on standard error. See `open_sequence` for errors."""
    words = path, format, camera, images, topics
    return topoloc.open_sequence(*words, print_warning, whole_only, mask)


def describe_recording(
    path: str, format: str | None, camera: str | None, sequence: topoloc.StereoSequence
) -> str:
    """Return how a recording was understood: format, frames, image size, duration, focal length,
    poses and gaps, in one line."""
    frame, t_ns = sequence[0], sequence.t_ns
    kind = "stereo pairs" if frame.right is not None else "images"
    kind += " with depth" if frame.depth is not None else ""
    size = f"{frame.image.shape[1]} x {frame.image.shape[0]}"
    facts = [f"{len(sequence)} {kind} of {size} in {(t_ns[-1] - t_ns[0]) / 1e9:.1f} s"]
    facts.append("no calibration" if frame.camera is None else f"f {frame.camera.fx:.4g} px")
    num_poses = sum(pose is not None for pose in sequence.poses)
    facts.append(f"poses of {num_poses} frames" if num_poses else "no poses")
    steps = sorted(after - before for before, after in pairwise(t_ns))
    if steps and steps[-1] > 10 * steps[len(steps) // 2]:
        facts.append(f"largest gap {steps[-1] / 1e9:.1f} s")
    return f"{path}: {core_names.find_format(path, format, camera)}, {', '.join(facts)}"


class UsageError(TopolocError):
    """The arguments of a command are wrong: exit status 2."""


def check_outputs(outputs: Sequence[str | None], inputs: Sequence[str | None] = ()) -> None:
    """Check before the work that the output files can be written. None and ``-`` are ignored.
    `inputs`: files, and recordings with their files, that must not be overwritten. Trajectories of
    answers in a recording may be. Raises TopolocError: the folder is missing or read-only, the path
    is no regular file, or a file is used twice."""
    taken = {os.path.realpath(path) for path in inputs if path}
    folders = {os.path.realpath(core_names.split_selection(path)[0]) for path in inputs if path}
    for path in (Path(output) for output in outputs if output not in (None, "-")):
        parents = {str(one) for one in Path(os.path.realpath(path)).parents}
        faults = {
            f"folder {path.parent} does not exist": not path.parent.is_dir(),
            "it is a folder": path.is_dir(),
            "it is no regular file": path.exists() and not path.is_file(),  # such as a device
            f"folder {path.parent} is read-only": not os.access(path.parent, os.W_OK),
            "this file is used twice": os.path.realpath(path) in taken,
            "it is a file of the input; choose another path, or remove it first": path.exists()
            and bool(parents & folders)
            and not core_names.has_answers(path),
        }
        if fault := next((text for text, is_found in faults.items() if is_found), None):
            raise TopolocError(f"cannot write {path}: {fault}")
        remove_stale_files(path)
        taken.add(os.path.realpath(path))


@contextmanager
def interruptible() -> Iterator[None]:
    """Restore KeyboardInterrupt and MemoryError, which compiled functions raise as SystemError."""
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and isinstance(error, SystemError):
            if isinstance(cause, KeyboardInterrupt | MemoryError):
                raise type(cause) from error
            cause = cause.__cause__ or cause.__context__
        if _is_out_of_memory(error):
            raise MemoryError from error
        raise


@contextmanager
def catch_stop_signals() -> Iterator[threading.Event]:
    """Set the event at the first Ctrl-C or SIGTERM. A second one interrupts the work."""
    stop = threading.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def end(number: int, _: object) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    if threading.current_thread() is not threading.main_thread():  # only it receives signals
        yield stop
        return
    for number in before:
        signal.signal(number, end)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether an error of OpenCV, FAISS or the library loader means too little memory."""
    words = (
        "Insufficient memory",
        "std::bad_alloc",
        "Cannot allocate memory",
        "failed to map segment",
        "can't start new thread",
    )
    is_os_error = isinstance(error, OSError) and error.errno == errno.ENOMEM
    return is_os_error or any(word in str(error) for word in words)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """Yield a callable (stage, done, total) that draws a bar for each stage on a terminal."""
    if not sys.stderr.isatty():
        yield lambda stage, done, total: None
        return
    from rich import progress as bars
    from rich.console import Console

    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.MofNCompleteColumn(),
        bars.TextColumn("{task.fields[speed]}"),
        bars.TimeRemainingColumn(),
    )
    # Printed lines go above the bar, except if stdout is a file.
    is_above, console = sys.stdout.isatty(), Console(stderr=True)
    with bars.Progress(*columns, console=console, redirect_stdout=is_above) as progress:
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total, speed="")
            speed = progress.tasks[tasks[stage]].speed
            shown = f"{speed:.1f}/s" if speed else ""
            progress.update(tasks[stage], completed=done, total=total, speed=shown)

        yield update


def import_report_writer() -> Callable[..., None]:
    """Return `write_report`. Raises MissingExtraError if the extra `report` is not installed."""
    with MissingExtraError.on_import("a report needs matplotlib", "report"):
        load_matplotlib()
        from topoloc.apps.report.report import write_report

        return write_report


def print_line(text: str, file: Any = None) -> None:
    """Print one line, by default on standard output. Control characters are written as escapes. The
    work goes on without a standard error that cannot be written."""
    try:
        print(printable(text), file=file, flush=True)
    except OSError:
        if file is None or file is not sys.stderr:
            raise
        discard_output(sys.stderr)


def print_warning(text: str) -> None:
    """Print a warning to standard error."""
    print_line(f"warning: {text}", sys.stderr)


def print_fields(facts: Sequence[tuple[str, str]]) -> None:
    """Print names and values, one pair on each line, in two columns."""
    width = max(len(name) for name, _ in facts)
    for name, value in facts:
        print_line(f"{name:<{width}}  {value}".rstrip())


def print_recordings(
    evaluation: dict[str, Any], published: Sequence[tuple[str, float, float]] = ()
) -> None:
    """Print the recordings of an evaluation, then published results (name, metres, degrees)."""
    rows = [_COLUMNS, *(_row(recording) for recording in evaluation["recordings"])]
    rows += [
        (name, "", _error(metres, degrees), "", "", "", "") for name, metres, degrees in published
    ]
    print_table(rows)


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows of cells in columns: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *cells in rows:
        padded = [f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True)]
        print_line("  ".join([f"{name:<{widths[0]}}", *padded]).rstrip())


def print_quarters(quarters: Sequence[Any]) -> None:
    """Print `Evaluation.quarters` or those of a certificate as a table below other facts."""
    if quarters:
        print()
        print_table([QUARTER_COLUMNS, *map(quarter_cells, quarters)])


def _row(recording: dict[str, Any]) -> tuple[str, ...]:
    recall, num, found = recording["recall"], recording["num_queries"], recording["num_localized"]
    shares = [f"{100 * recall[key]:.0f} %" if num else "" for key in ("0.05m_5deg", "0.25m_2deg")]
    localized, median = f"{found} of {num}" if num else "", ""
    if found:
        median = _error(recording["median_translation_m"], recording["median_rotation_deg"])
    false = f"{recording['false_accepts']} of {num + recording['num_elsewhere']}"
    total = recording["median_times_ms"].get("total")
    ms = "" if total is None else f"{total:.0f}"
    return recording["name"], localized, median, *shares, false, ms


def _error(metres: float, degrees: float) -> str:
    return f"{100 * metres:.2f} cm, {degrees:.2f} deg"


def print_waiting() -> None:
    """Print that another process edits the map and this one waits."""
    print("another process edits this map; waiting for it ...", file=sys.stderr, flush=True)


def write_json(path: str | None, data: Any) -> None:
    """Write `data` to the file of `--json`. `-` is standard output."""
    if path == "-":
        json.dump(data, sys.stdout, indent=1)
        print()
    elif path is not None:
        write_text(Path(path), json.dumps(data, indent=1) + "\n")
