"""Provide out-of-map images, a recording that tests may damage, and settings files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from built_room import unseen_views, write_pictures


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of images of another room."""
    return write_pictures(
        tmp_path_factory.mktemp("queries") / "elsewhere", unseen_views(seed=1, step=4.0)
    )


@pytest.fixture
def recording(tiny_recording: Path, tmp_path: Path) -> Path:
    """Return a copy of `tiny_recording` that a test may damage."""
    return Path(shutil.copytree(tiny_recording, tmp_path / "recording"))


@pytest.fixture
def file_of(tmp_path: Path) -> Callable[[str | bytes], str]:
    """Return a function that writes a TOML file and returns its path."""

    def write(content: str | bytes) -> str:
        path = tmp_path / "my.toml"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return str(path)

    return write
