"""Test `topoloc --completion`: the installed shells complete commands, options and actions."""

from __future__ import annotations

import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from topoloc.apps.cli import all_commands, main

_TYPED = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
_topoloc; printf '%s\\n' "${COMPREPLY[@]}"
"""


@cache
def _script(shell: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "topoloc", "--completion", shell],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout


def _complete(folder: Path, *words: str) -> list[str]:
    """Return the completions of the last word in bash."""
    (folder / "script").write_text(_script("bash"), encoding="utf-8")
    command = ["bash", "-c", _TYPED, "-", str(folder / "script"), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_name_all_commands_and_are_read_by_their_shell(shell: str, tmp_path: Path):
    assert [name for name in all_commands() if name not in _script(shell)] == []
    if shutil.which(shell):
        (tmp_path / "script").write_text(_script(shell), encoding="utf-8")
        subprocess.run([shell, "-n", str(tmp_path / "script")], check=True)


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("topoloc", "lo"), ["localize"]),
        (("topoloc", "localize", "office.topo", "--sa"), ["--save-camera"]),
        (("topoloc", "atlas", "re"), ["remove"]),
        (("topoloc", *["localize"] * 9, "ev"), []),
        (("topoloc", "info", "office.to"), []),
    ],
)
def test_bash_completes_the_word(words: tuple[str, ...], offered: list[str], tmp_path: Path):
    assert _complete(tmp_path, *words) == offered


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_offers_each_command_and_each_option(tmp_path: Path):
    assert _complete(tmp_path, "topoloc", "") == list(all_commands())
    options = _complete(tmp_path, "topoloc", "view", "-")
    assert sorted(options) == sorted(
        ["--help", "--out", "--screenshot", "--tile", "--points", "--json"]
    )


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
def test_fish_completes_the_word(tmp_path: Path):
    (tmp_path / "script").write_text(_script("fish"), encoding="utf-8")
    for typed, offered in (("topoloc certi", "certify"), ("topoloc info a --ch", "--check")):
        code = f"source {tmp_path / 'script'}; complete -C '{typed}'"
        done = subprocess.run(["fish", "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.split("\t")[0].strip() == offered


@pytest.mark.parametrize("args", [[], ["csh"], ["bash", "zsh"]])
def test_another_shell_is_refused_in_one_line(args: list[str], capfd: pytest.CaptureFixture[str]):
    assert main(["--completion", *args]) == 2
    assert capfd.readouterr().err == (
        "error: --completion takes the name of a shell: bash, zsh or fish\n"
    )
