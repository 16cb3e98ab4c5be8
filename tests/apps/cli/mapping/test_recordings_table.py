"""Test the table of recordings that a build on a cluster prints."""

from __future__ import annotations

import io
import sys

import pytest

from topoloc.apps.cli.mapping.recordings_table import format_state, recordings_table
from topoloc.apps.cluster.tasks import JobProgress
from topoloc.apps.cluster.tiles import Outcome

BUILT = Outcome(
    "walks/hall", "hall", "built", num_nodes=12, num_bytes=2_500_000, seconds=31.26, host="one"
)
FAILED = Outcome("walks/yard", "yard", "failed", "walks/yard: no such file or folder")


def test_one_line_per_recording_without_a_terminal(capsys: pytest.CaptureFixture[str]):
    with recordings_table(["walks/hall", "walks/yard"]) as (show, is_live):
        assert not is_live
        show(0, JobProgress("nodes", 1, 5))
        show(0, BUILT)
        show(1, FAILED)
    assert capsys.readouterr().err.splitlines() == [
        "walks/hall: tile hall, 12 nodes, 2.50 MB, 31.3 s on one",
        "error: walks/yard: no such file or folder",
    ]


def test_one_table_on_a_terminal(monkeypatch: pytest.MonkeyPatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "120")
    with recordings_table(["walks/hall", "walks/yard", "walks/late"]) as (show, is_live):
        assert is_live
        show(0, JobProgress("nodes", 1, 5))
        show(1, FAILED)
        show(0, BUILT)
        shown = sys.stderr.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    assert "nodes 1/5" in shown
    last = shown[shown.rindex("recording") :]
    for text in ("walks/hall", "built", "2.50", "31.3", "failed: walks/yard: no such", "waits"):
        assert text in last
    assert "nodes 1/5" not in last


def test_printed_states():
    there = Outcome("walks/hall", "hall", "there")
    said = [format_state(state) for state in (None, JobProgress("images", 2, 7), BUILT, there)]
    assert said == ["waits", "images 2/7", "built", "there already"]
