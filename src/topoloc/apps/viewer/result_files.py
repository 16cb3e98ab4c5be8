"""Files of results as what a scene shows of them: answers one a line, evaluations, trajectories."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec import UNSET, Struct, UnsetType, to_builtins

from topoloc import (
    Localization,
    NotLocalized,
    ResultError,
    Rigid3,
    TrajectoryError,
    read_trajectory,
    result_from_json,
)
from topoloc.apps.viewer.document import ResultSet
from topoloc.plugin import decode_json, read_text


def read_results(path: Path) -> list[ResultSet]:
    """The JSON lines of `topoloc localize --json`, the answers of `topoloc evaluate --json` by
    recording, or a trajectory (TUM, KITTI).

    Raises:
        ResultError: the file is missing, or holds something else; names the line.
        TrajectoryError: so for a trajectory.
    """
    text = read_text(path, ResultError)
    if not text.lstrip().startswith("{"):
        return [ResultSet(path.stem, path=read_trajectory(path).world_from_cam)]
    whole = _parse_single_object(text)
    if whole is not None and "localized" not in whole:
        return _read_evaluation(path, whole)
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    return [
        ResultSet(
            path.stem,
            [
                _answer_to_json(f"{path}, line {number}", line)
                for number, line in ([(1, whole)] if whole else lines)
            ],
        )
    ]


class ResultExtras(Struct, frozen=True):
    """Hold the keys of a JSON line that evaluations and streams add to a result."""

    query: str = ""
    state: str | UnsetType = UNSET
    recording: str | UnsetType = UNSET
    smoothed: dict[str, Any] | UnsetType | None = UNSET
    true_world_from_cam: dict[str, Any] | UnsetType | None = UNSET


def parse_result(
    line: str | Mapping[str, Any],
) -> tuple[Localization | NotLocalized, ResultExtras]:
    """Return the result that a JSON line holds, and its further keys. Raises ResultError."""
    return result_from_json(line), decode_json(line, ResultExtras, ResultError, "no result")


def _parse_single_object(text: str) -> Mapping[str, Any] | None:
    """The one object of a file; None where there are several."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) else None


def _read_evaluation(path: Path, evaluation: Mapping[str, Any]) -> list[ResultSet]:
    if not isinstance(evaluation.get("answers"), list):
        raise ResultError(
            f"{path}: neither results nor an evaluation with its answers, as `topoloc evaluate"
            " --json` writes them"
        )
    sets: dict[str, list[Mapping[str, Any]]] = {}
    for number, one in enumerate(evaluation["answers"]):
        answer = _answer_to_json(f"{path}, answer {number}", one)
        sets.setdefault(str(answer.get("recording") or path.stem), []).append(answer)
    return [ResultSet(name, answers) for name, answers in sets.items()]


def _answer_to_json(where: str, line: Any) -> Mapping[str, Any]:
    """A result as JSON, held to be one: only what was understood goes into a page."""
    try:
        result, extras = parse_result(line)
        answer = result.to_json(extras.query) | to_builtins(extras)
        for key in ("smoothed", "true_world_from_cam"):
            if answer.get(key) is not None:
                answer[key] = Rigid3.from_json(answer[key], key).to_json()
    except (ResultError, TrajectoryError) as error:
        raise ResultError(f"{where}: {error}") from None
    return answer
