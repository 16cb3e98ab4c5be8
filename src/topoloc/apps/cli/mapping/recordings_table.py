"""Show the progress of recordings: a table on a terminal, else one line for each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from topoloc.apps.cli.output import print_line
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
    """Return the state of a recording in a few words."""
    if state is None:
        return "waits"
    if isinstance(state, JobProgress):
        return f"{state.stage} {state.done}/{state.total}"
    return _STATES[state.state] if state.reason is None else f"failed: {state.reason}"


def format_outcome(outcome: Outcome) -> str:
    """Return one line for a finished recording."""
    prefix = f"{outcome.recording}: "
    if outcome.reason is not None:
        return f"error: {prefix}{outcome.reason.removeprefix(prefix)}"
    size = f"{outcome.num_nodes} nodes, {outcome.num_bytes / 1e6:.2f} MB"
    work = f"{outcome.seconds:.1f} s on {outcome.host}"
    work = _STATES["there"] if outcome.state == "there" else work
    return f"{prefix}tile {outcome.tile_id}, {size}, {work}"


def print_notes(outcomes: Sequence[Outcome], was_live: bool) -> None:
    """Print the notes of recordings, and after a table (`was_live`) the failures again."""
    for outcome in outcomes:
        for note in outcome.notes:
            print_line(f"{outcome.recording}: {note}", sys.stderr)
        if was_live and outcome.reason is not None:
            print_line(format_outcome(outcome), sys.stderr)


def report_outcomes(
    atlas: str, outcomes: Sequence[Outcome], done: dict[str, str], is_printed: bool
) -> dict[str, Any]:
    """Print the number of recordings of each state, and return them with the outcomes as JSON.
    `done`: the state of success, and its word."""
    words = done | {"there": "there already", "failed": "failed"}
    counts = {state: sum(one.state == state for one in outcomes) for state in words}
    (first, word), *others = [(counts[state], word) for state, word in words.items()]
    if is_printed:
        rest = "".join(f", {count} {name}" for count, name in others)
        print(f"{atlas}: {first} recordings {word}{rest}")
    return {"atlas": atlas, **counts, "recordings": [one.to_json() for one in outcomes]}


@contextmanager
def recordings_table(
    recordings: Sequence[str],
) -> Iterator[tuple[Callable[[int, Outcome | JobProgress], None], bool]]:
    """Yield a callable (recording's number, its state) that shows it, and whether it also shows
    recordings in progress."""

    def print_outcome(number: int, state: Outcome | JobProgress) -> None:
        if isinstance(state, Outcome):
            print_line(format_outcome(state), sys.stderr)

    if not sys.stderr.isatty():
        yield print_outcome, False
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
        side = "right" if name in ("nodes", "MB", "s") else "left"
        table.add_column(name, justify=side, overflow="fold")
    for recording, state in zip(recordings, states, strict=True):
        cells = [""] * 5
        if isinstance(state, Outcome) and state.state != "failed":
            size, seconds = f"{state.num_bytes / 1e6:.2f}", f"{state.seconds:.1f}"
            cells = [state.tile_id, str(state.num_nodes), size, seconds, state.host]
        table.add_row(recording, format_state(state), *cells)
    return table
