"""Read lists of images with their times, and match the times of two lists."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePath, PureWindowsPath

import numpy as np

from topoloc import RecordingError, TopolocError
from topoloc.apps.core_names import parse_times, with_decimal_points
from topoloc.plugin import read_text

_TIME_AND_NAME = re.compile(r"([^\s,;]+)[\s,;]+(.+?\.[A-Za-z]\w{2,3}(?=[\s,;]|$)|[^\s,;]+)")


def match_times(
    t_ns: Sequence[int],
    others: Sequence[int],
    max_delay_ms: int,
    where: str,
    names: tuple[str, str],
) -> tuple[list[tuple[int, int]], tuple[str, ...]]:
    """Return the row of each time that has another one (both increasing, nanoseconds) within
    `max_delay_ms`, with the row of the nearest. The second value is a note on the times without.

    Raises:
        RecordingError: no time has one. Begins with `where`. `names` are those of the two lists.
    """
    times, partners = np.array(t_ns), np.array(others)
    after = np.clip(np.searchsorted(partners, times), 1, max(len(partners) - 1, 1))
    before, after = after - 1, np.minimum(after, len(partners) - 1)
    nearest = np.where(times - partners[before] <= partners[after] - times, before, after)
    delays = np.abs(times - partners[nearest])
    kept = np.flatnonzero(delays <= max_delay_ms * 1_000_000)
    num_without = len(times) - len(kept)
    text = (
        f"{where}: {num_without} of {len(times)} pictures of {names[0]} have none of {names[1]}"
        f" ({len(partners)}) within {max_delay_ms} ms"
    )
    if not len(kept):
        raise RecordingError(f"{text}; the nearest is {delays.min() / 1e6:.1f} ms away")
    notes = (f"{text} and are left out",) if num_without else ()
    return list(zip(kept.tolist(), nearest[kept].tolist(), strict=True)), notes


def read_file_list(path: Path, error: type[TopolocError]) -> tuple[list[int], list[str]]:
    """Read the times in nanoseconds and the file names of a list of images. The files are below the
    list's folder. A name ends with its suffix and may contain spaces and commas.

    Raises:
        error: as `read_rows` and `parse_times`, a line has no file name, or a name leaves the
            folder.
    """
    rows: list[tuple[int, list[str]]] = []
    for number, text in enumerate(read_text(path, error).splitlines(), start=1):
        line = with_decimal_points(text.strip())
        if line and not line.startswith("#"):
            found = _TIME_AND_NAME.match(line)
            if found is None:
                raise error(f"{path}, line {number}: not a time and a file name")
            name = parse_relative_path(found[2], f"{path}, line {number}", error)
            rows.append((number, [found[1], name]))
    if not rows:
        raise error(f"{path}: nothing in this file")
    return parse_times(rows, path, error), [name for _, (_, name) in rows]


def parse_relative_path(name: str, where: str, error: type[TopolocError]) -> str:
    """Return a file name that stays inside its folder, with slashes instead of backslashes. Raises
    `error` otherwise, which begins with `where`."""
    path = PurePath(name.replace("\\", "/"))
    leaves = path.is_absolute() or ".." in path.parts or PureWindowsPath(name).drive
    if not path.parts or leaves or "\0" in name:
        raise error(f"{where}: {name[:80]!r} is no picture below this folder")
    return path.as_posix()
