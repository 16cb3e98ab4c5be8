"""Build a map together with the statistics that localization needs."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from topoloc.compiled import parallel_map
from topoloc.errors import TrajectoryError
from topoloc.features.feature_types import find_feature_type
from topoloc.geometry.rigid import Rigid3
from topoloc.geometry.transform_consensus import select_hypothesis
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.map_facts.correlated_errors import (
    ErrorShareMeasurement,
    MeasuredPoses,
)
from topoloc.localization.map_facts.repetition import digest_of
from topoloc.mapping import build
from topoloc.mapping.config import Progress
from topoloc.mapping.storage.entries import CorrelatedErrors
from topoloc.mapping.topomap import Repetitions, TopoMetricMap
from topoloc.node_ids import NodeId
from topoloc.recordings.depth_range import leave_out_stuck_depth
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import find_pose_source, keep_frames, leave_out_damaged
from topoloc.slam.depth_checks import find_depth_shift
from topoloc.slam.input_checks import check_pose_coverage, check_stereo
from topoloc.slam.measured_steps import MeasuredStep, ViewFeatures, estimate_step, extract_view
from topoloc.slam.pose_adjustment import correct_poses
from topoloc.slam.pose_checks import check_poses
from topoloc.slam.slam import run_slam
from topoloc.slam.still_part import find_still_part


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
    build`. Frames with a missing or damaged image are left out.

    Args:
        sequences: the recordings, or their paths, which `open_sequence` opens.
        progress: called with a stage's name, steps done and steps in all.
        poses_from: source of each recording's poses (`truth`, `slam`, a file), to be stored in the
            map. If it is given, SLAM is not run.
        are_poses_checked: compare the poses with the images, unless SLAM estimated them.
        is_coverage_checked: require that at least half of the frames have a pose, unless SLAM
            estimated them.
        warn: called with each note on frames that are left out, on what could not be checked, and
            on faults that images alone show. Default: Python's warnings.

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
    warn = warn or warnings.warn
    opened = [open_sequence(one) if isinstance(one, str | Path) else one for one in several]
    sequences = [leave_out_stuck_depth(leave_out_damaged(one, warn), warn) for one in opened]
    sequences = [keep_frames(one) for one in sequences]
    if poses_from is None and not all(any(sequence.poses) for sequence in sequences):
        sequences = run_slam(sequences, progress, warn).apply(sequences)
        poses_from = ["slam"] * len(sequences)
    sources = poses_from or [""] * len(sequences)
    given = [one for one, source in zip(sequences, sources, strict=True) if source != "slam"]
    for sequence in given:
        check_stereo(sequence)
        for note in (find_still_part(sequence), find_depth_shift(sequence)):
            if note is not None:
                warn(note)
        if is_coverage_checked:
            check_pose_coverage(sequence)
        if are_poses_checked:
            check_poses(sequence)
    for note in check_common_world(given) if are_poses_checked else []:
        warn(note)
    poses_from = poses_from or [find_pose_source(sequence) for sequence in sequences]
    measured = {
        (number, name): pose
        for number, sequence in enumerate(sequences)
        for name, pose in zip(sequence.names, sequence.poses, strict=True)
        if pose is not None
    }
    if are_poses_checked:
        sequences = [
            correct_poses(one, warn) if any(one is k for k in given) else one for one in sequences
        ]
    built = build.build_node_map(sequences, config, progress, poses_from)
    return with_map_statistics(built, progress, measured)


def with_map_statistics(
    topomap: TopoMetricMap,
    progress: Progress | None = None,
    measured_poses: MeasuredPoses | None = None,
) -> TopoMetricMap:
    """Return the map with its statistics (correlated errors, repetitions).

    A localizer then reads them instead of measuring them. `measured_poses` are those that were
    given, where the map's are corrected by the images: the errors of the map are in their world.
    """
    layers = {
        kind: replace(layer, shared_errors=_measure_error_share(topomap, kind, measured_poses))
        for kind, layer in topomap.layers.items()
    }
    return with_repetitions(replace(topomap, layers=layers, repetitions=None), progress)


def carry_over_error_shares(topomap: TopoMetricMap, before: TopoMetricMap) -> TopoMetricMap:
    """Return a map with the correlated errors of the map that it was `before` nodes were added. A
    localizer finds repetitions when it needs them."""
    layers = {
        kind: replace(layer, shared_errors=_error_share_of(topomap, kind).with_digest(known.rho))
        for kind, layer in topomap.layers.items()
        if (known := before.layers[kind].shared_errors) is not None
    }
    return replace(topomap, layers={**topomap.layers, **layers}, repetitions=None)


def _measure_error_share(
    topomap: TopoMetricMap, kind: str, measured_poses: MeasuredPoses | None
) -> CorrelatedErrors:
    """Measure rho of a map for a feature type."""
    share = _error_share_of(topomap, kind)
    return share.with_digest(share.measure(measured_poses))


def _error_share_of(topomap: TopoMetricMap, kind: str) -> ErrorShareMeasurement:
    c = LocalizerConfig().for_feature_type(find_feature_type(kind))
    weights = load_fitted_weights(kind)
    return ErrorShareMeasurement(topomap, kind, c.guided, c.pose, weights.shared_errors)


def with_repetitions(topomap: TopoMetricMap, progress: Progress | None = None) -> TopoMetricMap:
    """Return the map with the repetition moves of its nodes."""
    opened, moves = FeatureMap(topomap), dict[NodeId, Float[np.ndarray, "k 4 4"]]()
    for row, found in enumerate(parallel_map(opened.moves, topomap.rows)):
        if len(found):
            moves[opened.node_ids[row]] = found
        if progress is not None:
            progress("repetitions", row + 1, len(opened.node_ids))
    return replace(topomap, repetitions=Repetitions(digest_of(topomap.summaries), moves))


def check_common_world(sequences: Sequence[StereoSequence]) -> list[str]:
    """Check that the poses of recordings are in one world, as far as their images show it. Return
    one line for each recording of which no image could be compared with an earlier recording.

    Raises:
        TrajectoryError: the poses of a recording are in another world. Names the transform.
        RecordingError, CalibrationError, UnreadableImageError: a recording cannot be read.
    """
    earlier, notes = list[_Views](), list[str]()
    for sequence in sequences:
        views = _Views.from_sequence(sequence)
        results = (_compare_worlds(one, views) for one in earlier)
        if earlier and views.frames and not any(results):
            notes.append(
                f"{sequence.name}: no picture shows a place of {earlier[0].sequence.name} for"
                " sure; that their poses are of one world is not checked"
            )
        earlier.append(views)
    return notes


@dataclass(frozen=True, eq=False)
class _Views:
    """Hold sampled frames of a recording (rows, with a pose), and the features of those read."""

    sequence: StereoSequence
    frames: list[int]
    poses: dict[int, Rigid3]
    cache: dict[int, ViewFeatures] = field(default_factory=dict)

    @staticmethod
    def from_sequence(sequence: StereoSequence, num_frames: int = 16) -> _Views:
        poses = {k: pose for k, pose in enumerate(sequence.poses) if pose is not None}
        posed = list(poses) if sequence[0].camera is not None else []
        rows = np.unique(np.linspace(0, len(posed) - 1, min(num_frames, len(posed))).astype(int))
        return _Views(sequence, [posed[row] for row in rows], poses)

    def read(self, frames: set[int]) -> None:
        new = sorted(frames - self.cache.keys())
        views = parallel_map(extract_view, (self.sequence[k] for k in new))
        self.cache.update(zip(new, views, strict=True))

    def nearest(self, pose: Rigid3, max_angle: float = 0.5) -> tuple[float, int]:
        """Return distance (metres, infinite if all look elsewhere) and row of the nearest pose."""
        frames = list(self.poses)
        costs = [
            float(np.linalg.norm(one.translation)) if one.angle() < max_angle else np.inf
            for one in [pose.inverse() @ self.poses[k] for k in frames]
        ]
        row = int(np.argmin(costs))
        return costs[row], frames[row]


def _compare_worlds(one: _Views, other: _Views) -> bool:
    """Return whether images show that both are in one world. Raises TrajectoryError."""
    near = sorted((one.nearest(other.poses[k]), k) for k in other.frames)[:8]
    pairs = [(a, b) for (metres, a), b in near if metres < np.inf]
    if _is_confirmed(one, other, _measure(one, other, pairs)):
        return True
    pairs = [(a, b) for a in one.frames for b in other.frames]
    steps = _measure(one, other, pairs)
    if _is_confirmed(one, other, steps):
        return True
    _check_transform(one, other, [step for step in steps if step.has_scale])
    return False


def _measure(one: _Views, other: _Views, pairs: list[tuple[int, int]]) -> list[MeasuredStep]:
    """Return the steps of the pairs of images that match, at most one for each image of `other`."""
    one.read({a for a, _ in pairs})
    other.read({b for _, b in pairs})
    found: dict[int, MeasuredStep] = {}
    measured = parallel_map(
        lambda pair: estimate_step(*pair, one.cache[pair[0]], other.cache[pair[1]]), pairs
    )
    for step in measured:
        if step is not None and (
            step.last not in found or step.num_inliers > found[step.last].num_inliers
        ):
            found[step.last] = step
    return list(found.values())


def _errors(
    one: _Views, other: _Views, steps: Sequence[MeasuredStep], one_from_other: Rigid3
) -> np.ndarray:
    """Return the errors of the poses against the steps, if `one_from_other` relates the worlds."""
    ends = [(one.poses[step.first], one_from_other @ other.poses[step.last]) for step in steps]
    return np.array(
        [step.normalized_error(a.inverse() @ b) for step, (a, b) in zip(steps, ends, strict=True)]
    )


def _is_confirmed(one: _Views, other: _Views, steps: Sequence[MeasuredStep]) -> bool:
    # Error in units of the tolerance: poses of two recordings agree less than those of one.
    min_pairs, max_error = 3, 2.0
    errors = _errors(one, other, steps, Rigid3.identity())
    return int(np.count_nonzero(errors < max_error)) >= min_pairs


def _check_transform(one: _Views, other: _Views, steps: list[MeasuredStep]) -> None:
    """Raise TrajectoryError if most steps agree on a transform far from the identity."""
    # Number and share of the steps that agree, and error of the poses as they are.
    min_pairs, min_ratio, min_error = 3, 0.6, 4.0
    if len(steps) < min_pairs:
        return
    candidates = [
        one.poses[step.first] @ step.first_from_last @ other.poses[step.last].inverse()
        for step in steps
    ]
    agree = np.array([_errors(one, other, steps, each) < 1.0 for each in candidates])
    best, _ = select_hypothesis(agree)
    kept = [step for step, is_kept in zip(steps, agree[best], strict=True) if is_kept]
    as_is = _errors(one, other, kept, Rigid3.identity())
    if len(kept) < max(min_pairs, min_ratio * len(steps)) or np.median(as_is) < min_error:
        return
    first, second, found = one.sequence.name, other.sequence.name, candidates[best]
    w, x, y, z = found.quat_wxyz()
    numbers = ",".join(f"{number:.4g}" for number in (*found.translation, x, y, z, w))
    raise TrajectoryError(
        f"{second}: its poses are not in the world of {first}: {len(kept)} of {len(steps)} pictures"
        f" that show a place of {first} agree on {first}_from_{second} = {numbers} (X,Y,Z,QX,QY,QZ,"
        f"QW); map {first} alone, then add {second} by topoloc update, which finds this by itself"
    )
