"""topoloc evaluate MAP SEQ [SEQ ...]."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc.cli.info import describe_map
from topoloc.cli.output import progress_bar, write_json
from topoloc.errors import TopolocError, TrajectoryError
from topoloc.evaluation.experiments import answer_elsewhere, answer_queries
from topoloc.evaluation.metrics import Answer, summarize
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.sequences.open import open_sequence


@dataclass(frozen=True)
class Command:
    """What `topoloc evaluate` takes."""

    map: tyro.conf.Positional[str]
    """The map file."""
    sequences: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="SEQ ...")]
    """Recordings with known truth. PATH@1::2 takes every second frame of PATH, from the second on."""
    elsewhere: tuple[str, ...] = ()
    """Recordings of other places: every pose given for one of their images counts as a false accept."""
    map_from_truth: str | None = None
    """A JSON file with the 4x4 matrix (metres) that takes the world of the recordings' truth into the map's, where they differ."""
    coarse: str = "surf-vlad"
    """Which of the map's coarse localizers is asked."""
    format: str | None = None
    """The recordings' format, where it is not recognised by itself."""
    json: str | None = None
    """Write the evaluation as JSON to this file (- for standard output)."""
    report: str | None = None
    """Write a page with the table, the top-down map, the error curves and the worst queries to this file (report.html)."""
    config: LocalizerConfig = field(default_factory=LocalizerConfig)

    def run(self) -> int:
        if not self.sequences and not self.elsewhere:
            raise TopolocError("evaluate takes a map and at least one recording")
        topomap = TopoMetricMap.load(self.map)
        localizer = Localizer(topomap, replace(self.config, coarse=self.coarse))
        map_from_truth = _read_rigid(Path(self.map_from_truth)) if self.map_from_truth else None
        answers: list[Answer] = []
        with progress_bar() as progress:
            for path in self.sequences:
                answers += answer_queries(localizer, open_sequence(path, self.format), map_from_truth, progress)
            for path in self.elsewhere:
                answers += answer_elsewhere(localizer, open_sequence(path, self.format), progress)
        info = describe_map(topomap, Path(self.map))
        evaluation = summarize(answers) | {"map": info}
        if self.json != "-":
            _print(evaluation)
        write_json(self.json, evaluation)
        if self.report:
            from topoloc.evaluation.report import write_report

            write_report(Path(self.report), evaluation, answers, topomap)
            print(f"report: {self.report}")
        return 0


def _read_rigid(path: Path) -> Rigid3:
    """A 4x4 matrix, alone or as the only matrix of a JSON object."""
    try:
        data: Any = json.loads(path.read_text())
    except OSError as error:
        raise TrajectoryError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise TrajectoryError(f"{path}: not JSON ({error})") from None
    matrices = [value for value in data.values() if isinstance(value, list)] if isinstance(data, dict) else [data]
    try:
        (matrix,) = matrices
        return Rigid3.from_matrix(np.array(matrix, dtype=np.float64))
    except (ValueError, TypeError):
        raise TrajectoryError(f"{path}: one 4x4 matrix is needed") from None


def _print(evaluation: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None)
    e = evaluation
    if e["num_queries"]:
        table.add_row("localized", f"{e['num_localized']} of {e['num_queries']} ({100 * e['num_localized'] / e['num_queries']:.1f} %)")
    if e["num_localized"]:
        table.add_row("median error", f"{100 * e['median_translation_m']:.2f} cm, {e['median_rotation_deg']:.3f} deg")
        table.add_row("recall", ", ".join(f"{name.replace('_', ' ')} {100 * share:.1f} %" for name, share in e["recall"].items()))
        table.add_row("nearest node named first", f"{100 * e['topological_accuracy']:.1f} %")
    elsewhere = f" (of {e['num_elsewhere']} images from elsewhere, and of the others those off by more than 0.5 m or 10 deg)"
    table.add_row("false accepts", f"{e['false_accepts']}{elsewhere}")
    if e["not_localized"]:
        table.add_row("not localized", ", ".join(f"{reason} {count}" for reason, count in e["not_localized"].items()))
    table.add_row("median ms", ", ".join(f"{stage} {ms:.1f}" for stage, ms in e["median_times_ms"].items()))
    table.add_row("map", f"{e['map']['num_nodes']} nodes, {e['map']['bytes'] / 1e6:.2f} MB, {e['map']['length_m']:.1f} m")
    Console().print(table)
