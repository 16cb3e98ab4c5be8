"""Read result files for display or export: result lines, evaluations and trajectories."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from msgspec import UNSET, Struct, UnsetType, to_builtins

from topoloc import (
    Localization,
    NotLocalized,
    ResultError,
    Rigid3,
    Trajectory,
    TrajectoryError,
    result_from_json,
)
from topoloc.apps.viewer.document import ResultSet
from topoloc.apps.viewer.scene import Points, Scene, View
from topoloc.plugin import decode_json, read_text


def read_results(path: Path) -> list[ResultSet]:
    """Read the lines of `topoloc localize --json`, the results of `topoloc evaluate --json` by
    recording, or a trajectory (TUM, KITTI). Raises ResultError: the file is missing or of another
    kind. The text names the line; TrajectoryError: the trajectory is malformed."""
    text = read_text(path, ResultError)
    if not text.lstrip().startswith("{"):
        return [ResultSet(path.stem, path=Trajectory.read(path).world_from_cam)]
    whole = _parse_single_object(text)
    if whole is not None and "localized" not in whole:
        return _read_evaluation(path, whole)
    lines = [(f"{path}, line 1", whole)] if whole else _number_lines(path, text)
    return [ResultSet(path.stem, [_answer_to_json(place, line) for place, line in lines])]


def create_results_scene(path: Path) -> Scene:
    """Return the localized images of a result file as a scene. Raises ResultError: the file is
    missing, a line is no result, or none has a pose. The text names the line."""
    views, count = list[View](), 0
    for place, line in _number_lines(path, read_text(path, ResultError)):
        count += 1
        with ResultError.at(place):
            result, extras = _parse_result(line)
        if isinstance(result, Localization):
            t_ns, camera = result.provenance.t_ns, result.provenance.camera
            views.append(
                View(extras.query, result.world_from_cam, t_ns, camera, geopose=result.geopose)
            )
    if not views:
        raise ResultError(f"{path}: none of {count} results has a pose")
    return Scene(path.stem, views, Points.none(), [view.world_from_cam for view in views])


def _number_lines(path: Path, text: str) -> Iterator[tuple[str, str]]:
    """Yield the lines that are not empty, with their places for errors."""
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            yield f"{path}, line {number}", line


class _ResultExtras(Struct, frozen=True):
    """Keys of a JSON line that evaluations and streams add to a result."""

    query: str = ""
    state: str | UnsetType = UNSET
    recording: str | UnsetType = UNSET
    smoothed: dict[str, Any] | UnsetType | None = UNSET
    true_world_from_cam: dict[str, Any] | UnsetType | None = UNSET


def _parse_result(
    line: str | Mapping[str, Any],
) -> tuple[Localization | NotLocalized, _ResultExtras]:
    """Return the result of a JSON line, and its further keys. Raises ResultError."""
    return result_from_json(line), decode_json(line, _ResultExtras, ResultError, "no result")


def _parse_single_object(text: str) -> Mapping[str, Any] | None:
    """Return the only object of a file, None if there are several."""
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


def _answer_to_json(place: str, line: Any) -> Mapping[str, Any]:
    """Return a result as JSON with its validated keys only, because it goes into a page."""
    with ResultError.at(place, ResultError, TrajectoryError):
        result, extras = _parse_result(line)
        answer = result.to_json(extras.query) | to_builtins(extras)
        for key in ("smoothed", "true_world_from_cam"):
            if answer.get(key) is not None:
                answer[key] = Rigid3.from_json(answer[key], key).to_json()
    return answer
