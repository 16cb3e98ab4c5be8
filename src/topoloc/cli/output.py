"""What the commands share: progress on a terminal, and JSON results written at once."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from topoloc.errors import TopolocError


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A callable (stage, done, total) that draws one bar a stage on a terminal, and nothing elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total, speed="")
            speed = progress.tasks[tasks[stage]].speed
            progress.update(tasks[stage], completed=done, total=total, speed=f"{speed:.1f}/s" if speed else "")

        yield update


def write_text(path: Path, text: str) -> None:
    """Write a result file at once or not at all. Raises TopolocError."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        raise TopolocError(f"cannot write {path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | None, data: Any) -> None:
    """Write `data` to the file of `--json`; `-` is standard output, None nowhere."""
    if path == "-":
        json.dump(data, sys.stdout, indent=1)
        print()
    elif path is not None:
        write_text(Path(path), json.dumps(data, indent=1) + "\n")
