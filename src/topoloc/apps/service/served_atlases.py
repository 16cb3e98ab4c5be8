"""Serve atlases. Each one is reopened when its manifest changes.

A thread for each object store checks its manifest every few seconds. While a store is silent, the
last version is served.
"""

from __future__ import annotations

import logging
import threading

from topoloc import Atlas, AtlasConfig, Localizer, MapCache, TopolocError
from topoloc.apps.service.logs import log

POLL_INTERVAL_S = 5.0
"""Seconds between two checks of an object store: one listing each, and a reading if it changed."""


class ServedAtlases:
    """Hold a localizer for each atlas. The service's cache of maps opens their tiles."""

    def __init__(self, maps: MapCache[Localizer], config: AtlasConfig) -> None:
        self._maps, self._config = maps, config
        self._watched = {watched.where: watched for watched in maps.atlases}
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._opened: dict[str, tuple[Atlas, Localizer]] = {}

    def opened(self) -> list[tuple[Atlas, Localizer]]:
        """Return the current version of each atlas with its localizer. Raises AtlasError."""
        with self._lock:
            return [self._open_localizer(where) for where in self._watched]

    def watch(self) -> None:
        """Check the atlases in object stores until `close`."""
        for where, watched in self._watched.items():
            if watched.is_remote:
                threading.Thread(
                    target=self._poll_atlas, args=(where,), name="atlas", daemon=True
                ).start()

    def close(self) -> None:
        """Stop the checks, without waiting for one in progress."""
        self._ended.set()

    def _open_localizer(self, where: str) -> tuple[Atlas, Localizer]:
        atlas, known = self._watched[where].now(), self._opened.get(where)
        if known is None or known[0] is not atlas:
            self._opened[where] = known = (
                atlas,
                Localizer(atlas, tiles=self._config, maps=self._maps, warn=_warn),
            )
        return known

    def _poll_atlas(self, where: str) -> None:
        watched, told = self._watched[where], ""
        while not self._ended.wait(POLL_INTERVAL_S):
            try:
                if watched.look():
                    log("atlas", where=where, serial=watched.now().manifest.serial)
                told = ""
            except (
                Exception
            ) as error:  # whatever it is, the next look may succeed; what was opened before answers
                if str(error) != told:
                    unknown = None if isinstance(error, TopolocError) else error
                    log("atlas", logging.WARNING, unknown, where=where, detail=str(error))
                told = str(error)


def _warn(text: str) -> None:
    log("tile", logging.WARNING, detail=text)
