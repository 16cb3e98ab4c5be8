"""Provide two small maps of different rooms, and a read-only atlas of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from atlas_fixtures import *  # noqa: F403
from topoloc.atlas.editing import create_atlas, new_tiles


@pytest.fixture(scope="session")
def atlas(room_map: Path, other_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an atlas of the tiles `room` and `other`."""
    where = tmp_path_factory.mktemp("atlas") / "campus"
    create_atlas(str(where), new_tiles([str(room_map), str(other_map)]))
    return where


@pytest.fixture
def own_atlas(atlas: Path, tmp_path: Path) -> Path:
    """Return a copy of the atlas that a test may change."""
    return Path(shutil.copytree(atlas, tmp_path / "campus"))
