"""Check that times are read in the unit that gives a date or a plausible frame rate."""

from pathlib import Path

import pytest

from topoloc.errors import RecordingError
from topoloc.recordings.format import read_times
from topoloc.recordings.text_files import parse_times, read_rows
from topoloc.recordings.trajectory import Trajectory

NOW_S = 1_700_000_000


@pytest.mark.parametrize(
    ("start", "step", "per_second"),
    [
        (NOW_S, 1, 1),
        (NOW_S, 60, 1),
        (0, 5, 1),
        (NOW_S * 10**3, 520, 10**3),
        (0, 33, 10**3),
        (NOW_S * 10**6, 33_333, 10**6),
        (2 * 10**9, 5_000, 10**6),
        (NOW_S * 10**9, 50_000_000, 10**9),
        (5 * 10**12, 33_333_333, 10**9),
        (0, 33_333_333, 10**9),
    ],
)
def test_the_unit_is_found(tmp_path: Path, start: int, step: int, per_second: int):
    times = [start + step * k for k in range(8)]
    (tmp_path / "times.txt").write_text("".join(f"{time}\n" for time in times))
    (tmp_path / "truth.tum").write_text("".join(f"{time} 0 0 0 0 0 0 1\n" for time in times))
    t_ns = [time * (10**9 // per_second) for time in times]
    assert read_times(tmp_path / "times.txt", len(times)) == t_ns
    assert Trajectory.read(tmp_path / "truth.tum").t_ns == t_ns


def test_a_pause_does_not_change_the_unit(tmp_path: Path):
    (tmp_path / "times.txt").write_text("0\n0.1\n0.2\n0.3\n9000\n")
    assert read_times(tmp_path / "times.txt", 5)[-1] == 9_000_000_000_000


def test_surveyed_positions_may_be_far_apart_in_time(tmp_path: Path):
    path = tmp_path / "positions.csv"
    path.write_text("0\n60\n120\n")
    assert parse_times(read_rows(path, RecordingError), path, RecordingError, 1e9)[1] == 60 * 10**9


def test_a_stream_in_milliseconds_is_read_as_such(shared: Path):
    path = shared / "cases" / "turn3" / "times_in_milliseconds" / "times.txt"
    t_ns = read_times(path, 7)
    assert t_ns[0] == NOW_S * 10**9
    assert t_ns[1] - t_ns[0] == 520_000_000


@pytest.mark.parametrize("factor", [10**3, 10**6, 10**9])
def test_dates_of_another_unit_with_many_decimals_fit_into_64_bits(tmp_path: Path, factor: int):
    path = tmp_path / "times.txt"
    path.write_text("".join(f"{factor * (1687709319 + k)}.000000000\n" for k in range(5)))
    assert read_times(path, 5) == [(1687709319 + k) * 10**9 for k in range(5)]


def test_times_beyond_64_bits_are_refused_in_one_line(tmp_path: Path):
    path = tmp_path / "times.txt"
    path.write_text("".join(f"{10**11 + k}\n" for k in range(5)))
    with pytest.raises(RecordingError, match="beyond 292 years; write seconds"):
        read_times(path, 5)
