"""A map that is ready to be asked: as `map/build.py` constructs it, and with what only localizing
can tell of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from topoloc.features.bands import in_order
from topoloc.features.kinds import find_kind
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.fitted_weights import weights_of
from topoloc.localization.map_facts.correlated_errors import correlated_errors_to_keep
from topoloc.localization.map_facts.repetition import digest_of
from topoloc.localization.open_map import OpenMap
from topoloc.mapping import build
from topoloc.mapping.topomap import Repetitions, SharedErrors, TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.slam.pose_checks import check_gaps, check_poses
from topoloc.slam.slam import posed_by_slam


@dataclass(frozen=True)
class Trust:
    """What is not checked: `poses` against the pictures, and `gaps`, frames without a pose that are
    more than half of all."""

    poses: bool = False
    gaps: bool = False


def build_map(
    sequences: StereoSequence | Sequence[StereoSequence],
    config: build.BuildConfig | None = None,
    progress: build.Progress | None = None,
    poses_from: Sequence[str] | None = None,
    trust: Trust | None = None,
) -> TopoMetricMap:
    """Build a topo-metric map from one or several recordings of one place whose poses share one
    world.

    Where a recording has no poses at all, those of all of them are found by SLAM, as `topoloc
    build` does.

    Args:
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
        find_kind(kind)
    sequences, trust = (
        [sequences] if isinstance(sequences, StereoSequence) else list(sequences),
        trust or Trust(),
    )
    if poses_from is None and not all(any(sequence.poses) for sequence in sequences):
        sequences, poses_from = (
            posed_by_slam(sequences, progress=progress),
            ["slam"] * len(sequences),
        )
    for k, sequence in enumerate(sequences):
        is_slams = poses_from is not None and poses_from[k] == "slam"
        if not (trust.gaps or is_slams):
            check_gaps(sequence)
        if not (trust.poses or is_slams):
            check_poses(sequence)
    return with_map_facts(build.build_map(sequences, config, progress, poses_from), progress)


def with_map_facts(topomap: TopoMetricMap, progress: build.Progress | None = None) -> TopoMetricMap:
    """The map with what localizing needs to know of it as a whole, so that who opens its file need
    not measure it."""
    topomap = replace(topomap, shared_errors=None, other_shared_errors={}, repetitions=None)
    errors = {kind: _correlated_errors(topomap.by_kind(kind)) for kind in topomap.kinds}
    topomap = replace(topomap, shared_errors=errors.pop(topomap.kind), other_shared_errors=errors)
    return with_repetitions(topomap, progress)


def _correlated_errors(topomap: TopoMetricMap) -> SharedErrors:
    """rho of a map by its first kind of features, so that who opens its file need not measure
    it."""
    asked = LocalizerConfig().for_kind(find_kind(topomap.kind))
    return correlated_errors_to_keep(
        topomap,
        asked.guided,
        asked.pose,
        asked.correlated_errors,
        weights_of(topomap.kind).shared_errors,
    )


def with_repetitions(
    topomap: TopoMetricMap, progress: build.Progress | None = None
) -> TopoMetricMap:
    """The map, told by which moves its nodes are found elsewhere in it."""
    opened, moves = OpenMap(topomap), dict[int, Float[np.ndarray, "k 4 4"]]()
    for row, found in enumerate(in_order(opened.moves, range(len(opened.node_ids)))):
        if len(found):
            moves[opened.node_ids[row]] = found
        if progress is not None:
            progress("repetitions", row + 1, len(opened.node_ids))
    return replace(topomap, repetitions=Repetitions(digest_of(topomap.summaries), moves))
