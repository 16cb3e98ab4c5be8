"""Build the tiles of an atlas from recordings, on this machine or on a Ray cluster.

A job that was interrupted is called again. A tile stores the digest of everything that determines
its map, so existing tiles are recognized. Maps do not pass through the driver.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import re
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from topoloc import Atlas, AtlasError, Tile, TopolocError, TopoMetricMap
from topoloc.apps.cluster.config import ClusterConfig
from topoloc.apps.cluster.remote import Progress
from topoloc.apps.cluster.tasks import OnJobState, run_on_ray
from topoloc.apps.core_names import check_tile_id, temporary_folder

State = Literal["built", "recognised", "updated", "there", "failed"]


@runtime_checkable
class MapMaker(Protocol):
    """Builds the map of a recording. It may be pickled."""

    def make(self, progress: Progress) -> tuple[TopoMetricMap, list[str]]:
        """Return the map and the source of its poses. Raises TopolocError."""
        ...

    def digest(self) -> str:
        """Return the digest of everything that determines the map. Raises TopolocError."""
        ...


@dataclass(frozen=True)
class TileJob:
    """A recording, the id and the world of its tile, and the builder of its map. Raises AtlasError:
    the id or the world is invalid."""

    recording: str
    tile_id: str
    world: str
    maker: MapMaker

    def __post_init__(self) -> None:
        check_tile_id(self.tile_id)
        check_tile_id(self.world)

    def digest(self) -> str:
        """Return the digest of everything that determines the tile, 64 hexadecimal digits. Raises
        TopolocError."""
        return sha256(f"{self.maker.digest()} {self.world}".encode()).hexdigest()


@dataclass(frozen=True)
class Outcome:
    """The outcome of a recording.

    Attributes:
        reason: reason of a failure.
        notes: messages to show.
        seconds, cpu_seconds: elapsed time, and processor time of all threads.
        host: machine of the work.
        changes: changes of a tile that was updated.
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
        """Return the outcome as JSON, without `changes` if there are none."""
        data = asdict(self) | {
            "notes": list(self.notes),
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }
        return {
            name: value for name, value in data.items() if name != "changes" or value is not None
        }


@dataclass(frozen=True)
class TileTask:
    """The `Job` that builds the tile of a recording and adds it to the atlas, which is created if
    necessary. A tile of the same id with another digest is replaced if `replaces`; if not, it is a
    failure."""

    job: TileJob
    atlas: str
    replaces: bool

    @property
    def name(self) -> str:
        """Name on Ray's dashboard."""
        return f"build {self.job.tile_id}"

    def run(self, progress: Progress) -> Outcome:
        """Build the tile."""
        return run_tile_work(self.job.recording, self.job.tile_id, lambda: self._build(progress))

    def failure_outcome(self, reason: str) -> Outcome:
        """Return the outcome of a lost worker."""
        return Outcome(self.job.recording, self.job.tile_id, "failed", reason)

    def _build(self, progress: Progress) -> tuple[State, Tile]:
        job, recipe = self.job, self.job.digest()
        before = Atlas.read_manifest(self.atlas)
        if made := [tile for tile in before.tiles if tile.recipe == recipe]:
            return "there", made[0]
        if job.tile_id in before.by_id and not self.replaces:
            raise AtlasError(
                f"the atlas has another tile {job.tile_id} already; use --replace to replace it"
            )
        topomap, _ = job.maker.make(progress)
        with temporary_folder("topoloc-tile-") as folder:
            topomap.save(path := folder / "tile.topo")
            add = Atlas.add_map
            return "built", add(self.atlas, job.tile_id, path, job.world, recipe, self.replaces)


def build_on_ray(
    jobs: Sequence[TileJob],
    atlas: str,
    address: str,
    replaces: bool = False,
    config: ClusterConfig | None = None,
    show: OnJobState[Outcome] | None = None,
    is_live: bool = False,
) -> list[Outcome]:
    """Build all tiles of an atlas on a cluster and return the outcomes in order. See `TileTask` for
    `replaces` and `run_on_ray` for the other arguments. Raises MissingExtraError, ClusterError: see
    `connect_to_cluster`; AtlasError: the address holds no atlas, or its store does not answer."""
    Atlas.read_manifest(atlas)  # fails before the cluster is used
    atlas = atlas if "://" in atlas else os.path.abspath(atlas)
    tasks = [TileTask(job, atlas, replaces) for job in jobs]
    return run_on_ray(tasks, address, config, show, is_live)


def run_tile_work(recording: str, tile_id: str, work: Callable[[], tuple[State, Tile]]) -> Outcome:
    """Run the work on a tile and return its outcome, also if it fails. Messages on standard error
    become notes."""
    started, cpu_started, messages = time.monotonic(), time.process_time(), io.StringIO()
    state, reason, tile = "failed", None, None
    with contextlib.redirect_stderr(messages):
        try:
            state, tile = work()
        except TopolocError as error:
            reason = " ".join(str(error).split())
        except MemoryError:
            reason = "out of memory"
        except Exception as error:  # a bug; the other jobs continue
            traceback.print_exc()
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:500]
    seconds, cpu_seconds = time.monotonic() - started, time.process_time() - cpu_started
    spent = {"seconds": seconds, "cpu_seconds": cpu_seconds, "host": platform.node()}
    notes = tuple(messages.getvalue().splitlines())
    if tile is not None:
        spent |= {"num_nodes": tile.num_nodes, "num_bytes": tile.map.num_bytes}
        tile_id = tile.tile_id
    return Outcome(recording, tile_id, state, reason, notes, **spent)


def derive_tile_ids(recordings: Sequence[str]) -> list[str]:
    """Return tile ids from the recordings' names, with parent folders until they are unique. Raises
    AtlasError: a recording is given twice."""
    paths = [_path_parts(recording) for recording in recordings]
    for recording, words in zip(recordings, paths, strict=True):
        if paths.count(words) > 1:
            raise AtlasError(
                f"recording {recording} is given twice, or its tile would have the id of another"
            )
    ids, depth = [""] * len(paths), 1
    left = set(range(len(paths)))
    while left:
        named = {k: "_".join(paths[k][-depth:])[-100:].lstrip("_.-") for k in left}
        taken = [*named.values(), *ids]
        done = {k for k in left if taken.count(named[k]) == 1 or depth > 100}
        for k in done:
            ids[k] = named[k]
            check_tile_id(ids[k])
        left, depth = left - done, depth + 1
    if len(set(ids)) < len(ids):
        raise AtlasError("the recordings' names are too long for unique tile ids")
    return ids


def _path_parts(recording: str) -> list[str]:
    """Return the parts of a recording's path in characters of ids. The last one includes the
    selected frames."""
    folder, at, selection = recording.rpartition("@")
    chosen = bool(at) and re.fullmatch(r"[-0-9:,/]+", selection) is not None
    parts = list(Path(folder if chosen else recording).parts) or [""]
    if chosen:
        parts[-1] += "_" + re.sub("[:,/]", "-", selection)
    words = [re.sub(r"[^A-Za-z0-9_.-]+", "-", part) for part in parts]
    return [word for word in words if word.strip("._-")] or ["recording"]
