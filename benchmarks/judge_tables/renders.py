"""Name the rendered recordings of `make judge`, and render them once.

Seeds 1 to 3 only: other seeds are kept apart, for a judgement after the last change.
"""

from __future__ import annotations

import hashlib
import sys
import threading
from pathlib import Path

from acceptance_jobs.workplace import ROOT, JobError, last_line, run

_TIMEOUT_S = 3000.0
_QUERY = ("--mono", "--draft", "--lateral", 0.3, "--take", 2)
_OTHER_LANE = ("--mono", "--draft", "--lateral", 3.5, "--take", 2, "--spacing", 1.5)
_LOCK = threading.Lock()

RENDERS: dict[str, tuple[object, ...]] = {
    "corridor1_map": ("corridor", "--seed", 1, "--draft", "--spacing", 0.3),
    "corridor2_map": ("corridor", "--seed", 2, "--draft", "--spacing", 0.3, "--num-frames", 60),
    "corridor3_day": ("corridor", "--seed", 3, *_QUERY, "--spacing", 1.2),
    "corridor1_reverse": ("corridor", "--seed", 1, *_QUERY, "--reverse", "--spacing", 1.6),
    "street1_map": ("street", "--seed", 1, "--draft", "--spacing", 1.2, "--num-frames", 50),
    "street2_map": ("street", "--seed", 2, "--draft", "--spacing", 1.2, "--num-frames", 50),
    "hospital1_map": ("hospital", "--seed", 1, "--draft", "--spacing", 0.3, "--num-frames", 100),
    "hospital1_query": (
        *("hospital", "--seed", 1, "--draft", "--mono", "--take", 1),
        *("--lateral", 0.15, "--spacing", 0.45, "--num-frames", 50),
    ),
}
for _light in ("day", "evening", "night"):
    RENDERS[f"corridor1_{_light}"] = (
        *("corridor", "--seed", 1, *_QUERY, "--condition", _light, "--spacing", 0.9),
    )
for _light in ("day", "night"):
    RENDERS[f"corridor2_{_light}"] = (
        *("corridor", "--seed", 2, *_QUERY, "--condition", _light),
        *("--spacing", 0.6, "--num-frames", 28),
    )
for _degrees in (20, 40, 60):
    RENDERS[f"corridor1_aside{_degrees}"] = (
        *("corridor", "--seed", 1, *_QUERY, "--look", _degrees, "--spacing", 1.35),
    )
for _seed, _lights in ((1, ("clear", "cloudy", "rain")), (2, ("clear", "rain"))):
    for _light in _lights:
        RENDERS[f"street{_seed}_{_light}"] = (
            *("street", "--seed", _seed, *_OTHER_LANE),
            *("--condition", _light, "--num-frames", 40),
        )


def render(name: str, work: Path) -> Path:
    """Return a rendered recording, made once; an interrupted one goes on.

    Raises:
        JobError: It could not be rendered.
    """
    words = RENDERS[name]
    digest = hashlib.sha256(repr(words).encode()).hexdigest()[:8]
    folder = work / "renders" / f"{name}-{digest}"
    with _LOCK:  # one renderer uses both cores
        if not (folder / "done").exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            command = [sys.executable, "-m", "topoloc", "simulate", words[0], folder, *words[1:]]
            code, out, err = run(command, work, ROOT, _TIMEOUT_S)
            if code != 0:
                raise JobError(f"{name}: {last_line(err) or last_line(out)}")
            (folder / "done").touch()
    return folder
