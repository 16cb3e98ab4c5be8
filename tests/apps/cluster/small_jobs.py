"""Define short jobs for tests of the runner. Workers import this module."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass

from topoloc.errors import RecordingError
from topoloc.mapping.build import Progress


@dataclass(frozen=True)
class Noting:
    """Log the begin and the end of the job. `does` selects an error or the end of the process."""

    number: int
    log: str
    does: str = "nothing"

    @property
    def name(self) -> str:
        return f"note {self.number}"

    def run(self, progress: Progress) -> str:
        self._note("begin")
        progress("noting", 1, 2)
        if self.does == "refuse":
            raise RecordingError(f"{self.number}: no pictures")
        if self.does == "break":
            raise ZeroDivisionError("a bug")
        if self.does == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.3)
        self._note("end")
        return f"done {self.number}"

    def failure_outcome(self, reason: str) -> str:
        return f"failed {self.number}: {reason}"

    def _note(self, what: str) -> None:
        with open(self.log, "a", encoding="utf-8") as file:
            file.write(f"{what} {self.number}\n")
