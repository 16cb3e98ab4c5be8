"""The recordings of `topoloc demo`, which come with topoloc: the lab by day for the map, and what
the map is asked about.

They are rendered; `topoloc simulate demo`, of the distribution topoloc-worlds, makes them anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

Role = Literal["map", "queries", "elsewhere"]

SHIPPED = Path(__file__).parent / "lab"
ROLES: dict[str, Role] = {
    "map_lap1": "map",
    "map_lap2": "map",
    "day": "queries",
    "night": "queries",
    "other_camera": "queries",
    "corridor": "elsewhere",
    "street": "elsewhere",
    "pictures_of_nothing": "elsewhere",
}
"""What each recording is for, by the name of its folder."""


def find_missing_recordings(folder: Path) -> list[str]:
    """The names of the demo's recordings that are not in `folder`."""
    return [name for name in ROLES if not (folder / name).is_dir()]
