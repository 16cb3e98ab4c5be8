"""A child process that opens maps as users do: asks each about one picture, then looks at every
byte. Prints a line a map, in JSON.

python tests/map/opening.py PICTURE.npy CAMERA.json MAP ...
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from topoloc.errors import TopolocError
from topoloc.geometry.camera import Camera
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.contradictions import find_contradictions
from topoloc.mapping.storage.integrity_check import find_map_damage
from topoloc.mapping.topomap import TopoMetricMap


def main() -> None:
    picture, camera = (
        np.load(sys.argv[1]),
        Camera.from_json(json.loads(Path(sys.argv[2]).read_text())),
    )
    for path in map(Path, sys.argv[3:]):
        start, outcome = time.process_time(), []
        for use in (
            lambda path=path: _asked(path, picture, camera),
            lambda path=path: _checked(path),
        ):
            try:
                outcome.append(use())
            except TopolocError as error:
                outcome.append(f"{type(error).__name__}: {error}")
        told = {
            "map": str(path),
            "outcome": outcome,
            "seconds": time.process_time() - start,
            "rss_kb": _peak_kb(),
        }
        print(json.dumps(told), flush=True)


def _peak_kb() -> int:
    """The most memory that this program has held; `getrusage` would count what its parent held when
    it was started."""
    fields = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(fields["VmHWM"].split()[0])


def _asked(path: Path, picture: np.ndarray, camera: Camera) -> str:
    with TopoMetricMap.load(path) as topomap:
        localizer = Localizer(topomap)
        return type(localizer.localize(picture, camera)).__name__


def _checked(path: Path) -> str:
    found = find_map_damage(path)
    if not found:
        with TopoMetricMap.load(path) as topomap:
            found = [str(contradiction) for contradiction in find_contradictions(topomap)]
    return found[0] if found else "ok"


if __name__ == "__main__":
    main()
