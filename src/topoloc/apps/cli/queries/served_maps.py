"""Describe the maps and settings of `topoloc serve`, so that another process can serve the same."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from topoloc import (
    AtlasConfig,
    Localizer,
    LocalizerConfig,
    MapCache,
    TileFetcher,
    TopolocError,
    TrackerConfig,
    set_num_threads,
    warm_up,
)
from topoloc.apps.cli.features_option import open_localizer
from topoloc.apps.service.config import ServiceConfig

MIN_TOKEN_LENGTH = 16


@dataclass(frozen=True)
class ServedMaps:
    """Hold the maps and the settings of their queries. The token is read from its file, so that it
    is stored nowhere else."""

    paths: tuple[str, ...]
    features: str | None
    token_file: str | None
    loopback_only: bool
    service: ServiceConfig
    localizer: LocalizerConfig
    tracker: TrackerConfig
    atlas: AtlasConfig

    def application(self):  # no return type: the service is an extra, and loaded here alone
        """Return the application. It opens maps at their first request. Raises TopolocError."""
        from topoloc.apps.service.application import Access, create_application

        access = Access(read_token(self.token_file), self.loopback_only)
        return create_application(self._open_maps(), self.service, access, self.tracker, self.atlas)

    def _open_maps(self) -> MapCache[Localizer]:
        """Return a cache of the maps, after the kernels are compiled."""
        warm_up(
            only_if_cold=lambda: print("compiling, once, a minute ...", file=sys.stderr, flush=True)
        )
        if self.service.num_workers > 1:
            set_num_threads(1)
        fetches = TileFetcher(self.service.fetch_s)
        return MapCache.with_memory(
            self.paths,
            lambda topomap: open_localizer(topomap, self.localizer, self.features),
            self.service.memory_mb,
            fetches.path,
        )


def read_token(path: str | None) -> str | None:
    """Read the token from a file. Raises TopolocError: it has no usable token."""
    if path is None:
        return None
    try:
        token = Path(path).read_text(encoding="utf-8").strip()
    except (OSError, ValueError) as error:
        raise TopolocError(
            f"cannot read the token in {path}: {getattr(error, 'strerror', None) or 'no text'}"
        ) from None
    if (
        len(token) < MIN_TOKEN_LENGTH
        or not token.isascii()
        or not token.isprintable()
        or " " in token
    ):
        raise TopolocError(
            f"{path}: a token has at least {MIN_TOKEN_LENGTH} letters, digits or signs, and no"
            " spaces"
        )
    return token
