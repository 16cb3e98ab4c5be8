"""A map that is ready to be asked: as `map/build.py` constructs it, and with what only localizing can tell of it."""

from __future__ import annotations

from collections.abc import Sequence

from topoloc.localization.localizer import LocalizerConfig
from topoloc.localization.shared_errors import with_shared_errors
from topoloc.map import build
from topoloc.map.topomap import TopoMetricMap
from topoloc.sequences.frame import StereoSequence


def build_map(
    sequences: StereoSequence | Sequence[StereoSequence],
    config: build.BuildConfig | None = None,
    progress: build.Progress | None = None,
) -> TopoMetricMap:
    """Build a topo-metric map from one or several recordings of one place whose poses share one world.

    Raises:
        ConfigError: a value of `config` is out of its bounds.
        TrajectoryError: no frame of a recording has a pose.
        EmptyMapError: no picture gave a usable node.
        RecordingError, CalibrationError, UnreadableImageError: from reading the recordings.
    """
    topomap, asked = build.build_map(sequences, config, progress), LocalizerConfig()
    return with_shared_errors(topomap, asked.guided, asked.pose, asked.shared_errors)
