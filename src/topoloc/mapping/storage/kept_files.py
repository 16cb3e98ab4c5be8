"""Keep the map files before the last edits, so that these edits can be undone.

`lab.topo.undo-AFTER-BEFORE` is the file that an edit replaced: a hard link, or a copy if the file
system has no links. AFTER and BEFORE are digests of the map file after and before this edit. So the
names alone lead back from edit to edit. The map does not need these files otherwise.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import TypeVar

from topoloc.errors import MapError
from topoloc.recordings.atomic import atomic_write

T = TypeVar("T")
_MAX_BYTES = 1_000_000_000
"""Bytes of all kept files of a map together. The newest file is kept at any size."""


def kept_path(path: Path, after: str, before: str) -> Path:
    """Return the path of the file that an edit of the map at `path` replaced. `after` and `before`
    are the SHA-256 of the map file after and before the edit, in hexadecimal digits."""
    return path.with_name(f"{path.name}.undo-{after[:16]}-{before[:16]}")


def find_kept_files(path: Path) -> list[Path]:
    """Return the kept files that lead back from the map file at `path`, the newest first. Raises
    MapError if the map file or its folder cannot be read."""
    try:
        found = _find_by_digest(path)
        digest = _digest_of(path)[:16] if found else ""
    except OSError as error:
        raise MapError(f"cannot read map {path}: {error.strerror}") from error
    kept = list[Path]()
    while digest in found:
        kept.append(found.pop(digest))
        digest = kept[-1].name[-16:]
    return kept


def keep_file(path: Path, changed: Path) -> Path:
    """Keep the file at `path`, before `changed` is renamed over it. Return the kept file. Raises
    OSError."""
    kept = kept_path(path, _digest_of(changed), _digest_of(path))
    kept.unlink(missing_ok=True)
    try:
        os.link(path, kept)
    except OSError:  # a file system without links
        with atomic_write(kept) as temporary:
            shutil.copyfile(path, temporary)
    return kept


def restore_file(kept: Path, path: Path) -> None:
    """Rename a kept file to `path`, if it is undamaged. Raises MapError, OSError."""
    if _digest_of(kept)[:16] != kept.name[-16:]:
        raise MapError(
            f"{kept} is damaged: it is not the map before the edit. Remove it; the map stays as it"
            " is"
        )
    os.replace(kept, path)


def drop_kept_files(path: Path) -> None:
    """Remove kept files that do not lead back from the map file at `path`, and the oldest ones
    beyond `_MAX_BYTES`. A file that cannot be removed stays."""
    with suppress(OSError, MapError):
        kept = find_kept_files(path)
        used = select_kept(kept, [one.stat().st_size for one in kept])
        for one in set(_find_by_digest(path).values()).difference(used):
            one.unlink()


def select_kept(files: Sequence[T], sizes: Sequence[int]) -> Sequence[T]:
    """Return those of the files, the newest first, that have at most `_MAX_BYTES` together. The
    newest is kept at any size."""
    return files[: max(1, sum(total <= _MAX_BYTES for total in accumulate(sizes)))]


def _find_by_digest(path: Path) -> dict[str, Path]:
    """Return all kept files of a map, by the digest of the map after the edit."""
    name = re.compile(rf"{re.escape(path.name)}\.undo-([0-9a-f]{{16}})-[0-9a-f]{{16}}")
    found = (name.fullmatch(one) for one in os.listdir(path.parent))
    return {match[1]: path.with_name(match[0]) for match in found if match}


def _digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
