"""Check the stereo pairs of a recording for faults that would give a wrong map. Measure the
residuals of SLAM in right images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from topoloc.compiled import parallel_map
from topoloc.errors import CalibrationError, RecordingError, TrajectoryError
from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.features import MatchingConfig
from topoloc.features.matching import match_features
from topoloc.geometry.pose_conventions import UNITS
from topoloc.points.metric_points import MeasuredView
from topoloc.points.point_tracking import align_with_reference
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import find_depth_units
from topoloc.slam.keyframes import KeyFrame, Landmarks

PairMatches = tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "2"]]
"""x and y of matched features of a pair on the plane z = 1, in the left and in the right rectified
image, and the focal lengths (pixels) of these images."""

_MIN_NUM_PAIRS = 24  # that are matched, spread over the recording


def check_stereo(sequence: StereoSequence) -> list[PairMatches]:
    """Check that the left and right images of a recording are rectified pairs in the right order.

    Features of some pairs, spread over the recording, are matched over the whole images. Other
    recordings, and pairs with too few matches, pass. Return the matches of these pairs.

    Raises:
        CalibrationError: the baseline cannot be in metres.
        RecordingError: no frames; left and right are swapped, or no rectified pairs of one moment;
            a stretch of it has no pairs, for a camera lost an image.
        UnreadableImageError: an image cannot be read.
    """
    max_baseline = 5.0  # metres; a larger one is assumed to be in millimetres
    # Maximum vertical distance of left and right points (median), pixels and share of the width.
    max_vertical_px, max_vertical_share = 0.9, 0.001
    min_good_share = 0.15  # of the pairs, if others are none
    if not len(sequence):
        raise RecordingError(f"{sequence.name}: no frames")
    if (rig := sequence[0].rig) is None:
        return []
    if rig.baseline > max_baseline:
        raise CalibrationError(
            f"{sequence.name}: a baseline of {rig.baseline:g} m; is it in millimetres"
            f" ({rig.baseline / 1000:.4g} m) or centimetres ({rig.baseline / 100:.4g} m)?"
        )
    rows = _spread(sequence, min(100, max(_MIN_NUM_PAIRS, len(sequence) // 10)))
    pairs = list(parallel_map(_match_pair, (sequence[k] for k in rows)))
    shifts = [_shifts_px(*pair) for pair in pairs]
    is_left, vertical = _compare_pairs(shifts)
    is_pair = not vertical > max(max_vertical_px, max_vertical_share * rig.left.width)
    if not is_pair and is_left:  # rectified, swapped images are no pairs
        exchanged = parallel_map(_match_pair, (_exchange(sequence[k]) for k in rows[::3]))
        is_left = not _compare_pairs([_shifts_px(*one) for one in exchanged])[1] < 0.5 * vertical
    if not is_left:
        raise RecordingError(
            f"{sequence.name}: left and right pictures are swapped: points lie further right in the"
            " right ones; exchange the two folders or topics"
        )
    are_pairs = [_is_pair(one, rig.left.width) for one in shifts]
    if is_pair or np.mean(are_pairs) > min_good_share:
        most = len(sequence) if is_pair else 1  # few pairs among others match by chance
        _check_stretches(sequence, list(zip(rows, are_pairs, strict=True)), most)
    if not is_pair:
        raise RecordingError(
            f"{sequence.name}: left and right pictures are no pairs: the same points are"
            f" {vertical:.1f} px apart vertically (median); taken at different moments, or not"
            " rectified as calibrated?"
        )
    return pairs


def _spread(sequence: StereoSequence, num: int) -> list[int]:
    return np.unique(np.linspace(0, len(sequence) - 1, num).astype(int)).tolist()


def _check_stretches(
    sequence: StereoSequence, checked: Sequence[tuple[int, bool]], most: int
) -> None:
    """Raise RecordingError if two pairs in a row, or more, are none, in at most so many stretches.
    Names the first frame."""
    stretches, last = list[tuple[int, int]](), (-1, True)
    for pair, following in zip(checked, [*checked[1:], (len(sequence), True)], strict=True):
        is_alone = last[1] and following[1]  # one pair may have been matched wrongly
        if not pair[1] and not is_alone:
            if last[1]:
                stretches.append((_find_change(sequence, last[0], pair[0]), 0))
            if following[1]:
                end = _find_change(sequence, following[0], pair[0])
                stretches[-1] = stretches[-1][0], end
        last = pair
    if not 0 < len(stretches) <= most:
        return
    edges = [0, *(edge for stretch in stretches for edge in stretch), len(sequence)]
    parts = zip(edges[::2], edges[1::2], strict=True)
    others = ",".join(f"{first}:{end}" for first, end in parts if first < end)
    first, end = stretches[0]
    raise RecordingError(
        f"{sequence.name}: left and right pictures of frames {first} to {end - 1} are no pairs of"
        f" one moment: a camera lost a picture at {sequence.names[first]}, or its clock jumped;"
        f" remove the picture without a partner, or map the others: {sequence.name}@{others}"
    )


def _find_change(sequence: StereoSequence, good: int, bad: int) -> int:
    """Return where a stretch without pairs begins, or ends (exclusive), between a row with a pair
    and one without."""
    rig = sequence[bad].rig
    while rig is not None and abs(good - bad) > 1:
        middle = (good + bad) // 2
        if _is_pair(_shifts_px(*_match_pair(sequence[middle])), rig.left.width):
            good = middle
        else:
            bad = middle
    return max(good, bad)


def _is_pair(shifts: Float[np.ndarray, "n 2"], width: int) -> bool:
    """Return whether two images may be a pair. Right pairs of KITTI, ZED and EuRoC are up to 0.7 px
    apart, those of two moments 3 to 14 px."""
    min_matches, max_px, max_share = 30, 2.0, 0.002
    vertical = np.median(np.abs(shifts[:, 1])) if len(shifts) >= min_matches else 0.0
    return bool(vertical < max(max_px, max_share * width))


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


def _compare_pairs(matched: Sequence[Float[np.ndarray, "_ 2"]]) -> tuple[bool, float]:
    """Return whether the points of left images lie further left in the right ones, as they must,
    and how far they are apart vertically (median, pixels). Too few matches give True and NaN."""
    min_matches, min_shift_px, max_swapped_share = 40, 1.5, 0.8
    shifts = np.concatenate(matched)
    if len(shifts) < min_matches:
        return True, float("nan")
    moved = shifts[np.abs(shifts[:, 0]) > min_shift_px, 0]
    is_left = len(moved) < min_matches or float(np.mean(moved < 0.0)) < max_swapped_share
    return is_left, float(np.median(np.abs(shifts[:, 1])))


def find_left_out_lens(
    sequence: StereoSequence, pairs: Sequence[PairMatches] | None = None
) -> str | None:
    """Return a note if the points of pairs ask for a lens that the calibration leaves out. None if
    there are no pairs, or they do not decide. `pairs` are those of `check_stereo`, if it was called
    before. Raises as the recording.

    Of a point (x, y) on the plane z = 1 with disparity d, a lens of radial coefficient k moves the
    two images apart vertically by 2 k x y d. A wrong rotation, focal length or direction of the
    baseline moves them by other functions of x, y and d.
    """
    # k of right recordings of ZED, KITTI, EuRoC and the demo: up to 0.03
    min_pairs, min_matches, min_k = 8, 60, 0.07
    if not len(sequence) or sequence[0].rig is None:
        return None
    if pairs is None:
        rows = _spread(sequence, _MIN_NUM_PAIRS)
        pairs = list(parallel_map(_match_pair, (sequence[k] for k in rows)))
    pairs = pairs[:: max(1, len(pairs) // _MIN_NUM_PAIRS)]
    matched = [one for one, _ in pairs if len(one) >= min_matches]
    if len(matched) < min_pairs:
        return None
    k, alone = _fit_lens(np.concatenate(matched)), np.array([_fit_lens(one) for one in matched])
    scatter = 1.4826 * float(np.median(np.abs(alone - np.median(alone))))
    if abs(k) - 2.5 * scatter / np.sqrt(len(alone)) < min_k:
        return None
    return (
        f"{sequence.name}: a lens bends the pictures, and the calibration leaves it out: the pairs"
        f" ask for a k1 of about {k:.2f}; calibrate both cameras with their distortion (OPENCV, or"
        " OPENCV_FISHEYE of a wide lens)"
    )


def _fit_lens(matches: Float[np.ndarray, "n 4"]) -> float:
    """Return the radial coefficient that explains the vertical distances of left and right points
    (x, y of each on the plane z = 1) best, by weighted least squares."""
    num_steps, scale = 20, 1.0
    left, right = matches[:, :2], matches[:, 2:]
    (x, y), (disparity, down) = (0.5 * (left + right)).T, (left - right).T
    lens = 2.0 * x * y * disparity
    others = np.ones_like(x), x, y, x * y, y * y, disparity, y * disparity
    columns, solution = np.column_stack([lens, *others]), np.zeros(8)
    for _ in range(num_steps):
        errors = down - columns @ solution
        near = np.abs(errors) <= np.quantile(np.abs(errors), 0.9)
        scale = max(2.0 * 1.4826 * float(np.median(np.abs(errors[near]))), 1e-5)
        weights = near / (1.0 + (errors / scale) ** 2)
        solution = np.linalg.lstsq(columns * weights[:, None], down * weights, rcond=None)[0]
    return float(solution[0])


def _shifts_px(
    matches: Float[np.ndarray, "n 4"], focal_px: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "n 2"]:
    """Return how far features of a pair lie left, and below, of where the right image shows them,
    pixels. A point at infinity has 0."""
    return (matches[:, :2] - matches[:, 2:]) * focal_px


def _match_pair(frame: StereoFrame) -> PairMatches:
    view = prepare_frame(frame)
    if view.right_grey is None or view.rig is None:
        return np.zeros((0, 4)), np.ones(2)
    left, right = (
        extract_features(grey, FeatureConfig(max_features=500))
        for grey in (view.grey, view.right_grey)
    )
    matching = MatchingConfig(ratio=find_feature_type("surf").ratio)
    matches = match_features(left.descriptors, right.descriptors, matching)
    points = left.points_img[matches.query_idx], right.points_img[matches.train_idx]
    cameras = view.rig.left, view.rig.right
    both = [one.normalized_from_img(seen) for one, seen in zip(cameras, points, strict=True)]
    return np.hstack(both), np.array([view.rig.left.fx, view.rig.left.fy])


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
