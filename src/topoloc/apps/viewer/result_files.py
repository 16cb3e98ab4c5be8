"""Files of results as what a scene shows of them: answers one a line, evaluations, trajectories."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from topoloc import Localization, NotLocalized, ResultError, read_trajectory, result_from_json
from topoloc.apps.viewer.document import ResultSet
from topoloc.plugin import pose_from_json, pose_to_json, read_text


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


def parse_result(
    line: str | Mapping[str, Any],
) -> tuple[Localization | NotLocalized, Mapping[str, Any]]:
    """Return the result that a JSON line holds, and all keys of the line. Raises ResultError."""
    result = result_from_json(line)
    return result, json.loads(line) if isinstance(line, str) else line


def text_of(data: Mapping[str, Any], key: str) -> str:
    """Return the text of a key, "" if it is missing. Raises ResultError if it is no text."""
    value = data.get(key, "")
    if not isinstance(value, str):
        raise ResultError(f"no result: {key!r} is no text")
    return value


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
        result, data = parse_result(line)
        answer = result.to_json(text_of(data, "query"))
        for key in ("smoothed", "true_world_from_cam"):
            if key in data:
                answer[key] = (
                    None if data[key] is None else pose_to_json(pose_from_json(data[key], key))
                )
        for key in ("state", "recording"):
            if key in data:
                answer[key] = text_of(data, key)
    except ResultError as error:
        raise ResultError(f"{where}: {error}") from None
    return answer
