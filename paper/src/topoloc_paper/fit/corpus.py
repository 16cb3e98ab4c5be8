"""List the places to which weights are fitted: mapping recordings and queries.

The demo's lab ships with topoloc. `topoloc simulate` makes the other rendered recordings
(paper/README.md has the commands). Kitchen, ZED lab and KITTI are in `../shared/data`. A missing
recording is skipped with a message.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from topoloc.demo.recordings import SHIPPED
from topoloc.errors import RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence

FAMILIES = {
    "corridor": "corridor",
    "demo": "lab",
    "lab": "lab",
    "street": "street",
    "seven_scenes": "kitchen",
    "zed_lab": "ZED lab",
}
FAMILIES |= {"kitti": "KITTI", "drawn": "drawn"}
GAMMAS = {"as it is": None, "dark": 0.6, "darker": 1 / 0.6}
_KITCHEN, _ZED = "seven_scenes/kitchen@60-99/100", "zed_lab/session2@0:99"
_STREET_1, _STREET_2 = "kitti/sequences/street1@1::2", "kitti/sequences/street2@1::2"


@dataclass(frozen=True)
class AskedPlace:
    """Hold a mapping recording, and for each query recording the step between its queried images.

    Names that begin with `demo` ship with topoloc, those without a slash are rendered, the others
    real.
    """

    mapping: str
    own: dict[str, int]
    others: dict[str, int] = field(default_factory=dict)
    """Pictures from elsewhere; drawn ones with them."""
    is_darkened: bool = False
    map_from_truth: str | None = None
    asks_walls: bool = False


PLACES = (
    AskedPlace(
        "corridor_map@0:268:2",
        {"corridor_night": 1, "corridor_evening": 1, "corridor_day": 6},
        {"demo/night": 3, "street_rain": 8, _KITCHEN: 12, _ZED: 10, _STREET_1: 8},
    ),
    AskedPlace(
        "corridor_map@0:268:2",
        {"corridor_reverse": 1},
        {_KITCHEN: 12, _ZED: 10, "demo/night": 3},
        asks_walls=True,
    ),  # one lap
    AskedPlace(
        "demo/map_lap1",
        {"demo/day": 1, "demo/night": 1},
        {"demo/corridor": 1, "corridor_night": 4, _KITCHEN: 12, _ZED: 10, "street_cloudy": 10},
    ),
    AskedPlace(
        "lab_map",
        {"lab_night": 1},
        {"corridor_night": 4, _KITCHEN: 12, _ZED: 10, "street_cloudy": 10},
    ),
    AskedPlace(
        "street_map",
        {"street_cloudy": 2, "street_rain": 2, "street_clear": 5, "street_reverse": 3},
        {"corridor_night": 8, "demo/night": 8, _STREET_1: 4, _STREET_2: 4, _ZED: 10},
    ),
    AskedPlace(
        "seven_scenes/kitchen@0-59/100",
        {_KITCHEN: 6},
        {"corridor_night": 8, _ZED: 5, "demo/night": 8, _STREET_1: 8},
        True,
    ),
    AskedPlace(
        "zed_lab/session1",
        {_ZED: 4},
        {_KITCHEN: 8, "demo/night": 4, "corridor_night": 8, _STREET_2: 8},
        True,
        "zed_lab/session1_from_session2.json",
    ),
    AskedPlace(
        "kitti/sequences/street1@0::2",
        {_STREET_1: 3},
        {_KITCHEN: 10, "street_cloudy": 4, "corridor_night": 10, _ZED: 8},
        True,
    ),
    AskedPlace(
        "kitti/sequences/street2@0::2",
        {_STREET_2: 3},
        {_KITCHEN: 10, "street_rain": 4, "corridor_night": 10, "demo/night": 10},
        True,
    ),
)


def family_of(name: str) -> str:
    """Return the kind of place that a recording shows. Poses of one family are never both fitted
    and tested."""
    return next(family for prefix, family in FAMILIES.items() if name.startswith(prefix))


def open_recordings(data: Path, rendered: Path | None) -> dict[str, StereoSequence]:
    """The recordings of `PLACES` by their names; a line is printed for each that is missing.

    Args:
        data: the folder of real recordings; rendered: that of the rendered ones.
    """
    recordings: dict[str, StereoSequence] = {}
    for name in dict.fromkeys(
        name for place in PLACES for name in (place.mapping, *place.own, *place.others)
    ):
        folder = SHIPPED.parent if name.startswith("demo/") else data if "/" in name else rendered
        if folder is None:
            print(f"left out: {name}, which is rendered")
            continue
        path = folder / name.replace("demo/", f"{SHIPPED.name}/", 1)
        try:
            sequence = open_sequence(path)
            sequence[len(sequence) - 1]  # one that is still being rendered lacks it
            recordings[name] = sequence
        except RecordingError as error:
            print(f"left out: {error}")
    return recordings


def read_rigid(path: Path) -> Rigid3:
    """The one 4x4 matrix in a JSON file."""
    (matrix,) = [
        value
        for value in json.loads(path.read_text(encoding="utf-8")).values()
        if isinstance(value, list)
    ]
    return Rigid3.from_matrix(np.array(matrix))
