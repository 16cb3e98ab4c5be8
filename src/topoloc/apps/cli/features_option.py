"""--features and --camera: the feature types and the camera of maps and queries."""

from __future__ import annotations

from typing import Annotated

from topoloc import (
    Atlas,
    AtlasConfig,
    BuildConfig,
    FeatureTypeError,
    Localizer,
    LocalizerConfig,
    TopoMetricMap,
)
from topoloc.apps.cli.output import UsageError, option, print_warning
from topoloc.apps.query_camera import CameraOfSize, parse_camera_option

BUILD_FEATURES = Annotated[str | None, option("surf|sift|learned|both|KIND[,KIND]", "both")]
QUERY_FEATURES = Annotated[
    str | None,
    option(
        "surf|learned|both|KIND[,KIND]",
        "all of the map",
        help="Feature types of the map to use, in order. The next one is used if the pose is"
        " unclear.",
    ),
]
CoarseOption = Annotated[
    str | None,
    option(
        "NAME", "the map's", help="Coarse localizer to use. `topoloc info` lists those of the map."
    ),
]


def select_build_features(config: BuildConfig, features: str | None) -> BuildConfig:
    """Return the configuration with the feature types of the option. Raises UsageError: a type is
    unknown or given twice; WeightsError: a type is not available on this machine."""
    try:
        return config.with_kinds(features)
    except FeatureTypeError as error:
        if features is None:
            raise
        raise UsageError(str(error)) from None


def open_localizer(
    source: str | TopoMetricMap | Atlas,
    config: LocalizerConfig,
    features: str | None,
    tiles: AtlasConfig | None = None,
) -> Localizer:
    """Open a map or an atlas for queries. A line on standard error names each feature type and each
    tile that cannot be used. Raises MapError: it cannot be read; FeatureTypeError: the map does not
    hold these feature types; WeightsError: a feature type cannot be used on this machine."""
    return Localizer(source, config, features=features, tiles=tiles, warn=print_warning)


def parse_camera(localizer: Localizer, text: str) -> CameraOfSize:
    """Parse the value of `--camera`. Raises CalibrationError; UsageError: `map`, and there are
    several tiles with cameras of their own."""
    if text != "map":
        return parse_camera_option(text, None)
    if len(localizer.tile_ids) > 1:
        raise UsageError("--camera map: the tiles of an atlas have cameras of their own")
    with localizer.in_tile() as in_tile:
        return parse_camera_option(text, in_tile.topomap)
