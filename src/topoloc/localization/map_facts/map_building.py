"""A map that is ready to be asked: as `map/build.py` constructs it, and with what only localizing
can tell of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from topoloc.mapping.topomap import CorrelatedErrors, Repetitions, TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.slam.pose_checks import check_pose_coverage, check_poses
from topoloc.slam.slam import estimate_slam_poses


@dataclass(frozen=True)
class SkippedChecks:
    """What is not checked: `poses` against the pictures, and `gaps`, frames without a pose that are
    more than half of all."""

    poses: bool = False
    gaps: bool = False


def build_map(
    sequences: StereoSequence | str | Path | Sequence[StereoSequence | str | Path],
    config: build.BuildConfig | None = None,
    progress: build.Progress | None = None,
    poses_from: Sequence[str] | None = None,
    skipped_checks: SkippedChecks | None = None,
) -> TopoMetricMap:
    """Build a topo-metric map from one or several recordings of one place whose poses share one
    world.

    Where a recording has no poses at all, those of all of them are found by SLAM, as `topoloc
    build` does.

    Args:
        sequences: the recordings, or their paths, which `open_sequence` opens.
        poses_from: where the poses of each recording come from (`truth`, `slam`, a file), for the
            map to remember; given, SLAM is not run.
        trust: what is taken as it comes; by default poses are held against the pictures, but for
            those that SLAM found in them.

    Raises:
        ConfigError: a value of `config` is out of its bounds.
        TrajectoryError: fewer than half of a recording's frames have a pose, or the poses do not
            fit the pictures.
        EmptyMapError: no picture gave a usable node.
        FeatureKindError: no features of the kind that `config` names.
        RecordingError, CalibrationError, UnreadableImageError: from reading the recordings.
    """
    config = config or build.BuildConfig()
    for kind in config.kinds:
        find_feature_type(kind)
    given = [sequences] if isinstance(sequences, StereoSequence | str | Path) else sequences
    sequences = [open_sequence(one) if isinstance(one, str | Path) else one for one in given]
    skipped_checks = skipped_checks or SkippedChecks()
    if poses_from is None and not all(any(sequence.poses) for sequence in sequences):
        sequences, poses_from = (
            estimate_slam_poses(sequences, progress=progress),
            ["slam"] * len(sequences),
        )
    for k, sequence in enumerate(sequences):
        is_from_slam = poses_from is not None and poses_from[k] == "slam"
        if not (skipped_checks.gaps or is_from_slam):
            check_pose_coverage(sequence)
        if not (skipped_checks.poses or is_from_slam):
            check_poses(sequence)
    return with_map_statistics(build.build_map(sequences, config, progress, poses_from), progress)


def with_map_statistics(
    topomap: TopoMetricMap, progress: build.Progress | None = None
) -> TopoMetricMap:
    """The map with what localizing needs to know of it as a whole, so that who opens its file need
    not measure it."""
    topomap = replace(topomap, shared_errors=None, other_shared_errors={}, repetitions=None)
    errors = {kind: _measure_error_share(topomap.with_feature_type(kind)) for kind in topomap.kinds}
    topomap = replace(topomap, shared_errors=errors.pop(topomap.kind), other_shared_errors=errors)
    return with_repetitions(topomap, progress)


def _measure_error_share(topomap: TopoMetricMap) -> CorrelatedErrors:
    """rho of a map by its first kind of features, so that who opens its file need not measure
    it."""
    config_of_type = LocalizerConfig().for_feature_type(find_feature_type(topomap.kind))
    return measure_stored_error_share(
        topomap,
        config_of_type.guided,
        config_of_type.pose,
        config_of_type.correlated_errors,
        load_fitted_weights(topomap.kind).shared_errors,
    )


def with_repetitions(
    topomap: TopoMetricMap, progress: build.Progress | None = None
) -> TopoMetricMap:
    """The map, told by which moves its nodes are found elsewhere in it."""
    opened, moves = OpenMap(topomap), dict[int, Float[np.ndarray, "k 4 4"]]()
    for row, found in enumerate(parallel_map(opened.moves, range(len(opened.node_ids)))):
        if len(found):
            moves[opened.node_ids[row]] = found
        if progress is not None:
            progress("repetitions", row + 1, len(opened.node_ids))
    return replace(topomap, repetitions=Repetitions(digest_of(topomap.summaries), moves))
