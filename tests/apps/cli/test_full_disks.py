"""Check that a command succeeds or changes nothing on a full disk or with few file handles."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from topoloc.recordings import atomic

ROOT = Path(__file__).parents[3]
COMMANDS = ["prune", "atlas create", "localize"]


def test_commands_do_their_work_or_change_nothing(tiny_recording: Path, tmp_path: Path):
    is_there = ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", str(tmp_path)]
    if (
        shutil.which("unshare") is None
        or subprocess.run(is_there, check=False, capture_output=True).returncode
    ):
        pytest.skip("no name spaces of mounts here")
    recordings = [f"{tiny_recording}@{first}::2" for first in (0, 1)]
    limits = ["--room", "0", "400", "--handles", "5", "8", "--only", *COMMANDS]
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / "full_disks.py"), *recordings, *limits],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT / "src")},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    rows = re.findall(r"\| ([a-z ]+) \| (\w+) \| (\d+) \| (\d+) \| 0 \|", done.stdout)
    assert [row[:2] for row in rows] == [
        (name, limit) for name in COMMANDS for limit in ("disk", "TMPDIR", "handles")
    ]
    refused = {(name, limit) for name, limit, _, number in rows if int(number)}
    assert {(name, "disk") for name in COMMANDS} <= refused
    assert ("atlas create", "handles") in refused


def test_outputs_written_before_a_failure_are_named(
    room_map: Path,
    queries: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
):
    from topoloc.apps.cli import main

    poses, replace = tmp_path / "poses.tum", os.replace

    def fill(source: Path, target: Path) -> None:
        if target == poses:
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(atomic.os, "replace", fill)
    answers = tmp_path / "answers.json"
    words = ["localize", str(room_map), str(queries), "--camera", "map"]
    assert main([*words, "--json", str(answers), "--tum", str(poses)]) == 1
    said = capfd.readouterr().err.splitlines()
    fault = f"error: cannot write {poses}: No space left on device"
    assert said[-1] == f"{fault} (already written: {answers})"
    assert sorted(tmp_path.iterdir()) == [answers]
    assert main([*words, "--tum", str(poses)]) == 1
    assert capfd.readouterr().err.splitlines()[-1] == fault
