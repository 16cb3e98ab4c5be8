"""One recording becomes one tile of an atlas, wherever that is done: nothing here knows of a
cluster.

Whoever is killed in the middle is simply called again. What was made is told by the manifest alone:
a tile remembers the digest of all that decided what its map looks like, and what is there already
is not made twice.
"""

from __future__ import annotations

import contextlib
import io
import platform
import re
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from topoloc import AtlasError, NewTile, Tile, TopolocError, TopoMetricMap, add_tiles, read_manifest
from topoloc.apps.cluster.remote import Progress
from topoloc.plugin import check_tile_id, temporary_folder

State = Literal["built", "recognised", "updated", "there", "failed"]


@runtime_checkable
class MapMaker(Protocol):
    """Makes the map of a recording; it may be pickled."""

    def make(self, progress: Progress) -> tuple[TopoMetricMap, list[str]]:
        """The map, and where its poses come from. Raises TopolocError."""
        ...

    def digest(self) -> str:
        """Of all that decides what the map looks like. Raises TopolocError."""
        ...


@dataclass(frozen=True)
class TileJob:
    """A recording, the id of the tile that becomes of it, the world that it is in, and what makes
    its map.

    Raises:
        AtlasError: no tile, or no world, can be called so.
    """

    recording: str
    tile_id: str
    world: str
    maker: MapMaker

    def __post_init__(self) -> None:
        check_tile_id(self.tile_id)
        check_tile_id(self.world)

    def digest(self) -> str:
        """Of all that decides what the tile looks like, 64 hexadecimal digits. Raises
        TopolocError."""
        return sha256(f"{self.maker.digest()} {self.world}".encode()).hexdigest()


@dataclass(frozen=True)
class Outcome:
    """What became of a recording: `reason` says why it failed, `notes` are lines that are to be
    known beside, `changes` what its session changed of a tile that was there.

    `seconds` are those on the clock, `cpu_seconds` those of all its threads on a processor; `host`
    is the machine that did it.
    """

    recording: str
    tile_id: str
    state: State
    reason: str | None = None
    notes: tuple[str, ...] = ()
    num_nodes: int = 0
    num_bytes: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    host: str = ""
    changes: dict[str, Any] | None = None

    def to_json(self) -> dict[str, Any]:
        data = asdict(self) | {
            "notes": list(self.notes),
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }
        return (
            data
            if self.changes is not None
            else {name: value for name, value in data.items() if name != "changes"}
        )


def build_tile(job: TileJob, atlas: str, replaces: bool, progress: Progress) -> Outcome:
    """The recording mapped and its tile in the atlas, which is made where there is none; or why
    not.

    Args:
        replaces: a tile of the same id that was made otherwise is replaced, else it is a failure.
    """
    return run_tile_work(
        job.recording, job.tile_id, lambda: _build_tile(job, atlas, replaces, progress)
    )


def run_tile_work(recording: str, tile_id: str, work: Callable[[], tuple[State, Tile]]) -> Outcome:
    """What becomes of a recording by this work, which says it, with the tile as it is then; or why
    nothing does."""
    started, cpu_started, said = time.monotonic(), time.process_time(), io.StringIO()
    state, reason, tile = "failed", None, None
    with contextlib.redirect_stderr(said):
        try:
            state, tile = work()
        except TopolocError as error:
            reason = " ".join(str(error).split())
        except MemoryError:
            reason = "out of memory"
        except Exception as error:  # a bug: the others go on, and all of it is told
            traceback.print_exc()
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:500]
    done = Outcome(
        recording, tile_id, state, reason, tuple(said.getvalue().splitlines()), host=platform.node()
    )
    if tile is not None:
        done = replace(
            done, tile_id=tile.tile_id, num_nodes=tile.num_nodes, num_bytes=tile.map.num_bytes
        )
    return replace(
        done, seconds=time.monotonic() - started, cpu_seconds=time.process_time() - cpu_started
    )


def _build_tile(job: TileJob, atlas: str, replaces: bool, progress: Progress) -> tuple[State, Tile]:
    recipe = job.digest()
    before = read_manifest(atlas)
    if made := [tile for tile in before.tiles if tile.recipe == recipe]:
        return "there", made[0]
    if job.tile_id in before.by_id and not replaces:
        raise AtlasError(
            f"the atlas has a tile {job.tile_id} already, which was made otherwise; --replace"
            " replaces it"
        )
    topomap, _ = job.maker.make(progress)
    with temporary_folder("topoloc-tile-") as folder:
        path = folder / "tile.topo"
        topomap.save(path)
        after = add_tiles(
            atlas, [NewTile(job.tile_id, path, job.world, recipe)], replaces, creates=True
        )
    return "built", after.by_id[job.tile_id]


def derive_tile_ids(recordings: Sequence[str]) -> list[str]:
    """Ids for the tiles of recordings: their names, with as many folders above as tell them apart.

    Raises:
        AtlasError: a recording is named twice.
    """
    paths = [_path_parts(recording) for recording in recordings]
    for recording, words in zip(recordings, paths, strict=True):
        if paths.count(words) > 1:
            raise AtlasError(
                f"recording {recording} is named twice, or its tile would be called as another"
                " one's"
            )
    ids, depth = [""] * len(paths), 1
    left = set(range(len(paths)))
    while left:
        named = {k: "_".join(paths[k][-depth:])[-100:].lstrip("_.-") for k in left}
        done = {
            k
            for k in left
            if (list(named.values()).count(named[k]) == 1 and named[k] not in ids) or depth > 100
        }
        for k in done:
            ids[k] = named[k]
            check_tile_id(ids[k])
        left, depth = left - done, depth + 1
    if len(set(ids)) < len(ids):
        raise AtlasError("the recordings' names are too long to tell their tiles apart")
    return ids


def _path_parts(recording: str) -> list[str]:
    """The parts of a recording's path, each of letters that an id may have; the frames that are
    chosen of it belong to the last one."""
    folder, at, selection = recording.rpartition("@")
    chosen = bool(at) and re.fullmatch(r"[-0-9:,/]+", selection) is not None
    parts = list(Path(folder if chosen else recording).parts) or [""]
    if chosen:
        parts[-1] += "_" + re.sub("[:,/]", "-", selection)
    words = [re.sub(r"[^A-Za-z0-9_.-]+", "-", part) for part in parts]
    return [word for word in words if word.strip("._-")] or ["recording"]
