"""topoloc demo: the whole pipeline on the built-in world."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc.cli.info import describe_map
from topoloc.cli.output import UsageError, check_outputs, interruptible, progress_bar, write_json
from topoloc.cli.recordings_table import print_recordings
from topoloc.errors import TopolocError
from topoloc.evaluation.experiments import answer_elsewhere, answer_queries
from topoloc.evaluation.metrics import Answer, by_recording, summarize
from topoloc.localization.building import build_map
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.sequences.atomic import write_text
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.open import open_sequence
from topoloc.sequences.trajectory import Trajectory, write_tum
from topoloc.simulation.demo_recordings import RECORDINGS, SHIPPED, Role, draw_pictures_of_nothing, missing_recordings, render_recordings

Progress = Callable[[str, int, int], None]
ELSEWHERE = "elsewhere"


@dataclass(frozen=True)
class Command:
    """What `topoloc demo` takes."""

    out: Annotated[str, tyro.conf.arg(metavar="DIR")] = "topoloc-demo"
    """Where map, results, trajectories and report.html are written."""
    render: bool = False
    """Render the recordings anew, with Mitsuba (the extra `sim`), instead of taking those that topoloc brings along."""
    recordings: Annotated[str | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="(default: those that topoloc brings along)")] = None
    """Take the recordings from here; with --render, render them into here."""
    json: Annotated[str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the evaluation as JSON to this file (- for standard output)."""

    def run(self) -> int:
        from topoloc.cli.demo_words import words_of  # loads matplotlib, which --help need not
        from topoloc.evaluation.report import write_report

        start = time.perf_counter()
        out = _made_folder(Path(self.out))
        check_outputs([str(out / "lab.topo"), str(out / "results.jsonl"), str(out / "report.html"), self.json])
        with progress_bar() as progress:
            folder = self._recordings(out, progress)
            topomap = _map_the_lab(folder, out / "lab.topo", progress)
            mapped = time.perf_counter()
            answers = _ask(topomap, folder, out, progress)
        evaluation = summarize(answers) | {"map": describe_map(topomap, out / "lab.topo")}
        _write_results(out, folder, answers)
        write_report(out / "report.html", evaluation, answers, topomap, words_of(evaluation))
        write_json(self.json, evaluation)
        if self.json != "-":
            seconds = f"{time.perf_counter() - start:.0f} s in all, {mapped - start:.0f} s of them until the map was there"
            _print(out, evaluation, seconds)
        return 0

    def _recordings(self, out: Path, progress: Progress) -> Path:
        """The folder of the recordings, rendered now if that is asked for."""
        if self.render:
            folder = Path(self.recordings) if self.recordings else out / "recordings"
            try:
                with interruptible():
                    render_recordings(folder, progress)
            except KeyboardInterrupt:
                raise TopolocError(f"interrupted; the same command goes on from what is in {folder}") from None
            return folder
        folder = Path(self.recordings) if self.recordings else SHIPPED
        if self.recordings and not folder.is_dir():
            raise TopolocError(f"{folder}: no such folder; with --render the recordings are rendered into it")
        if missing := missing_recordings(folder):
            what = "this installation of topoloc lacks the demo's recordings" if folder == SHIPPED else f"{folder} lacks recordings"
            raise TopolocError(f"{what} ({', '.join(missing)}); `topoloc demo --render` renders them, with Mitsuba (the extra `sim`)")
        return folder


def _made_folder(folder: Path) -> Path:
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
    return [open_sequence(folder / recording.name) for recording in RECORDINGS if recording.role == role]


def _map_the_lab(folder: Path, path: Path, progress: Progress) -> TopoMetricMap:
    """Build the map and open it from its file, as everybody else will."""
    build_map(_open(folder, "map"), progress=progress).save(path)
    return TopoMetricMap.load(path)


def _ask(topomap: TopoMetricMap, folder: Path, out: Path, progress: Progress) -> list[Answer]:
    """Every query of the lab, then every picture of somewhere else."""
    localizer = Localizer(topomap)
    answers: list[Answer] = []
    for sequence in _open(folder, "queries"):
        answers += answer_queries(localizer, sequence, progress=progress, label=_label(sequence))
    nothing = out / "pictures_of_nothing"
    draw_pictures_of_nothing(nothing)
    for sequence in [*_open(folder, "elsewhere"), open_sequence(nothing)]:
        answers += answer_elsewhere(localizer, sequence, progress, ELSEWHERE)
    return answers


def _label(sequence: StereoSequence) -> str:
    return sequence.name.replace("_", " ")


def _write_results(out: Path, folder: Path, answers: Sequence[Answer]) -> None:
    """One JSON line a query, and the poses found in each recording as a trajectory."""
    lines = [json.dumps(a.result.to_json(f"{a.recording}/{a.query}")) for a in answers]
    write_text(out / "results.jsonl", "\n".join(lines) + "\n")
    groups = by_recording(answers)
    for sequence in _open(folder, "queries"):
        t_ns = dict(zip(sequence.names, sequence.t_ns, strict=True))
        found = [(t_ns[a.query], a.result.world_from_cam) for a in groups[_label(sequence)] if isinstance(a.result, Localization)]
        write_tum(out / f"{sequence.name}.tum", Trajectory([pose for _, pose in found], [t for t, _ in found]))


def _print(out: Path, evaluation: dict[str, Any], seconds: str) -> None:
    from topoloc.cli.demo_words import PAPER_LAB, night_in_words

    print_recordings(evaluation, [PAPER_LAB])
    m = evaluation["map"]
    print(f"\n{night_in_words(evaluation)}\n")
    print(f"map: {out / 'lab.topo'} ({m['num_nodes']} nodes, {m['bytes'] / 1e6:.1f} MB, {m['length_m']:.1f} m mapped; {seconds})")
    print(f"poses: {out / 'results.jsonl'}, and a .tum file for each recording beside it")
    print(f"report: {out / 'report.html'}")
