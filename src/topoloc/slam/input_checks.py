"""Check the stereo pairs of a recording for faults that would give a wrong map. Measure the
residuals of SLAM in right images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.errors import CalibrationError, RecordingError, TrajectoryError
from topoloc.features.config import MatchingConfig
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.matching import match_features
from topoloc.features.parallel import parallel_map
from topoloc.geometry.pose_conventions import UNITS
from topoloc.points.metric_points import MeasuredView
from topoloc.points.point_tracking import align_with_reference
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import find_depth_units
from topoloc.slam.keyframes import KeyFrame, Landmarks


def check_stereo(sequence: StereoSequence, num_frames: int = 8) -> None:
    """Check that the left and right images of a recording are rectified pairs in the right order.

    Features of `num_frames` pairs, spread over the recording, are matched over the whole images.
    Other recordings, and pairs with too few matches, pass.

    Raises:
        CalibrationError: the baseline cannot be in metres.
        RecordingError: no frames; left and right are swapped, or no rectified pairs of one moment.
        UnreadableImageError: an image cannot be read.
    """
    max_baseline = 5.0  # metres; a larger one is assumed to be in millimetres
    # Maximum vertical distance of left and right points (median), pixels and share of the width.
    max_vertical_px, max_vertical_share = 0.9, 0.001
    if not len(sequence):
        raise RecordingError(f"{sequence.name}: no frames")
    if (rig := sequence[0].rig) is None:
        return
    if rig.baseline > max_baseline:
        raise CalibrationError(
            f"{sequence.name}: a baseline of {rig.baseline:g} m; is it in millimetres"
            f" ({rig.baseline / 1000:.4g} m) or centimetres ({rig.baseline / 100:.4g} m)?"
        )
    chosen = np.unique(np.linspace(0, len(sequence) - 1, num_frames).astype(int)).tolist()
    is_left, vertical = _compare_pairs(sequence[k] for k in chosen)
    is_pair = not vertical > max(max_vertical_px, max_vertical_share * rig.left.width)
    if not is_pair and is_left:  # rectified, swapped images are no pairs
        is_left = not _compare_pairs(_exchange(sequence[k]) for k in chosen)[1] < 0.5 * vertical
    if not is_left:
        raise RecordingError(
            f"{sequence.name}: left and right pictures are swapped: points lie further right in the"
            " right ones; exchange the two folders or topics"
        )
    if not is_pair:
        raise RecordingError(
            f"{sequence.name}: left and right pictures are no pairs: the same points are"
            f" {vertical:.1f} px apart vertically (median); taken at different moments, or not"
            " rectified as calibrated?"
        )


def _exchange(frame: StereoFrame) -> StereoFrame:
    return frame if frame.right is None else replace(frame, image=frame.right, right=frame.image)


def check_pose_coverage(sequence: StereoSequence) -> None:
    """Raise TrajectoryError if some frames have a pose, but less than half of them."""
    num_posed = sum(pose is not None for pose in sequence.poses)
    if 0 < 2 * num_posed < len(sequence):
        raise TrajectoryError(
            f"{sequence.name}: only {num_posed} of {len(sequence)} frames have a pose; --allow-gaps"
            " maps these, without the others"
        )


def add_calibration(looks: str, sequence: StereoSequence, conventions: Sequence[str]) -> str:
    """Add the calibration that explains another unit of poses as well to their description. It is
    named first if the unit is not a common one."""
    # Common depth factors (units per metre), preferred to others that are nearly the same.
    common, max_ratio = (100.0, 256.0, 1000.0, 4000.0, 5000.0, 10000.0), 1.15
    max_factor = 20.0  # no wrong calibration explains more
    unit = next((name for name in conventions if name in UNITS or name.startswith("scale")), None)
    factor = UNITS.get(unit) or float(unit.removeprefix("scale=")) if unit else 0.0
    rig, units = sequence[0].rig, find_depth_units(sequence)
    if not 1.0 / max_factor < factor < max_factor or (rig is None and units is None):
        return looks
    if rig is not None:
        right = f"a baseline of {rig.baseline / factor:.4g} m, not {rig.baseline:.4g},"
    else:
        found = (units or 1.0) * factor
        near = min(common, key=lambda one: max(one / found, found / one))
        found = near if 1.0 / max_ratio < near / found < max_ratio else found
        right = f'a "depth_factor" of {found:.4g}, not {units:g},'
    others = ",".join(name for name in conventions if name != unit)
    right += f" and --poses {others}" * bool(others)
    explains = f"if the poses are in metres, {right} explains it"
    return f"{looks}; or, {explains}" if unit in UNITS else f"{explains}; otherwise {looks}"


def _compare_pairs(frames: Iterable[StereoFrame]) -> tuple[bool, float]:
    """Return whether the points of left images lie further left in the right ones, as they must,
    and how far they are apart vertically (median, pixels). Too few matches give True and NaN."""
    min_matches, min_shift_px, max_swapped_share = 40, 1.5, 0.8
    shifts = np.concatenate(list(parallel_map(_match_pair, frames)))
    if len(shifts) < min_matches:
        return True, float("nan")
    moved = shifts[np.abs(shifts[:, 0]) > min_shift_px, 0]
    is_left = len(moved) < min_matches or float(np.mean(moved < 0.0)) < max_swapped_share
    return is_left, float(np.median(np.abs(shifts[:, 1])))


def _match_pair(frame: StereoFrame) -> Float[np.ndarray, "n 2"]:
    """Return how far features lie left, and below, of where the right image shows them, pixels. A
    point at infinity has 0."""
    view = prepare_frame(frame)
    if view.right_grey is None or view.rig is None:
        return np.zeros((0, 2))
    left, right = (
        extract_features(grey, FeatureConfig(max_features=500))
        for grey in (view.grey, view.right_grey)
    )
    matching = MatchingConfig(ratio=find_feature_type("surf").ratio)
    matches = match_features(left.descriptors, right.descriptors, matching)
    shifts = left.points_img[matches.query_idx] - right.points_img[matches.train_idx]
    return shifts - np.array([view.rig.left.cx - view.rig.right.cx, 0.0])


def measure_right_residuals(
    keyframe: KeyFrame, landmarks: Landmarks, measured: MeasuredView
) -> Float[np.ndarray, " n"]:
    """Return the distances between measured and predicted landmarks in the right image of a key
    frame, pixels. NaN if not found."""
    sampled_points = 80
    seen = keyframe.observations
    rows = np.flatnonzero(seen.active & (seen.weights[:, 2] > 0.0))
    rows = rows[:: max(1, len(rows) // sampled_points)]
    if measured.right is None or measured.view.rig is None or len(rows) == 0:
        return np.zeros(0)
    at_infinity = measured.view.rig.left.cx - measured.view.rig.right.cx
    to_right = np.column_stack([-seen.measured[rows, 2] - at_infinity, np.zeros(len(rows))])
    points = seen.measured[rows, :2]
    found = align_with_reference(
        measured.left,
        measured.right,
        points.astype(np.float32),
        (points + to_right).astype(np.float32),
        np.ones(len(rows), np.float32),
        max_shift_px=5.0,
    )
    places = np.where(found.is_matched[:, None], found.points_img, np.nan).astype(np.float64)
    expected = keyframe.stereo.project(
        keyframe.cam_from_world.apply(landmarks.positions[seen.landmark_ids[rows]])
    )
    to_right = np.column_stack(
        [expected[:, 2] + keyframe.bias.value_px + at_infinity, np.zeros(len(rows))]
    )
    return np.linalg.norm(places - (expected[:, :2] - to_right), axis=1)
