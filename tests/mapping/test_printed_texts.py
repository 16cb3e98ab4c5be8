"""Check that texts of a map file are printed with escapes, and settings of any JSON in one line."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from mutations import forge

from topoloc.apps.cli import main

TITLE = "\x1b]0;owned\x07\nerror: forged"


def _changed(room_map: Path, tmp_path: Path, statement: str, *values: str) -> Path:
    """Return a copy of a map with other texts and right checksums."""
    path = Path(shutil.copy(room_map, tmp_path / "room.topo"))
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute(statement, values)
        forge(database)
    return path


@pytest.mark.parametrize(
    ("command", "statement"),
    [
        ("info", "UPDATE sessions SET name = ?"),
        ("history", "UPDATE edits SET name = ?"),
    ],
)
def test_control_characters_are_escaped(
    room_map: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    statement: str,
):
    path = _changed(room_map, tmp_path, statement, TITLE)
    assert main([command, str(path)]) == 0
    printed = capsys.readouterr()
    text = printed.out + printed.err
    assert all(c.isprintable() for c in text.replace("\n", ""))
    assert not any(line.startswith("error") for line in text.splitlines())
    assert r"\x1b]0;owned\x07\nerror: forged" in text


def test_an_error_with_control_characters_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert main(["info", str(tmp_path / TITLE)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert r"\x1b]0;owned\x07" in line


@pytest.mark.parametrize("weights", ["5", '{"file": "x", "sha256": 1}', "[[]]"])
def test_settings_of_a_coarse_model_may_be_any_json(
    room_map: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], weights: str
):
    settings = f'{{"backbone": "x", "weights": {weights}}}'
    path = _changed(room_map, tmp_path, "UPDATE coarse_models SET settings = ?", settings)
    assert main(["info", str(path)]) == 0
    assert "coarse localizer" in capsys.readouterr().out


def test_a_link_to_itself_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "self.topo"
    path.symlink_to(path)
    for command in (["info"], ["history"], ["undo"], ["prune"]):
        assert main([*command, str(path)]) == 1
        assert "symbolic links" in capsys.readouterr().err
