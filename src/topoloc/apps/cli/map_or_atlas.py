"""What the commands that ask a map take: a map file, or an atlas."""

from __future__ import annotations

import sys
from collections.abc import Callable

from topoloc.apps.cli.features_option import localizer_of
from topoloc.apps.cli.output import UsageError
from topoloc.atlas.atlas import Atlas, is_atlas
from topoloc.atlas.atlas_localizer import AtlasLocalizer
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.open_maps import Maps
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.query_camera import CameraOfSize, named_camera
from topoloc.mapping.memory import set_node_memory
from topoloc.mapping.topomap import TopoMetricMap

__all__ = ["atlas_localizer", "camera_for", "is_atlas", "localizer_at", "open_atlas"]

MEMORY_MB = 512


def open_atlas(
    where: str, config: LocalizerConfig, features: str | None, asked: AtlasConfig
) -> AtlasLocalizer:
    """An atlas to be asked, with half of the memory for its tiles' nodes and half for the rest of
    those that are open. What is wrong with single tiles is said on standard error. Raises
    AtlasError."""
    return atlas_localizer(
        Atlas.open(where),
        config,
        features,
        asked,
        lambda text: print(f"warning: {text}", file=sys.stderr),
    )


def atlas_localizer(
    atlas: Atlas,
    config: LocalizerConfig,
    features: str | None,
    asked: AtlasConfig,
    warn: Callable[[str], None],
) -> AtlasLocalizer:
    """As `open_atlas`, of one that is read; `warn` is told what is wrong with single tiles. Raises
    AtlasError."""
    budget = MEMORY_MB * 500_000
    set_node_memory(budget)
    maps = Maps([], lambda topomap: localizer_of(topomap, config, features), budget)
    return AtlasLocalizer(atlas, maps, asked, warn)


def localizer_at(
    where: str, config: LocalizerConfig, features: str | None, asked: AtlasConfig
) -> Localizer | AtlasLocalizer:
    """Of a map or an atlas. Raises MapError, and as `localizer_of`."""
    if is_atlas(where):
        return open_atlas(where, config, features, asked)
    return localizer_of(TopoMetricMap.load(where), config, features)


def camera_for(localizer: Localizer | AtlasLocalizer, text: str) -> CameraOfSize:
    """What `--camera` says. Raises CalibrationError; UsageError of an atlas, which has no one
    camera."""
    if isinstance(localizer, Localizer):
        return named_camera(text, localizer.topomap)
    if text == "map":
        raise UsageError("--camera map: the tiles of an atlas have cameras of their own")
    return named_camera(text, None)
