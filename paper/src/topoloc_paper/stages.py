"""Store the results of stages, so that an interrupted or repeated run continues from them.

A stage is one JSON file, written at its end. It holds all on which the result depends: its settings
(which name the stages before it) and its code (`stage_code.py`). If either has changed, the stage
runs again.
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
    """Hold the result of a stage. `digest` identifies all on which it depends. `seconds` is its run
    time."""

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
        """Return the stored result of the stage `name` if its origin is equal, else the result of
        `compute`.

        Results pass through JSON.

        Args:
            files: files that the stage writes beside its result. If one is missing, the stage runs
                again.
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
    """Return a stored stage, None if there is none or if it cannot be read."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return (
        kept if isinstance(kept, dict) and {"origin", "result", "seconds"} <= kept.keys() else None
    )
