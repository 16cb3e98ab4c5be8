"""Pictures of another world, a recording to be broken, and files of settings."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from built_room import unseen_views, write_pictures


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of another world."""
    return write_pictures(
        tmp_path_factory.mktemp("queries") / "elsewhere", unseen_views(seed=1, step=4.0)
    )


@pytest.fixture
def recording(tiny_recording: Path, tmp_path: Path) -> Path:
    """A copy of `tiny_recording`, to be broken."""
    return Path(shutil.copytree(tiny_recording, tmp_path / "recording"))


@pytest.fixture
def file_of(tmp_path: Path) -> Callable[[str | bytes], str]:
    """Writes a TOML file and returns its path."""

    def write(content: str | bytes) -> str:
        path = tmp_path / "my.toml"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return str(path)

    return write
