"""Stages whose results are kept: a run that was interrupted, or is asked again, goes on from what
is there.

A stage is one JSON file, written when it is done, with all that its result follows from: its
settings (which name the stages that it builds on) and the code that it runs (`stage_code.py`).
Where either has changed it is done again.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from topoloc.errors import TopolocError
from topoloc.recordings.atomic import write_text
from topoloc_paper.stage_code import StageCode


@dataclass(frozen=True)
class Done:
    """A stage's result; `digest` stands for all that it follows from; `seconds` is what it took
    when it was done."""

    result: Any
    digest: str
    seconds: float


class StageStore:
    """The finished stages of one benchmark, in a folder.

    `num_done` and `num_kept` count the stages that this run did, and those that it found done.
    """

    def __init__(self, folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise TopolocError(f"cannot write {folder}: {error.strerror}") from error
        self.folder = folder
        self.num_done, self.num_kept = 0, 0

    def get(
        self,
        name: str,
        settings: Mapping[str, Any],
        compute: Callable[[], Any],
        code: StageCode,
        files: Sequence[Path] = (),
    ) -> Done:
        """The result of the stage `name`: the kept one if it follows from the same, else that of
        `compute`, as JSON gives it back.

        Args:
            files: what the stage writes beside its result; where one is missing it is done again.
        """
        path = self.folder / f"{name}.json"
        origin = json.loads(json.dumps({"settings": settings, "code": code.digest()}))
        kept = _read(path)
        if (
            kept is not None
            and kept.get("origin") == origin
            and all(file.exists() for file in files)
        ):
            self.num_kept += 1
            return Done(kept["result"], digest_of(origin), kept["seconds"])
        start = time.perf_counter()
        result = json.loads(json.dumps(compute()))
        seconds = time.perf_counter() - start
        write_text(
            path, json.dumps({"origin": origin, "seconds": seconds, "result": result}) + "\n"
        )
        self.num_done += 1
        return Done(result, digest_of(origin), seconds)


def digest_of(value: Any) -> str:
    """A short name for a JSON value, the same for equal values."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]


def _read(path: Path) -> dict[str, Any] | None:
    """A kept stage; None where there is none, or none that can be read."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return (
        kept if isinstance(kept, dict) and {"origin", "result", "seconds"} <= kept.keys() else None
    )
