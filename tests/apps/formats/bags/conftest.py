"""Provide a short stereo recording, and functions that write it as a bag of each format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from bag_writing import SUFFIXES, by_tf, write_stereo_bag

from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="session")
def walk(tiny_recording: Path) -> StereoSequence:
    """Return five stereo pairs with poses."""
    return open_sequence(f"{tiny_recording}@0:10:2")


@pytest.fixture
def bag_of(walk: StereoSequence, tmp_path: Path) -> Callable[..., Path]:
    """Return a function that writes `walk` as a bag of a format."""

    def write(kind: str, **settings: object) -> Path:
        return write_stereo_bag(
            tmp_path / f"walk_{kind}{SUFFIXES[kind]}", kind, walk, **({"poses": by_tf} | settings)
        )  # pyright: ignore[reportArgumentType]

    return write


@pytest.fixture
def file_of(bag_of: Callable[..., Path]) -> Callable[[str], Path]:
    """Return a function that writes such a bag and returns the file that contains its messages."""

    def write(kind: str) -> Path:
        path = bag_of(kind)
        return (
            path
            if path.is_file()
            else next(part for part in path.iterdir() if part.suffix in (".db3", ".mcap"))
        )

    return write
