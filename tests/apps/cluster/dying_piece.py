"""Define a piece of an evaluation that kills its first worker. Workers import this module."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from topoloc.apps.cli.queries.remote_queries import Piece, PieceAnswers
from topoloc.mapping.build import Progress


@dataclass(frozen=True, eq=False)
class DyingPiece(Piece):
    """Kill the worker at the first run, and leave a file beside the recording as a mark."""

    def run(self, progress: Progress) -> PieceAnswers:
        begun = Path(f"{self.recording.path}.begun-{self.frames[0]}")
        if not begun.exists():
            begun.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().run(progress)
