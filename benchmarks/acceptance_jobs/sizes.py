"""Measure start-up times, memory and sizes."""

from __future__ import annotations

import json
import re
import statistics
import sys
import time
import zipfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from .figures import Figure, rounded
from .workplace import ROOT, Workplace, need_module, run


def size(work: Workplace) -> Iterator[Figure]:
    """Measure the import, `topoloc --help`, the memory of queries, the wheel, the installation."""
    empty = _seconds(work, "-c", "pass")
    imported = _seconds(work, "-c", "import topoloc") - empty
    helped = _seconds(work, "-m", "topoloc", "--help")
    yield Figure("import topoloc over the start of Python", rounded(imported / empty, 2), "time")
    yield Figure("topoloc --help over the start of Python", rounded(helped / empty, 2), "time")
    script = Path(__file__).with_name("query_times.py")
    words = (script, work.map("zed"), work.data("zed_lab/session2@0:20"), 20)
    memory = json.loads(work.python(*words))["memory_mb"]
    yield Figure("memory of a query process, MB", round(memory), "median")
    yield from _installed(work)


def _seconds(work: Workplace, *words: object) -> float:
    """Return the median time of a few runs of this Python."""
    seconds = []
    for _ in range(7):
        start = time.perf_counter()
        work.python(*words)
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def _installed(work: Workplace) -> Iterator[Figure]:
    """Build the wheel; add the files of all packages that it requires, as installed here."""
    need_module("build", "hatchling")
    words = ["-m", "build", "--wheel", "--no-isolation", "--outdir", work.folder, ROOT]
    run([sys.executable, *words], work.folder, timeout=200)
    (wheel,) = work.folder.glob("topoloc-*.whl")
    yield Figure("wheel, MB", rounded(wheel.stat().st_size / 1e6, 3), "median")
    with zipfile.ZipFile(wheel) as archive:
        own = sum(entry.file_size for entry in archive.infolist())
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    block = re.search(r"^dependencies = \[(.*?)\]", text, re.MULTILINE | re.DOTALL)
    names = re.findall(r'"([A-Za-z0-9_.-]+)', block.group(1)) if block else []
    packages = _with_requirements(names)
    total = own + sum(_bytes(name) for name in packages)
    yield Figure("installed, MB", round(total / 1e6), "median")


def _with_requirements(names: list[str]) -> set[str]:
    """Return the packages and, of those, all that they require without extras."""
    found: set[str] = set()
    waiting = [_normal(name) for name in names]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        try:
            required = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # a requirement of another platform
        found.add(name)
        plain = [text for text in required if "extra ==" not in text]
        waiting += [_normal(re.split(r"[^A-Za-z0-9_.-]", text)[0]) for text in plain]
    return found


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _bytes(name: str) -> int:
    files = metadata.files(name) or []
    paths = [Path(str(path.locate())) for path in files if "__pycache__" not in path.parts]
    return sum(path.stat().st_size for path in paths if path.is_file())
