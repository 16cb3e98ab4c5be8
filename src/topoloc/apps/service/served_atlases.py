"""The atlases among what is served: each opened anew when its manifest was written again.

Stores are looked at by threads of their own, every few seconds: a silent one keeps nobody waiting,
and what was opened of it goes on answering.
"""

from __future__ import annotations

import logging
import threading

from topoloc import Atlas, AtlasConfig, Localizer, MapCache, TopolocError
from topoloc.apps.service.logs import log

POLL_INTERVAL_S = 5.0
"""Seconds between two looks at an object store: one listing each, a reading where a manifest was
written."""


class ServedAtlases:
    """Localizers of the atlases of these maps, which open their tiles as the maps of the
    service."""

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
        """Look at those in object stores from now on, until `close`."""
        for where, watched in self._watched.items():
            if watched.is_remote:
                threading.Thread(
                    target=self._poll_atlas, args=(where,), name="atlas", daemon=True
                ).start()

    def close(self) -> None:
        """No more looks; one that waits for its store is not waited for."""
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
