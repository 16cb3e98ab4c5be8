"""topoloc demo: the whole pipeline on the built-in lab."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import (
    EvaluatedQuery,
    Evaluation,
    Localization,
    Localizer,
    MissingExtraError,
    StereoSequence,
    TopolocError,
    TopoMetricMap,
    Trajectory,
    build_map,
    localize_out_of_map,
    localize_queries,
    open_sequence,
)
from topoloc.apps.cli.output import (
    File,
    UsageError,
    check_outputs,
    import_report_writer,
    option,
    print_recordings,
    progress_bar,
    write_json,
)
from topoloc.demo.recordings import (
    PAPER_LAB,
    ROLES,
    SHIPPED,
    Role,
    create_report_texts,
    describe_night,
    find_missing_recordings,
)
from topoloc.plugin import write_text

Progress = Callable[[str, int, int], None]
OUT_OF_MAP = "elsewhere"


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc demo`."""

    out: Annotated[str, tyro.conf.arg(metavar="DIR")] = "topoloc-demo"
    """Output folder of map, results, trajectories and report.html."""
    recordings: Annotated[str | None, option("DIR", "the shipped ones")] = None
    """Recordings of `topoloc simulate demo` instead of the shipped ones."""
    json: File = None
    """Write the evaluation as JSON to this file (- for standard output)."""

    def run(self) -> int:
        start, out = time.perf_counter(), _create_folder(Path(self.out))
        check_outputs(
            [str(out / "lab.topo"), str(out / "results.jsonl"), str(out / "report.html"), self.json]
        )
        with progress_bar() as progress:
            folder = self._find_recordings()
            topomap = _build_lab_map(folder, out / "lab.topo", progress)
            mapped, answers = time.perf_counter(), _localize_queries(topomap, folder, progress)
        evaluation = Evaluation(answers).to_json() | {"map": topomap.describe(out / "lab.topo")}
        _write_results(out, folder, answers)
        try:
            import_report_writer()(
                out / "report.html", evaluation, answers, topomap, create_report_texts(evaluation)
            )
            report = str(out / "report.html")
        except MissingExtraError as missing:
            report = f"none; {missing}"
        write_json(self.json, evaluation | {"answers": [answer.to_json() for answer in answers]})
        if self.json != "-":
            end = time.perf_counter()
            seconds = f"{end - start:.0f} s in all, {mapped - start:.0f} s of them for the map"
            _print(out, evaluation, seconds, report)
        return 0

    def _find_recordings(self) -> Path:
        """Return the folder of the recordings. Raises TopolocError if some are missing."""
        folder = Path(self.recordings) if self.recordings else SHIPPED
        if not folder.is_dir():
            raise TopolocError(
                f"{folder}: no such folder; `topoloc simulate demo {folder}` renders the recordings"
                " into it"
            )
        if missing := find_missing_recordings(folder):
            place = "this installation of topoloc" if folder == SHIPPED else folder
            raise TopolocError(
                f"{place} lacks recordings ({', '.join(missing)}); `topoloc simulate demo DIR`"
                " renders them"
            )
        return folder


def _create_folder(folder: Path) -> Path:
    if not folder.name and not folder.is_dir():
        raise UsageError("--out names no folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise TopolocError(f"cannot write {folder}: it is a file") from None
    except OSError as error:
        raise TopolocError(f"cannot write {folder}: {error.strerror}") from error
    return folder


def _open(folder: Path, role: Role) -> list[StereoSequence]:
    return [open_sequence(folder / name) for name, its_role in ROLES.items() if its_role == role]


def _build_lab_map(folder: Path, path: Path, progress: Progress) -> TopoMetricMap:
    """Build and save the map, and open it from its file."""
    build_map(_open(folder, "map"), progress=progress).save(path)
    return TopoMetricMap.load(path)


def _localize_queries(
    topomap: TopoMetricMap, folder: Path, progress: Progress
) -> list[EvaluatedQuery]:
    """Localize all queries of the lab, then all out-of-map images."""
    localizer = Localizer(topomap)
    answers: list[EvaluatedQuery] = []
    for sequence in _open(folder, "queries"):
        answers += localize_queries(localizer, sequence, progress=progress, label=_label(sequence))
    for sequence in _open(folder, "elsewhere"):
        answers += localize_out_of_map(localizer, sequence, progress, OUT_OF_MAP)
    return answers


def _label(sequence: StereoSequence) -> str:
    return sequence.name.replace("_", " ")


def _write_results(out: Path, folder: Path, answers: list[EvaluatedQuery]) -> None:
    """Write one JSON line for each query, and the poses of each recording as a trajectory."""
    lines = [json.dumps(a.result.to_json(f"{a.recording}/{a.query}")) for a in answers]
    write_text(out / "results.jsonl", "\n".join(lines) + "\n")
    groups = Evaluation(answers).by_recording
    for sequence in _open(folder, "queries"):
        t_ns = dict(zip(sequence.names, sequence.t_ns, strict=True))
        group = groups[_label(sequence)]
        results = [a.result for a in group]
        poses = [one.world_from_cam if isinstance(one, Localization) else None for one in results]
        trajectory = Trajectory.of_frames(poses, [t_ns[a.query] for a in group])
        trajectory.write_tum(out / f"{sequence.name}.tum", are_answers=True)


def _print(out: Path, evaluation: dict[str, Any], seconds: str, report: str) -> None:
    print_recordings(evaluation, [PAPER_LAB])
    m = evaluation["map"]
    print(f"\n{describe_night(evaluation)}\n")
    print(
        f"map: {out / 'lab.topo'} ({m['num_nodes']} nodes, {m['bytes'] / 1e6:.1f} MB,"
        f" {m['length_m']:.1f} m mapped; {seconds})"
    )
    print(f"poses: {out / 'results.jsonl'}, and a .tum file for each recording beside it")
    print(f"report: {report}")
