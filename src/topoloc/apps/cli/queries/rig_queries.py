"""Localize the images of rigs: folders of one recording a camera, and panoramas."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any

from topoloc import (
    Localizer,
    QueryError,
    RigLocalization,
    RigLocalizer,
    RigNotLocalized,
    StereoSequence,
    Trajectory,
    UnreadableImageError,
)
from topoloc.apps.cli.output import UsageError, print_line, progress_bar, write_text
from topoloc.apps.core_names import RigFrame, format_length
from topoloc.apps.formats.rig import open_instants


@dataclass(frozen=True, eq=False)
class RigAnswer:
    """Hold an instant and its result."""

    query: str
    t_ns: int
    result: RigLocalization | RigNotLocalized
    milliseconds: float

    def to_json(self) -> dict[str, Any]:
        return self.result.to_json(self.query) | {"times_ms": {"total": self.milliseconds}}

    def __str__(self) -> str:
        """Return one readable line."""
        result, ms = self.result, f"  {self.milliseconds:.0f} ms"
        left_out = "".join(f"; {name}: {text}" for name, text in result.left_out.items())
        if isinstance(result, RigNotLocalized):
            reason = shorten(": ".join(filter(None, (result.reason, result.detail))), 160)
            return f"{self.query}  not localized: {reason}{left_out}{ms}"
        x, y, z = result.world_from_rig.translation
        w, i, j, k = result.world_from_rig.quat_wxyz()
        sigmas = f"{format_length(result.position_sigma_m)} {result.rotation_sigma_deg:.2f} deg"
        tile = "" if result.tile is None else f"  tile {result.tile}"
        return (
            f"{self.query}  rig at {x:.3f} {y:.3f} {z:.3f} m, quat wxyz {w:.4f} {i:.4f} {j:.4f}"
            f" {k:.4f}  p {result.probability:.2f}  sigma {sigmas}{tile}  by"
            f" {', '.join(result.used)}{left_out}{ms}"
        )


def localize_rigs(
    localizer: Localizer, paths: Sequence[str], rig_file: str | None, json_file: str | None
) -> list[RigAnswer]:
    """Localize all instants and print a line for each, JSON if the file is "-".

    Raises:
        UsageError: there is no input.
        QueryError: an image has another size than its camera.
    """
    if not paths:
        raise UsageError("--rig takes folders with one recording for each camera, or panoramas")
    walks = [open_instants(path, rig_file) for path in paths]
    total = sum(map(len, walks))
    answers = list[RigAnswer]()
    with progress_bar() as progress:
        for answer in (one for walk in walks for one in _answers(localizer, walk)):
            answers.append(answer)
            print_line(json.dumps(answer.to_json()) if json_file == "-" else str(answer))
            progress("queries", len(answers), total)
    return answers


def write_rig_answers(answers: Sequence[RigAnswer], json_file: str | None, tum: str | None) -> None:
    """Write the results (JSON lines) and the poses of the rig (TUM format)."""
    if json_file is not None and json_file != "-":
        write_text(Path(json_file), "".join(json.dumps(a.to_json()) + "\n" for a in answers))
    if tum is not None:
        results = [answer.result for answer in answers]
        found = [
            one.world_from_rig if isinstance(one, RigLocalization) else None for one in results
        ]
        poses = Trajectory.of_frames(found, [answer.t_ns for answer in answers])
        poses.write_tum(Path(tum), are_answers=True)


def _answers(localizer: Localizer, instants: StereoSequence) -> Iterator[RigAnswer]:
    for row, (name, t_ns) in enumerate(zip(instants.names, instants.t_ns, strict=True)):
        start = time.perf_counter()
        try:
            frame = instants[row]
            assert isinstance(frame, RigFrame)
            result = RigLocalizer(localizer, frame.mounted).localize(frame.images)
        except UnreadableImageError as error:
            result = RigNotLocalized("unreadable", str(error), {})
        except QueryError as error:
            raise QueryError(f"{name}: {error}") from error
        yield RigAnswer(name, t_ns, result, 1e3 * (time.perf_counter() - start))
