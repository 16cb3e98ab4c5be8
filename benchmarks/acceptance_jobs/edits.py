"""Change a map: a night session joins, two halves merge, prune to a size, undo."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from .figures import Figure, rounded
from .places import FIT
from .workplace import Workplace


def edits(work: Workplace) -> Iterator[Figure]:
    """Run update, prune and undo on the demo's lab, and merge two halves of the ZED lab."""
    yield from _night_joins(work)
    if not work.quick:
        yield from _halves_merge(work)


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _night_joins(work: Workplace) -> Iterator[Figure]:
    path, night = work.own_map("lab"), work.lab("night")
    yield _localized(work, "before the update, night", path, night)
    built = digest(path)
    joined = work.answer("update", path, night)["updates"][0]
    frames = f"update by night: frames with a pose of {joined['frames']}"
    yield Figure(frames, joined["frames_with_pose"], "at least")
    yield Figure("update by night: map, MB", rounded(joined["bytes"] / 1e6), "median")
    yield _localized(work, "after the update, night", path, night)
    yield _localized(work, "after the update, day", path, work.lab("day"))
    updated = digest(path)
    size = round(0.5 * path.stat().st_size / 1e6, 1)
    pruned = work.answer("prune", path, "--max-mb", size)
    yield Figure("prune to half: MB over the limit", max(0.0, pruned["bytes"] / 1e6 - size))
    yield _localized(work, "after prune to half, night", path, night)
    work.topoloc("undo", path)
    yield Figure("undo of prune gives the same file", int(digest(path) == updated), "at least")
    work.topoloc("undo", path)
    yield Figure("undo of update gives the same file", int(digest(path) == built), "at least")


def _halves_merge(work: Workplace) -> Iterator[Figure]:
    first, second, out = (work.folder / f"{name}.topo" for name in ("first", "second", "merged"))
    work.topoloc("build", work.data("zed_lab/session1@0:52"), first)
    work.topoloc("build", work.data("zed_lab/session1@40:88"), second)
    session = work.data("zed_lab/session2@0:99")
    fit = ("--map-from-truth", work.data(FIT))
    yield _localized(work, "first half, session 2", first, session, *fit)
    merged = work.answer("merge", first, second, out)
    count = f"merge: nodes of the second half localized of {merged['nodes_of_second']}"
    yield Figure(count, merged["localized"], "at least")
    yield Figure("merge: map, MB", rounded(merged["bytes"] / 1e6), "median")
    yield _localized(work, "both halves merged, session 2", out, session, *fit)


def _localized(
    work: Workplace, name: str, where: Path, recording: object, *options: object
) -> Figure:
    found = work.answer("evaluate", where, recording, *options)
    count = f"{name}: localized of {found['num_queries']}"
    return Figure(count, found["num_localized"] - found["false_accepts"], "at least")
