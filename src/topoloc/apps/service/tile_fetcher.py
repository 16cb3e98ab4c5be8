"""Fetch tiles from object stores in background threads, so that no query thread waits for a store.

A caller that needs a missing tile gets `TilePending`. It may wait for the fetch elsewhere and try
again. A tile is fetched once for any number of callers. After a timeout callers get an error, but
the fetch continues for later ones.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path

from topoloc import Atlas, ObjectStoreError, Tile
from topoloc.apps.core_names import RETRY_AFTER_S

_MAX_CONCURRENT_FETCHES = 16
"""Maximum number of concurrent fetches from one store. Other stores are not affected."""


@dataclass(eq=False)
class TileFetch:
    """Hold a running fetch from the store `where`.

    `future` receives the file or the exception as its result and never raises. Callers wait for it
    until `deadline` (`time.monotonic`).
    """

    where: str
    deadline: float
    future: Future[Path | Exception] = field(default_factory=Future)
    finished_at: float = float("inf")


class TilePending(Exception):
    """Signal that the tile is being fetched. The caller may try again when the fetch has ended."""

    def __init__(self, fetch: TileFetch) -> None:
        super().__init__(f"a tile of {fetch.where} is on its way")
        self.fetch = fetch


class TileFetcher:
    """Manage the fetches of one process.

    Args:
        wait_s: timeout of a fetch, seconds.
    """

    def __init__(self, wait_s: float) -> None:
        self._wait_s, self._lock = wait_s, threading.Lock()
        self._fetches: dict[tuple[str, str], TileFetch] = {}

    def path(self, atlas: Atlas, tile: Tile) -> Path:
        """Return the tile's map file if it is local. Otherwise start to fetch it.

        Raises:
            TilePending: the tile is being fetched.
            ObjectStoreError: the fetch timed out, the store does not respond, or too many fetches
                run.
            AtlasError: the file is missing or differs from the manifest.
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
        """Return the running or recently failed fetch of a tile, or start a new one."""
        where, key = atlas.store.where, (atlas.store.where, tile.map.name)
        with self._lock:
            self._fetches = {
                one: fetch
                for one, fetch in self._fetches.items()
                if time.monotonic() <= fetch.finished_at + RETRY_AFTER_S
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
    except Exception as error:  # raised again in the callers
        outcome = error
    fetch.finished_at = time.monotonic()
    fetch.future.set_result(outcome)
