"""What the commands share: output paths checked before the work, progress on a terminal, results written at once."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from topoloc.errors import MissingExtraError, TopolocError
from topoloc.sequences.atomic import remove_leftovers, write_text


class UsageError(TopolocError):
    """The command was called in a way that cannot be meant: exit status 2."""


def check_outputs(outputs: Sequence[str | None], inputs: Sequence[str] = ()) -> None:
    """Hold that the files a command is to write can be written, so that it fails before the work and not after.

    Args:
        outputs: paths; None and ``-`` are no files.
        inputs: files that must not be overwritten.

    Raises:
        TopolocError: the folder is missing or read-only, the path is no regular file, or it is named for two things.
    """
    taken = {Path(path).resolve() for path in inputs}
    for path in (Path(output) for output in outputs if output not in (None, "-")):
        if not path.parent.is_dir():
            raise TopolocError(f"cannot write {path}: folder {path.parent} does not exist")
        if path.is_dir():
            raise TopolocError(f"cannot write {path}: it is a folder")
        if path.exists() and not path.is_file():  # a device would be replaced by a file of its name
            raise TopolocError(f"cannot write {path}: it is no regular file")
        if not os.access(path.parent, os.W_OK):
            raise TopolocError(f"cannot write {path}: folder {path.parent} is read-only")
        if path.resolve() in taken:
            raise TopolocError(f"cannot write {path}: this file is named for something else, too")
        remove_leftovers(path)
        taken.add(path.resolve())


@contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C or too little memory inside a compiled function come out of it as a SystemError; here they become what they were."""
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and isinstance(error, SystemError):
            if isinstance(cause, KeyboardInterrupt | MemoryError):
                raise type(cause) from error
            cause = cause.__cause__ or cause.__context__
        if _is_out_of_memory(error):
            raise MemoryError from error
        raise


def _is_out_of_memory(error: Exception) -> bool:
    """OpenCV, FAISS and the loader of shared libraries have words of their own for it."""
    text = str(error)
    words = ("Insufficient memory", "std::bad_alloc", "Cannot allocate memory", "failed to map segment", "can't start new thread")
    return (isinstance(error, OSError) and error.errno == 12) or any(word in text for word in words)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A callable (stage, done, total) that draws one bar a stage where stderr is a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    # Lines printed meanwhile go above the bar; where stdout is a file they must stay in that file.
    with Progress(*columns, console=Console(stderr=True), redirect_stdout=sys.stdout.isatty()) as progress:
        tasks: dict[str, Any] = {}

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total, speed="")
            speed = progress.tasks[tasks[stage]].speed
            progress.update(tasks[stage], completed=done, total=total, speed=f"{speed:.1f}/s" if speed else "")

        yield update


def report_writer() -> Callable[..., None]:
    """`write_report`, of the extra `report`. Raises MissingExtraError where that is not installed."""
    try:
        from topoloc.evaluation.report import write_report
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] != "matplotlib":
            raise
        raise MissingExtraError("a report needs matplotlib: pip install 'topoloc[report]'") from error
    return write_report


def print_facts(facts: Sequence[tuple[str, str]]) -> None:
    """Names and values, one pair a line, the values in one column."""
    width = max(len(name) for name, _ in facts)
    for name, value in facts:
        print(f"{name:<{width}}  {value}".rstrip())


def write_json(path: str | None, data: Any) -> None:
    """Write `data` to the file of `--json`; `-` is standard output, None nowhere."""
    if path == "-":
        json.dump(data, sys.stdout, indent=1)
        print()
    elif path is not None:
        write_text(Path(path), json.dumps(data, indent=1) + "\n")
