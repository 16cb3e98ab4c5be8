"""What the commands that ask a map take: a map file, or an atlas."""

from __future__ import annotations

import sys
from collections.abc import Callable

from topoloc import (
    Atlas,
    AtlasConfig,
    AtlasLocalizer,
    Localizer,
    LocalizerConfig,
    MapCache,
    TopoMetricMap,
    is_atlas,
)
from topoloc.apps.cli.features_option import create_localizer
from topoloc.apps.cli.output import UsageError
from topoloc.apps.query_camera import CameraOfSize, parse_camera_option

__all__ = ["atlas_localizer", "is_atlas", "open_atlas", "open_localizer", "parse_camera"]

MEMORY_MB = 512


def open_atlas(
    where: str, config: LocalizerConfig, features: str | None, atlas_config: AtlasConfig
) -> AtlasLocalizer:
    """An atlas to be asked, with half of the memory for its tiles' nodes and half for the rest of
    those that are open. What is wrong with single tiles is said on standard error. Raises
    AtlasError."""
    return atlas_localizer(
        Atlas.open(where),
        config,
        features,
        atlas_config,
        lambda text: print(f"warning: {text}", file=sys.stderr),
    )


def atlas_localizer(
    atlas: Atlas,
    config: LocalizerConfig,
    features: str | None,
    atlas_config: AtlasConfig,
    warn: Callable[[str], None],
) -> AtlasLocalizer:
    """As `open_atlas`, of one that is read; `warn` is told what is wrong with single tiles. Raises
    AtlasError."""
    maps = MapCache.with_memory(
        [], lambda topomap: create_localizer(topomap, config, features), MEMORY_MB
    )
    return AtlasLocalizer(atlas, maps, atlas_config, warn)


def open_localizer(
    where: str, config: LocalizerConfig, features: str | None, atlas_config: AtlasConfig
) -> Localizer | AtlasLocalizer:
    """Of a map or an atlas. Raises MapError, and as `create_localizer`."""
    if is_atlas(where):
        return open_atlas(where, config, features, atlas_config)
    return create_localizer(TopoMetricMap.load(where), config, features)


def parse_camera(localizer: Localizer | AtlasLocalizer, text: str) -> CameraOfSize:
    """What `--camera` says. Raises CalibrationError; UsageError of an atlas, which has no one
    camera."""
    if isinstance(localizer, Localizer):
        return parse_camera_option(text, localizer.topomap)
    if text == "map":
        raise UsageError("--camera map: the tiles of an atlas have cameras of their own")
    return parse_camera_option(text, None)
