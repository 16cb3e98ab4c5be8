"""The atlases among what is served: each opened anew when its manifest was written again."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from pathlib import Path

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.atlas_localizer import AtlasLocalizer
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.open_maps import Maps
from topoloc.atlas.store import FolderStore
from topoloc.service.logs import log


class ServedAtlases:
    """Localizers of these atlases, which open their tiles as the maps of the service."""

    def __init__(self, folders: Sequence[Path], maps: Maps, config: AtlasConfig) -> None:
        self._folders, self._maps, self._config = list(folders), maps, config
        self._lock = threading.Lock()
        self._opened: dict[Path, tuple[bytes | None, AtlasLocalizer]] = {}

    def localizers(self) -> list[AtlasLocalizer]:
        """One an atlas, as its manifest is now. Raises AtlasError."""
        with self._lock:
            return [self._localizer(folder) for folder in self._folders]

    def _localizer(self, folder: Path) -> AtlasLocalizer:
        manifest, known = FolderStore(folder).manifest(), self._opened.get(folder)
        if known is None or known[0] != manifest:
            localizer = AtlasLocalizer(Atlas.open(str(folder)), self._maps, self._config, _warn)
            self._opened[folder] = known = manifest, localizer
        return known[1]


def _warn(text: str) -> None:
    log("tile", logging.WARNING, detail=text)
