"""Recordings that become tiles, or join them: one table on a terminal, one line each elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from topoloc.apps.cluster.tasks import JobProgress
from topoloc.apps.cluster.tiles import Outcome

_STATES = {
    "built": "built",
    "recognised": "waits",
    "updated": "updated",
    "there": "there already",
    "failed": "failed",
}


def format_state(state: Outcome | JobProgress | None) -> str:
    """Where a recording is, in a few words."""
    if state is None:
        return "waits"
    if isinstance(state, JobProgress):
        return f"{state.stage} {state.done}/{state.total}"
    return _STATES[state.state] if state.reason is None else f"failed: {state.reason}"


def format_outcome(outcome: Outcome) -> str:
    """One line of a recording that is finished."""
    if outcome.reason is not None:
        return (
            f"error: {outcome.recording}: {outcome.reason.removeprefix(f'{outcome.recording}: ')}"
        )
    size = f"{outcome.num_nodes} nodes, {outcome.num_bytes / 1e6:.2f} MB"
    took = (
        "there already"
        if outcome.state == "there"
        else f"{outcome.seconds:.1f} s on {outcome.host}"
    )
    return f"{outcome.recording}: tile {outcome.tile_id}, {size}, {took}"


def print_notes(outcomes: Sequence[Outcome], was_live: bool) -> None:
    """What is to be known of recordings beside; below a table (`was_live`) also what failed once
    more, where it can be copied."""
    for outcome in outcomes:
        for note in outcome.notes:
            print(f"{outcome.recording}: {note}", file=sys.stderr)
        if was_live and outcome.reason is not None:
            print(format_outcome(outcome), file=sys.stderr)


@contextmanager
def recordings_table(
    recordings: Sequence[str],
) -> Iterator[tuple[Callable[[int, Outcome | JobProgress], None], bool]]:
    """A callable (recording's number, its state) that shows it; and whether it wants to know of
    those that are being worked on, too."""
    if not sys.stderr.isatty():
        yield (
            lambda number, state: (
                print(format_outcome(state), file=sys.stderr)
                if isinstance(state, Outcome)
                else None
            ),
            False,
        )
        return
    from rich.console import Console
    from rich.live import Live

    states: list[Outcome | JobProgress | None] = [None] * len(recordings)
    with Live(
        _table(recordings, states),
        console=Console(stderr=True),
        redirect_stdout=sys.stdout.isatty(),
        auto_refresh=False,
    ) as live:

        def show(number: int, state: Outcome | JobProgress) -> None:
            states[number] = state
            live.update(_table(recordings, states), refresh=True)

        yield show, True


def _table(recordings: Sequence[str], states: Sequence[Outcome | JobProgress | None]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for name in ("recording", "state", "tile", "nodes", "MB", "s", "machine"):
        table.add_column(
            name, justify="right" if name in ("nodes", "MB", "s") else "left", overflow="fold"
        )
    for recording, state in zip(recordings, states, strict=True):
        cells = [""] * 5
        if isinstance(state, Outcome) and state.state != "failed":
            cells = [
                state.tile_id,
                str(state.num_nodes),
                f"{state.num_bytes / 1e6:.2f}",
                f"{state.seconds:.1f}",
                state.host,
            ]
        table.add_row(recording, format_state(state), *cells)
    return table
