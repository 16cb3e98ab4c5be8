"""Build a map together with the statistics that localization needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc.features.feature_types import find_feature_type
from topoloc.features.parallel import parallel_map
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.map_facts.correlated_errors import measure_stored_error_share
from topoloc.localization.map_facts.repetition import digest_of
from topoloc.localization.open_map import OpenMap
from topoloc.mapping import build
from topoloc.mapping.config import Progress
from topoloc.mapping.topomap import CorrelatedErrors, Repetitions, TopoMetricMap
from topoloc.node_ids import NodeId
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.slam.input_checks import check_stereo
from topoloc.slam.pose_checks import check_pose_coverage, check_poses
from topoloc.slam.slam import estimate_slam_poses
from topoloc.slam.world_checks import check_common_world


def build_map(
    sequences: StereoSequence | str | Path | Sequence[StereoSequence | str | Path],
    config: build.BuildConfig | None = None,
    progress: Progress | None = None,
    poses_from: Sequence[str] | None = None,
    are_poses_checked: bool = True,
    is_coverage_checked: bool = True,
    warn: Callable[[str], object] | None = None,
) -> TopoMetricMap:
    """Build a topo-metric map from recordings whose poses share one world frame.

    If a recording has no poses at all, SLAM estimates those of all recordings, as in `topoloc
    build`.

    Args:
        sequences: the recordings, or their paths, which `open_sequence` opens.
        poses_from: source of each recording's poses (`truth`, `slam`, a file), to be stored in the
            map. If it is given, SLAM is not run.
        are_poses_checked: compare the poses with the images, unless SLAM estimated them.
        is_coverage_checked: require that at least half of the frames have a pose, unless SLAM
            estimated them.
        warn: called with each note on what could not be checked.

    Raises:
        ConfigError: a value of `config` is out of bounds.
        TrajectoryError: fewer than half of a recording's frames have a pose, the poses do not fit
            the images, or those of two recordings are in different worlds.
        EmptyMapError: no image gave a usable node.
        FeatureTypeError: `config` names an unknown feature type.
        RecordingError, CalibrationError, UnreadableImageError: a recording cannot be read.
    """
    config = config or build.BuildConfig()
    for kind in config.kinds:
        find_feature_type(kind)
    several = [sequences] if isinstance(sequences, StereoSequence | str | Path) else sequences
    sequences = [open_sequence(one) if isinstance(one, str | Path) else one for one in several]
    if poses_from is None and not all(any(sequence.poses) for sequence in sequences):
        sequences, poses_from = (
            estimate_slam_poses(sequences, progress=progress),
            ["slam"] * len(sequences),
        )
    sources = poses_from or [""] * len(sequences)
    given = [one for one, source in zip(sequences, sources, strict=True) if source != "slam"]
    for sequence in given:
        check_stereo(sequence)
        if is_coverage_checked:
            check_pose_coverage(sequence)
        if are_poses_checked:
            check_poses(sequence)
    for note in check_common_world(given) if are_poses_checked else []:
        if warn is not None:
            warn(note)
    return with_map_statistics(build.build_map(sequences, config, progress, poses_from), progress)


def with_map_statistics(topomap: TopoMetricMap, progress: Progress | None = None) -> TopoMetricMap:
    """Return the map with its statistics (correlated errors, repetitions).

    A localizer then reads them instead of measuring them.
    """
    layers = {
        kind: replace(layer, shared_errors=_measure_error_share(topomap, kind))
        for kind, layer in topomap.layers.items()
    }
    return with_repetitions(replace(topomap, layers=layers, repetitions=None), progress)


def _measure_error_share(topomap: TopoMetricMap, kind: str) -> CorrelatedErrors:
    """Measure rho of a map for a feature type."""
    config_of_type = LocalizerConfig().for_feature_type(find_feature_type(kind))
    return measure_stored_error_share(
        topomap,
        kind,
        config_of_type.guided,
        config_of_type.pose,
        load_fitted_weights(kind).shared_errors,
    )


def with_repetitions(topomap: TopoMetricMap, progress: Progress | None = None) -> TopoMetricMap:
    """Return the map with the repetition moves of its nodes."""
    opened, moves = OpenMap(topomap), dict[NodeId, Float[np.ndarray, "k 4 4"]]()
    for row, found in enumerate(parallel_map(opened.moves, topomap.rows)):
        if len(found):
            moves[opened.node_ids[row]] = found
        if progress is not None:
            progress("repetitions", row + 1, len(opened.node_ids))
    return replace(topomap, repetitions=Repetitions(digest_of(topomap.summaries), moves))
