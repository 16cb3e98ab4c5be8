"""Two small maps of different rooms, and an atlas of them that no test writes to."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from topoloc.atlas.editing import create_atlas, new_tiles
from topoloc.localization.map_facts.building import build_map
from topoloc.map.build import BuildConfig
from topoloc.sequences.open import open_sequence


@pytest.fixture(scope="session")
def other_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of another room, of half as many pairs."""
    from tiny_world import write_stereo_recording

    folder = tmp_path_factory.mktemp("other")
    recording = write_stereo_recording(folder / "other", seed=1, indices=[0.0, 2.0, 4.0, 6.0])
    build_map(open_sequence(str(recording)), BuildConfig(other_kinds=())).save(folder / "other.topo")
    return folder / "other.topo"


@pytest.fixture(scope="session")
def atlas(room_map: Path, other_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An atlas of the tiles `room` and `other`."""
    where = tmp_path_factory.mktemp("atlas") / "campus"
    create_atlas(str(where), new_tiles([str(room_map), str(other_map)]))
    return where


@pytest.fixture
def own_atlas(atlas: Path, tmp_path: Path) -> Path:
    """A copy that may be written to."""
    return Path(shutil.copytree(atlas, tmp_path / "campus"))
