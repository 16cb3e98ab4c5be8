"""Make the map of a recording as `topoloc build` does, and log when each attempt
begins and ends."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from topoloc.apps.cli.mapping.map_jobs import MapJob
from topoloc.mapping.build import Progress
from topoloc.mapping.topomap import TopoMetricMap


@dataclass(frozen=True)
class LoggingMaker:
    """Wait `seconds` at the first attempt, so that a test can kill the worker before the
    map is complete."""

    making: MapJob
    log: str
    name: str
    seconds: float = 0.0

    def make(self, progress: Progress) -> tuple[TopoMetricMap, list[str]]:
        is_first = f"begin {self.name}" not in _read(self.log)
        self._write("begin")
        if is_first:
            time.sleep(self.seconds)
        made = self.making.make(progress)
        self._write("end")
        return made

    def digest(self) -> str:
        return self.making.digest()

    def _write(self, what: str) -> None:
        from ray import get_runtime_context

        with open(self.log, "a", encoding="utf-8") as file:
            file.write(f"{what} {self.name} {os.getpid()} {get_runtime_context().get_node_id()}\n")


def _read(log: str) -> str:
    return Path(log).read_text(encoding="utf-8") if Path(log).exists() else ""
