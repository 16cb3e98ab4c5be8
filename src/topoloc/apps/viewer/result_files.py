"""Files of results as what a scene shows of them: answers one a line, evaluations, trajectories."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from topoloc.apps.viewer.document import ResultSet
from topoloc.errors import ResultError
from topoloc.localization import checked_json as checked
from topoloc.localization.result import pose_to_json, result_from_json
from topoloc.recordings.text_files import read_text
from topoloc.recordings.trajectory import read_trajectory


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
                _parse_result(f"{path}, line {number}", line)
                for number, line in ([(1, whole)] if whole else lines)
            ],
        )
    ]


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
        answer = _parse_result(f"{path}, answer {number}", one)
        sets.setdefault(str(answer.get("recording") or path.stem), []).append(answer)
    return [ResultSet(name, answers) for name, answers in sets.items()]


def _parse_result(where: str, line: Any) -> Mapping[str, Any]:
    """A result as JSON, held to be one: only what was understood goes into a page."""
    try:
        data = checked.parse_object(line)
        answer = result_from_json(data).to_json(checked.text(data.get("query", ""), "query"))
        for key in ("smoothed", "true_world_from_cam"):
            if key in data:
                answer[key] = (
                    None if data[key] is None else pose_to_json(checked.rigid(data[key], key))
                )
        for key in ("state", "recording"):
            if key in data:
                answer[key] = checked.text(data[key], key)
    except ResultError as error:
        raise ResultError(f"{where}: {error}") from None
    return answer
