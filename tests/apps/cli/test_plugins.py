"""Check that a broken entry point of another distribution prints one warning and has
no other effect."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from topoloc.apps.cli import COMMANDS

BROKEN = {
    "no_such_module": ("missing_plugin:COMMANDS", "ModuleNotFoundError: No module named"),
    "no_dictionary": ("json:loads", "TypeError: 'function' object is not iterable"),
    "raises": ("broken_plugin:COMMANDS", "RuntimeError: built for another version of numpy"),
}


@pytest.fixture(params=BROKEN)
def broken(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    """Return a folder with an installed distribution whose entry points fail to load,
    and the reason."""
    target, reason = BROKEN[request.param]
    metadata = tmp_path / "broken_plugin-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-plugin\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        f"[topoloc.commands]\nbroken = {target}\n[topoloc.settings]\nbroken = {target}\n"
    )
    (tmp_path / "broken_plugin.py").write_text(
        'raise RuntimeError("built for\\nanother version of numpy")\n'
    )
    return tmp_path, reason


def _topoloc(folder: Path, *args: str | Path) -> subprocess.CompletedProcess[str]:
    paths = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.run(
        [sys.executable, "-m", "topoloc", *map(str, args)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
        timeout=120,
        check=False,
    )


def _warnings(answer: subprocess.CompletedProcess[str]) -> list[str]:
    assert "Traceback" not in answer.stderr
    return [line for line in answer.stderr.splitlines() if "plug-in" in line]


def test_help_warns_of_a_broken_plugin_once(broken: tuple[Path, str]):
    folder, reason = broken
    answer = _topoloc(folder, "--help")
    assert answer.returncode == 0
    assert all(f"  {command}  " in answer.stdout for command in COMMANDS)
    (line,) = _warnings(answer)
    assert line.startswith("warning: the plug-in ")
    assert reason in line


def test_localize_works_with_a_broken_plugin(
    broken: tuple[Path, str], room_map: Path, queries: Path, tmp_path: Path
):
    folder, _ = broken
    settings = tmp_path / "settings.toml"
    settings.write_text("[localize]\n")
    results = tmp_path / "results.jsonl"
    answer = _topoloc(
        folder, "localize", room_map, queries, "--config", settings, "--json", results
    )
    assert answer.returncode == 0, answer.stderr
    assert '"localized": true' in results.read_text(encoding="utf-8")
    assert _warnings(answer) == [], "localize needs no plug-in"
