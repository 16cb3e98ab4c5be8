"""A piece of an evaluation whose worker dies the first time; workers import this module."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from topoloc.apps.cli.queries.remote_queries import Piece, PieceAnswers
from topoloc.mapping.build import Progress


@dataclass(frozen=True, eq=False)
class DyingPiece(Piece):
    """Leaves a file beside the recording, and is killed, unless that is there."""

    def run(self, progress: Progress) -> PieceAnswers:
        begun = Path(f"{self.recording.path}.begun-{self.frames[0]}")
        if not begun.exists():
            begun.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().run(progress)
