"""Read text files with one record per line: lists, times and poses of recordings."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from topoloc.errors import TopolocError, TrajectoryError

NANOSECONDS_PER_SECOND = 1_000_000_000
# Times with as many decimals are seconds, such as those of `Trajectory.write_tum`.
_NUM_FINE_DECIMALS = 7
# Maximum number of digits before the decimal point. Parsing an integer of a million digits takes
# minutes.
_MAX_DIGITS = 25
# Up to ten digits are seconds, not nanoseconds. These fit into 64 bits as nanoseconds.
_PLAIN_SECONDS = re.compile(r"[0-8]?[0-9]{1,9}(?:\.[0-9]{1,9})?")
_DECIMAL_COMMA = re.compile(r"(?<![^\s;])([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)(?=[\s;]|$)")

Rows = Sequence[tuple[int, list[str]]]
"""Line numbers and columns."""


def read_text(path: Path, error: type[TopolocError], missing: str = "no such file") -> str:
    """Return the text of a file. Raises `error` with the file name."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise error(f"{path}: {missing}") from None
    except UnicodeDecodeError:
        raise error(f"{path}: not a text file") from None
    except (OSError, ValueError) as failure:  # ValueError: a name with a null character
        reason = getattr(failure, "strerror", None) or failure
        raise error(f"{str(path)[:200]}: {reason}") from None


def read_rows(path: Path, error: type[TopolocError]) -> list[tuple[int, list[str]]]:
    """Return line number and columns (split at spaces and commas) of each line. Blank lines and
    comments (``#``) are skipped.

    Raises:
        error: the file is missing, not text, or has no rows. Names it.
    """
    rows = [
        (number, columns)
        for number, line in enumerate(_read_lines(path, error), start=1)
        if (columns := line.split())
    ]
    if not rows:
        raise error(f"{path}: nothing in this file")
    return rows


def _read_lines(path: Path, error: type[TopolocError]) -> list[str]:
    """Return the lines without comments, with spaces instead of commas and semicolons."""
    text = read_text(path, error)
    if "," in text or ";" in text:
        lines = map(with_decimal_points, text.splitlines())
        text = "\n".join(lines).replace(",", " ").replace(";", " ")
    return [line.partition("#")[0] for line in text.splitlines()]


def with_decimal_points(line: str) -> str:
    """Replace the decimal commas of a line whose columns are separated by spaces or semicolons."""
    has_columns = len(line.split(None, 1)) > 1 or ";" in line
    return _DECIMAL_COMMA.sub(r"\1.\2", line) if has_columns else line


def read_numeric_table(
    path: Path, error: type[TopolocError]
) -> tuple[Float[np.ndarray, "n c"], list[str]] | None:
    """Read a file that contains only finite numbers, equally many per line, in one pass. Comments
    are skipped. Return the numbers and the lines, or None for any other file.

    Raises:
        error: the file is missing or not text.
    """
    lines = [line for line in _read_lines(path, error) if line and not line.isspace()]
    if not lines:
        return None
    try:
        numbers = np.loadtxt(lines, comments=None, ndmin=2)
    except ValueError:
        return None
    return (numbers, lines) if len(numbers) == len(lines) and np.isfinite(numbers).all() else None


def parse_uniform_times(lines: Sequence[str]) -> list[int] | None:
    """Parse times as `parse_times`, if all are written alike, such as ``1403636579.763555584``.
    Return None otherwise."""
    tokens = [line.split(None, 1)[0] for line in lines]
    lengths = {len(token.partition(".")[2]) for token in tokens}
    if len(lengths) > 1 or not all(map(_PLAIN_SECONDS.fullmatch, tokens)):
        return None
    num_decimals = lengths.pop()
    units = np.array([int(token.replace(".", "")) for token in tokens], np.int64)
    t_ns = units * 10 ** (9 - num_decimals)
    steps = np.diff(t_ns)
    step_s = float(np.median(steps)) / NANOSECONDS_PER_SECOND if len(steps) else 0.0
    is_fine = num_decimals >= _NUM_FINE_DECIMALS
    in_seconds = is_fine or _find_digits(t_ns[-1] / NANOSECONDS_PER_SECOND, step_s) == 9
    return t_ns.tolist() if in_seconds and (steps > 0).all() else None


def parse_times(
    rows: Rows, path: Path, error: type[TopolocError], max_step_s: float = 10.0
) -> list[int]:
    """Parse the first column to integer nanoseconds, exact to the last decimal. The times may be in
    seconds, milliseconds, microseconds or nanoseconds. Steps of seconds are at most `max_step_s`
    (median), unless the times are dates.

    Raises:
        error: a time is not a finite number, or the times do not increase strictly. Names file and
            line.
    """
    times: list[Decimal] = []
    for line, columns in rows:
        try:
            time = Decimal(columns[0])
        except InvalidOperation:
            time = Decimal("nan")
        if not time.is_finite() or time.adjusted() > _MAX_DIGITS:
            raise error(f"{path}, line {line}: {columns[0][:40]!r} is not a time")
        times.append(time)
    steps = [float(after - before) for before, after in pairwise(times)]
    step = float(np.median(steps)) if steps else 0.0
    max_seconds = 9_223_372_036  # nanoseconds of 64 bits
    is_fine = -int(times[-1].as_tuple().exponent) >= _NUM_FINE_DECIMALS
    is_fine &= abs(times[-1]) < max_seconds
    digits = 9 if is_fine else _find_digits(float(times[-1]), step, max_step_s)
    t_ns = [int(time.scaleb(digits).to_integral_value()) for time in times]
    if abs(t_ns[-1]) > 1_000_000_000 * max_seconds:
        raise error(f"{path}: time {rows[-1][1][0][:40]} is beyond 292 years; write seconds")
    for (line, columns), before, after in zip(rows[1:], t_ns[:-1], t_ns[1:], strict=True):
        if after <= before:
            raise error(f"{path}, line {line}: time {columns[0][:40]} is not after the one before")
    return t_ns


def _find_digits(last: float, step: float, max_step_s: float = 10.0) -> int:
    """Return 9 if times are in seconds, 6 for milliseconds, 3 for microseconds, 0 for nanoseconds:
    the unit that gives a date of this century, or else the largest with steps as of frames."""
    first_date, last_date, max_date_step = 946_684_800, 4_102_444_800, 3600  # 2000 to 2100, s
    max_seconds = 1e12  # larger ones would be 30 000 years
    for digits in (9, 6, 3, 0):
        unit = 10.0 ** (digits - 9)
        if first_date <= last * unit < last_date and step * unit <= max_date_step:
            return digits
    if last <= max_seconds and step <= max_step_s:
        return 9
    return 6 if 0.0 < step <= 2e3 else 3 if 0.0 < step <= 2e6 else 0


def parse_numbers(path: Path, rows: Rows, columns: Sequence[int]) -> Float[np.ndarray, "n c"]:
    """Return these columns of the rows as finite numbers. Raises TrajectoryError."""
    numbers = np.empty((len(rows), len(columns)))
    for row, (line, tokens) in enumerate(rows):
        for at, column in enumerate(columns):
            try:
                numbers[row, at] = float(tokens[column])
            except ValueError:
                token = tokens[column][:40]
                raise TrajectoryError(f"{path}, line {line}: {token!r} is not a number") from None
    is_finite = np.array([np.isfinite(row).all() for row in numbers])
    check_rows(is_finite, "NaN or infinite numbers", path, rows)
    return numbers


def check_rows(is_good: Bool[np.ndarray, " n"], fault: str, path: Path, rows: Rows) -> None:
    """Raise TrajectoryError with the first bad row and its fault, if there is one."""
    if not is_good.all():
        line, tokens = rows[int(np.argmin(is_good))]
        raise TrajectoryError(f"{path}, line {line}: {fault} in {' '.join(tokens)[:120]}")
