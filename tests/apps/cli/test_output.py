"""Test outputs: complete files or none, a progress bar on terminals only, and
refusals in one line."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from topoloc import NotLocalized
from topoloc.apps.cli import main
from topoloc.apps.cli.output import check_outputs, print_fields, progress_bar, write_text
from topoloc.apps.cli.queries.query_answers import QueryAnswer, format_answer
from topoloc.errors import TopolocError
from topoloc.mapping.storage.entries import today


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_nothing_is_lost_where_a_file_cannot_be_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "result.json"
    write_text(path, "old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(TopolocError, match=r"cannot write .*result\.json: No space left on device"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.json"]


def test_outputs_that_can_be_written_pass(tmp_path: Path):
    (tmp_path / "old.json").write_text("{}")
    check_outputs(
        [None, "-", "-", str(tmp_path / "old.json"), str(tmp_path / "new.json")],
        inputs=[str(tmp_path / "map.topo")],
    )


@pytest.mark.skipif(not Path(os.devnull).is_char_device(), reason="no device files here")
def test_devices_are_not_replaced_by_files():
    with pytest.raises(TopolocError, match="no regular file"):
        check_outputs([os.devnull])


def test_one_path_is_not_two_outputs(tmp_path: Path):
    with pytest.raises(TopolocError, match="used twice"):
        check_outputs(
            [
                str(tmp_path / "a"),
                str(tmp_path / "sub" / ".." / "a") if (tmp_path / "sub").mkdir() is None else None,
            ]
        )


def test_a_file_of_a_recording_is_not_overwritten(
    room_map: Path, tiny_recording: Path, tmp_path: Path, complaint: Callable[..., str]
):
    recording = Path(shutil.copytree(tiny_recording, tmp_path / "walk"))
    truth = (recording / "truth.tum").read_bytes()
    frames = f"{recording}@0:2"
    for words in (
        ("localize", room_map, frames, "--tum", recording / "truth.tum"),
        ("slam", frames, recording / "truth.tum"),
        ("evaluate", room_map, frames, "--json", recording / "truth.tum"),
        ("certify", room_map, "--walk", frames, "--json", recording / "truth.tum"),
    ):
        text = complaint(*words)
        assert "truth.tum: it is a file of the input; choose another path, or remove it" in text
    assert (recording / "truth.tum").read_bytes() == truth
    own = str(recording / "answers.tum")
    for _ in range(2):  # answers of before are replaced
        assert main(["localize", str(room_map), frames, "--tum", own]) == 0


def test_facts_stand_in_columns(capsys: pytest.CaptureFixture[str]):
    print_fields([("map", "a.topo"), ("nodes", "12")])
    assert capsys.readouterr().out == "map    a.topo\nnodes  12\n"


def test_no_progress_bar_in_files(monkeypatch: pytest.MonkeyPatch):
    file = io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress_bar() as progress:
        progress("nodes", 1, 2)
    assert file.getvalue() == ""


def test_a_progress_bar_on_a_terminal_leaves_results_in_their_file(monkeypatch: pytest.MonkeyPatch):
    terminal, file = _Terminal(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys, "stdout", file)
    monkeypatch.setenv("TERM", "xterm")
    with progress_bar() as progress:
        print("a result")
        progress("nodes", 2, 2)
    assert "nodes" in terminal.getvalue()
    assert file.getvalue() == "a result\n"


# The help of `build` is longer than Python's buffer: it fails in the middle, not at the end.
SAYING = [
    (["--help"], "1"),
    (["--help"], ""),
    (["--version"], ""),
    (["build", "--help"], ""),
    (["info", "MAP"], ""),
]


@pytest.mark.parametrize(("args", "unbuffered"), SAYING)
def test_output_that_cannot_be_written_is_one_line_at_most(
    args: list[str], unbuffered: str, room_map: Path
):
    """A full device and a closed pipe print no traceback, not even when Python exits."""
    command = [
        sys.executable,
        "-m",
        "topoloc",
        *(str(room_map) if arg == "MAP" else arg for arg in args),
    ]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "wb") as gone:
        done = subprocess.run(
            command, stdout=gone, stderr=subprocess.PIPE, text=True, env=environment, check=False
        )
    assert (done.returncode, done.stderr) == (1, "")
    if not Path("/dev/full").is_char_device():
        pytest.skip("no /dev/full here")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment, check=False
        )
    assert (done.returncode, done.stderr) == (
        1,
        "error: cannot write the output: No space left on device\n",
    )


def test_a_closed_output_is_no_error(room_map: Path):
    command = [sys.executable, "-m", "topoloc", "info", str(room_map), "--json", "-"]
    close = "import os, sys; os.close(1); os.execv(sys.argv[1], sys.argv[1:])"
    done = subprocess.run(
        [sys.executable, "-c", close, *command], stderr=subprocess.PIPE, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("closed", [(2,), (0, 1, 2)])
def test_the_null_device_takes_the_place_of_closed_streams(closed: tuple[int, ...]):
    """A file that is opened later must not get their numbers, nor in a child."""
    close = f"import os, sys; [os.close(n) for n in {closed}]; os.execv(sys.argv[1], sys.argv[1:])"
    run = (
        "import os, sys; from topoloc.apps.cli import main; main(['-V']); sys.stderr.isatty();"
        " null = os.stat(os.devnull)\n"
        f"for n in {closed}: assert os.path.samestat(os.fstat(n), null) and os.get_inheritable(n)"
    )
    command = [sys.executable, "-c", close, sys.executable, "-c", run]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("device", ["/dev/full", "closed pipe"])
def test_the_work_goes_on_without_a_standard_error(device: str, room_map: Path):
    """Only the warnings are lost."""
    if device == "/dev/full" and not Path(device).is_char_device():
        pytest.skip("no /dev/full here")
    run = (
        "import sys; from topoloc.apps.cli import main, output\n"
        "for k in range(3): output.print_warning(str(k))\n"
        "sys.exit(main(['info', sys.argv[1]]))"
    )
    reading, writing = os.pipe()
    os.close(reading)
    with (
        open(writing, "wb") as gone,
        open(os.devnull if device != "/dev/full" else device, "wb") as full,
    ):
        error = gone if device == "closed pipe" else full
        command = [sys.executable, "-c", run, str(room_map)]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=error, check=False)
    assert done.returncode == 0
    assert b"nodes" in done.stdout


@pytest.mark.parametrize(
    ("value", "is_kept", "num_lines"),
    [("1700000000", True, 0), ("", False, 0), ("1e9", False, 1), ("1700000000000", False, 1)],
)
def test_a_date_that_is_no_time_is_dropped_before_the_work(
    value: str,
    is_kept: bool,
    num_lines: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", value)
    assert len(today()) == 10  # also of the library
    assert main(["-V"]) == 0
    assert ("SOURCE_DATE_EPOCH" in os.environ) == is_kept
    assert len(capsys.readouterr().err.splitlines()) == num_lines


def test_a_printed_refusal_has_its_reason_in_one_short_line():
    refusal = NotLocalized(
        "ambiguous", detail="as much like node 3 as\nlike node 7 " + 99 * "or so "
    )
    line = format_answer(QueryAnswer("photo.jpg", 0, refusal))
    assert line.startswith(
        "photo.jpg  not localized: ambiguous: as much like node 3 as like node 7 "
    )
    assert "\n" not in line
    assert len(line) < 240
    bare = format_answer(QueryAnswer("photo.jpg", 0, NotLocalized("jump")))
    assert bare == "photo.jpg  not localized: jump  (0 of 0 matches)"
