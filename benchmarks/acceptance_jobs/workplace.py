"""Run commands for a job, in a temporary folder, and find its recordings and maps."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("src", "worlds/src", "training/src", "paper/src")
FIXTURES = ROOT / "tests" / "fixtures" / "aea690a"

# The recordings from which the maps of all jobs are built: below ../shared/data, and of the demo.
MAPS = {
    "lab": ("demo:map_lap1", ()),
    "zed": ("zed_lab/session1", ()),
    "kitchen": ("seven_scenes/kitchen@0::2", ()),
    "kitchen60": ("seven_scenes/kitchen@0-59/100", ()),
    "street1": ("kitti/sequences/street1@0::2", ()),
    "street2": ("kitti/sequences/street2@0::2", ()),
}

# Two jobs that run at the same time may need one map.
_LOCKS = {name: threading.Lock() for name in (*MAPS, "demo")}


class JobError(Exception):
    """A command of a job failed. The text is its last line."""


class SkippedError(Exception):
    """A prerequisite of a job is missing. The text names it."""


def environment(tree: Path = ROOT) -> dict[str, str]:
    """Return the environment in which Python imports the packages of a source tree."""
    folders = [str(tree / folder) for folder in SOURCES if (tree / folder).is_dir()]
    return os.environ | {"PYTHONPATH": os.pathsep.join(folders), "SOURCE_DATE_EPOCH": "1760000000"}


def run(
    words: Iterable[object],
    folder: Path,
    tree: Path = ROOT,
    timeout: float = 300,
    more: Mapping[str, str] | None = None,
) -> tuple[int, str, str]:
    """Return exit status, standard output and standard error of a program.

    Raises:
        JobError: The program did not end in time. It and its children are then killed.
    """
    command, env = [str(word) for word in words], environment(tree) | dict(more or {})
    process = subprocess.Popen(
        command,
        cwd=folder,
        env=env,
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        raise JobError(f"no end after {timeout:.0f} s: {' '.join(command[:6])}") from None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return process.returncode, out, err


def last_line(text: str) -> str:
    """Return the last line that is not empty."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""


def need_module(*names: str) -> None:
    """Skip if a package is not installed.

    Raises:
        SkippedError: A package is missing.
    """
    for name in names:
        if importlib.util.find_spec(name) is None:
            raise SkippedError(f"{name} is not installed")


@dataclass
class Workplace:
    """Give a job its own folder, and all jobs the maps that they only read."""

    folder: Path
    maps: Path
    shared: Path
    quick: bool
    equal_to: str
    cache: Path
    tree: Path = ROOT
    _known: dict[str, Path] = field(default_factory=dict)

    def job_folder(self) -> Workplace:
        """Return the workplace of one job, with a new folder."""
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        return Workplace(
            folder, self.maps, self.shared, self.quick, self.equal_to, self.cache, self.tree
        )

    def python(self, *words: object, timeout: float = 300, status: int | None = 0) -> str:
        """Return the standard output of this Python with some arguments.

        Raises:
            JobError: The exit status is another one (None: any), or a traceback was printed.
        """
        code, out, err = run([sys.executable, *words], self.folder, self.tree, timeout)
        if "Traceback (most recent call last)" in err:
            raise JobError(f"traceback: {last_line(err)}")
        if status is not None and code != status:
            raise JobError(f"exit status {code}: {last_line(err) or last_line(out)}")
        return out

    def topoloc(self, *words: object, timeout: float = 300, status: int | None = 0) -> str:
        """Return the standard output of a command of topoloc."""
        return self.python("-m", "topoloc", *words, timeout=timeout, status=status)

    def answer(self, *words: object, timeout: float = 300) -> Any:
        """Return the JSON of a command with `--json`: an object, or a list of the lines."""
        path = self.folder / "answer.json"
        path.unlink(missing_ok=True)
        self.topoloc(*words, "--json", path, timeout=timeout)
        text = path.read_text(encoding="utf-8")
        return read_lines(path) if words[0] == "localize" else json.loads(text)

    def data(self, name: str) -> str:
        """Return the path of a real recording, with its frames chosen as `PATH@0::2`.

        Raises:
            SkippedError: The recordings are not on this machine.
        """
        path, at, frames = name.partition("@")
        if not (self.shared / "data" / path).exists():
            raise SkippedError(f"no {path} in {self.shared / 'data'} (set TOPOLOC_SHARED)")
        return f"{self.shared / 'data' / path}{at}{frames}"

    def lab(self, name: str) -> Path:
        """Return a recording of the demo's lab, a copy outside of the package."""
        copy = self.maps / "demo"
        with _LOCKS["demo"]:
            if not copy.exists():
                found = sorted((ROOT / "src").rglob("map_lap1"))
                if not found:
                    raise SkippedError("the recordings of the demo are missing")
                shutil.copytree(found[0].parent, copy)
        return copy / name

    def map(self, name: str) -> Path:
        """Return a map that no job changes; build it first if it is not there."""
        path = self.maps / f"{name}.topo"
        with _LOCKS[name]:
            if not path.exists():
                recording, options = MAPS[name]
                kind, _, lab = recording.partition(":")
                source = self.lab(lab) if kind == "demo" else self.data(recording)
                self.topoloc("build", source, path, *options)
        return path

    def own_map(self, name: str) -> Path:
        """Return a copy of a map, to be changed."""
        return Path(shutil.copy(self.map(name), self.folder / f"{name}.topo"))


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file of JSON lines."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
