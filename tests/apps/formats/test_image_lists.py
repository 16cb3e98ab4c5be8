"""Check lists of images with times, the names in them, and the matching of two lists by time."""

from __future__ import annotations

from pathlib import Path

import pytest

from topoloc.apps.formats.image_lists import match_times, parse_relative_path, read_file_list
from topoloc.errors import RecordingError

MS = 1_000_000


def test_each_time_gets_its_nearest_partner():
    pairs, notes = match_times(
        [0, 100 * MS, 200 * MS], [3 * MS, 96 * MS, 104 * MS], 5, "a", ("b", "c")
    )
    assert pairs == [(0, 0), (1, 1)]  # of two equally near ones the first
    assert notes == ("a: 1 of 3 pictures of b have none of c (3) within 5 ms and are left out",)
    assert match_times([0, MS], [0, MS], 5, "a", ("b", "c")) == ([(0, 0), (1, 1)], ())


def test_lists_without_a_common_time_are_an_error():
    with pytest.raises(
        RecordingError, match=r"^a: 2 of 2 pictures .*; the nearest is 8\.0 ms away$"
    ):
        match_times([0, MS], [9 * MS], 5, "a", ("b", "c"))


def test_names_may_hold_spaces_and_commas(tmp_path: Path):
    path = tmp_path / "list.txt"
    path.write_text("# time file\n1.5 rgb/a b.png\n\n2,5;rgb/c,d.png\n3.5 rgb\\e.png\n")
    t_ns, names = read_file_list(path, RecordingError)
    assert t_ns == [1_500_000_000, 2_500_000_000, 3_500_000_000]
    assert names == ["rgb/a b.png", "rgb/c,d.png", "rgb/e.png"]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("# nothing\n", "nothing in this file"),
        ("1.0\n", "line 1: not a time and a file name"),
        ("1.0 a.png\n1.0 b.png\n", "line 2: time 1.0 is not after the one before"),
        ("1.0 a.png\n2.0 ../b.png\n", "line 2: '../b.png' is no picture below this folder"),
    ],
)
def test_broken_lists_are_errors_with_their_line(tmp_path: Path, text: str, fault: str):
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises(RecordingError) as raised:
        read_file_list(tmp_path / "list.txt", RecordingError)
    assert str(raised.value).startswith(str(tmp_path / "list.txt"))
    assert str(raised.value).endswith(fault)


@pytest.mark.parametrize(
    "name", ["/a.png", "../a.png", "a/../../b.png", "C:\\a.png", "", "a\0.png"]
)
def test_no_name_leaves_its_folder(name: str):
    with pytest.raises(RecordingError, match="is no picture below this folder"):
        parse_relative_path(name, "list", RecordingError)
