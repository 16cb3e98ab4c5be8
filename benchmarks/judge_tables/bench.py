"""Run a benchmark for a table, with the source tree that is judged."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acceptance_jobs.figures import Figure, rounded
from acceptance_jobs.workplace import ROOT, JobError, Workplace, last_line, run

from .renders import render

_TIMEOUT_S = 3000.0
RULES = {
    "localized": "at least",
    "right": "at least",
    "named": "at least",
    "measured": "at least",
    "inside": "at least",
    "ambiguous": "at least",
    "wrong": "at most",
    "accepted": "at most",
    "accused": "at most",
    "lost": "at most",
    "median_cm": "median",
    "median_deg": "median",
}
"""Rules by the name of a column. Other columns are notes, never worse."""
SLACK = {"inside": 2}
"""Counts that may be fewer by so many."""


@dataclass(frozen=True)
class Bench:
    """Hold the folder of cached renders and maps, the recordings, and the source tree."""

    work: Path
    shared: Path
    tree: Path
    digest: str
    _locks: dict[str, threading.Lock] = field(default_factory=dict)

    def data(self, name: str) -> str:
        """Return a real recording, a file beside them, or one of the demo (`demo:NAME`)."""
        if name.startswith("demo:"):
            return str(ROOT / "src/topoloc/demo/lab" / name.removeprefix("demo:"))
        return str(self.shared.resolve() / "data" / name)

    def render(self, name: str) -> Path:
        """Return a rendered recording."""
        return render(name, self.work)

    def map(self, name: str, recording: object, *options: object) -> Path:
        """Return a map by the source tree, built once."""
        built = f"{name}-{_short((str(recording), options))}"
        path = self.work / "maps" / f"{built}-{self.digest}.topo"
        with self._locks.setdefault(built, threading.Lock()):
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                self.topoloc("build", recording, path, *options)
        return path

    def topoloc(self, *words: object) -> None:
        """Run a command of topoloc. Raises JobError: it failed."""
        self._run("-m", "topoloc", *words)

    def script(self, name: str, *words: object) -> Any:
        """Return the JSON file that a benchmark writes. Raises JobError: it wrote none."""
        path = self.folder() / f"{name}-{_short(words)}.json"
        path.unlink(missing_ok=True)
        self._run(ROOT / "benchmarks" / f"{name}.py", *words, "--json", path)
        return json.loads(path.read_text(encoding="utf-8"))

    def plain(self, name: str, *words: object) -> None:
        """Run a benchmark that writes no figures. Raises JobError: it failed."""
        self._run(ROOT / "benchmarks" / f"{name}.py", *words)

    def folder(self) -> Path:
        """Return the folder of this source tree's files."""
        path = self.work / "runs" / self.digest
        path.mkdir(parents=True, exist_ok=True)
        return path

    def workplace(self, name: str) -> Workplace:
        """Return an empty workplace for a job of `make acceptance`, with this source tree."""
        folder, maps = self.folder() / name, self.work / "maps" / self.digest
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        maps.mkdir(parents=True, exist_ok=True)
        return Workplace(folder, maps, self.shared, False, "", self.work, self.tree)

    def _run(self, *words: object) -> None:
        code, out, err = run([sys.executable, *words], self.folder(), self.tree, _TIMEOUT_S)
        if code != 0:
            script = Path(str(words[0])).name
            raise JobError(f"{script}: exit status {code}: {last_line(err) or last_line(out)}")


def figures_of(
    row: str, columns: Mapping[str, Any], rules: Mapping[str, str] | None = None, slack: int = 0
) -> list[Figure]:
    """Return the figures of a row, by `RULES` and by other rules for this table. Right answers may
    be fewer by `slack`."""
    known = RULES | dict(rules or {})
    return [
        Figure(
            f"{row}: {column}",
            rounded(value) if isinstance(value, float) else value,
            known.get(column, "note"),
            slack=SLACK.get(column, slack if known.get(column) == "at least" else 0),
        )
        for column, value in columns.items()
    ]


def digest_of(tree: Path) -> str:
    """Return a digest of the package's files, by which maps and answers are kept."""
    digest = hashlib.sha256()
    source = tree / "src" / "topoloc"
    for path in sorted(source.rglob("*")):
        if path.suffix in (".py", ".json", ".npz", ".toml", ".onnx") and path.is_file():
            digest.update(str(path.relative_to(source)).encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def _short(words: tuple[object, ...]) -> str:
    return hashlib.sha256(repr(words).encode()).hexdigest()[:8]
