"""Tiles of object stores on their way to this machine, beside those who ask for them: nobody who
answers pictures waits for a store.

Whoever asks for a tile that is not here yet is told so (`TilePending`), may wait for it elsewhere,
and asks again. A tile is fetched once however many ask for it. It is waited for only so long; it
goes on coming, for those who ask later.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.manifest import Tile
from topoloc.errors import ObjectStoreError

_MAX_CONCURRENT_FETCHES = 16
"""Tiles of one store; the store of another atlas is fetched from all the same."""
_RETRY_AFTER_S = 5.0
"""So long a store that failed is not asked for the same tile again."""


@dataclass(eq=False)
class TileFetch:
    """A tile on its way, from `where`; `future` gets its result, the file or why there is none, and
    never raises. It is waited for `deadline` then (`time.monotonic`)."""

    where: str
    deadline: float
    future: Future[Path | Exception] = field(default_factory=Future)
    finished_at: float = float("inf")

    @property
    def is_stale(self) -> bool:
        return time.monotonic() > self.finished_at + _RETRY_AFTER_S


class TilePending(Exception):
    """The tile is on its way; whoever asked may ask again when the fetch has ended."""

    def __init__(self, fetch: TileFetch) -> None:
        super().__init__(f"a tile of {fetch.where} is on its way")
        self.fetch = fetch


class TileFetcher:
    """What is being fetched for one process.

    Args:
        wait_s: so many seconds a tile is waited for.
    """

    def __init__(self, wait_s: float) -> None:
        self._wait_s, self._lock = wait_s, threading.Lock()
        self._fetches: dict[tuple[str, str], TileFetch] = {}

    def path(self, atlas: Atlas, tile: Tile) -> Path:
        """The tile's map file, if it is on this machine; else it is fetched from now on.

        Raises:
            TileAwaited: it is on its way.
            StoreError: it has been for too long, the store does not answer, or too many others are.
            AtlasError: it is missing, or not what was added.
        """
        cached = atlas.store.cached(tile.map.name, tile.map.sha256)
        if cached is not None:
            return cached
        fetch = self._fetch(atlas, tile)
        if fetch.future.done():
            outcome = fetch.future.result()
            if isinstance(outcome, Exception):
                raise outcome
            return outcome
        if time.monotonic() >= fetch.deadline:
            raise ObjectStoreError(
                f"{fetch.where} has not given tile {tile.tile_id} within {self._wait_s:g} s; it is"
                " still being fetched"
            )
        raise TilePending(fetch)

    def _fetch(self, atlas: Atlas, tile: Tile) -> TileFetch:
        """The one that is under way, or has just failed; else a new one."""
        where, key = atlas.store.where, (atlas.store.where, tile.map.name)
        with self._lock:
            self._fetches = {
                one: fetch for one, fetch in self._fetches.items() if not fetch.is_stale
            }
            if key in self._fetches:
                return self._fetches[key]
            num_coming = sum(
                fetch.where == where and not fetch.future.done() for fetch in self._fetches.values()
            )
            if num_coming >= _MAX_CONCURRENT_FETCHES:
                raise ObjectStoreError(
                    f"{where}: tile {tile.tile_id} is not here yet, and {num_coming} others are"
                    " being fetched"
                )
            fetch = self._fetches[key] = TileFetch(where, time.monotonic() + self._wait_s)
        threading.Thread(
            target=_run_fetch, args=(fetch, atlas, tile), name="tile", daemon=True
        ).start()
        return fetch


def _run_fetch(fetch: TileFetch, atlas: Atlas, tile: Tile) -> None:
    outcome: Path | Exception
    try:
        outcome = atlas.map_path(tile)
    except Exception as error:  # told to those who ask
        outcome = error
    fetch.finished_at = time.monotonic()
    fetch.future.set_result(outcome)
