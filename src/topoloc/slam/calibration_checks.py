"""Check focal length, baseline, depth factor and kind of depth of a recording: errors of some
percent that no single step between images shows, but all of them together.

A wrong focal length bends the points of a frame, so that they fit another image less well after a
rotation. A wrong baseline or depth factor changes depth, but not the depth by the motion between
two poses; another unit of the poses changes the second alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from jaxtyping import Float

from topoloc.errors import CalibrationError, TrajectoryError
from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.pose_matches import PoseMatches, squared_errors
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.calibration import camera_from_intrinsics
from topoloc.recordings.frame import StereoSequence
from topoloc.slam.depth_checks import find_depth_shift, find_late_depth
from topoloc.slam.input_checks import PairMatches, add_calibration, find_left_out_lens
from topoloc.slam.measured_steps import MatchedPoints, MeasuredStep, measure_steps
from topoloc.slam.still_part import find_still_part

_MIN_STEPS = 5


def check_calibration(
    sequence: StereoSequence, steps: Sequence[MeasuredStep], are_poses_right: bool
) -> None:
    """Check the calibration of a recording by steps between its images, and by its poses if these
    are right but for some percent. Raises TrajectoryError with the value that fits. Single cameras
    pass."""
    unchecked = "--poses unchecked maps it all the same"
    if (problem := _find_focal_problem(sequence, steps)) is not None:
        raise TrajectoryError(f"{problem}; {unchecked}")
    scale = estimate_scale_error(steps, sequence.poses) if are_poses_right else None
    if scale is None:
        return
    looks = f"the poses are of another unit than the metre: --poses scale={scale:.4g}"
    explained = add_calibration(looks, sequence, [f"scale={scale:.4g}"])
    if len(_estimate_focal_errors(steps)) < _MIN_STEPS:
        explained += ", or the focal length is wrong, which a straight trajectory does not show"
    raise TrajectoryError(
        f"{sequence.name}: depth is {abs(100.0 * (scale - 1.0)):.0f} %"
        f" {'more' if scale > 1.0 else 'less'} than the motion of the poses shows; {explained};"
        f" {unchecked}"
    )


def find_image_faults(
    sequence: StereoSequence, pairs: Sequence[PairMatches] | None = None
) -> list[str]:
    """Return a note for each fault of a recording without poses that its images or times show.
    `pairs` are those of `check_stereo`, if it was called before. Raises as the recording."""
    max_interval_s = 10.0  # median; a longer one is of another unit than the second
    interval = float(np.median(np.diff(sequence.t_ns))) / 1e9 if len(sequence) > 1 else 0.0
    is_single = sequence[0].right is None and sequence[0].depth is None
    steps = [] if is_single else measure_steps(sequence, list(range(len(sequence))))
    notes = [find_still_part(sequence), find_depth_shift(sequence), find_late_depth(sequence)]
    bent = find_left_out_lens(sequence, pairs) or _find_ray_depth(sequence, steps)
    # both look like another focal length, too
    notes.append(bent or _find_focal_problem(sequence, steps))
    if (camera := sequence[0].camera) is not None:
        try:
            camera_from_intrinsics(*camera.intrinsics, camera.width, camera.height)
        except CalibrationError as error:
            fault, factor = str(error).partition(" (")[0], camera.width / (2.0 * camera.cx + 1.0)
            notes.append(f"{sequence.name}: {fault}; multiply them by {factor:.3g}")
    if interval > max_interval_s:
        unit = "milliseconds" if interval < 1e4 else "micro- or nanoseconds"
        between = f"{interval:.4g} s from picture to picture (median)"
        notes.append(f"{sequence.name}: {between}; are the times in {unit}? Write seconds")
    return [note for note in notes if note is not None]


def _find_focal_problem(sequence: StereoSequence, steps: Sequence[MeasuredStep]) -> str | None:
    min_log = 0.075  # right recordings of ZED, KITTI and 7-Scenes: up to 0.058
    logs = np.array(_estimate_focal_errors(steps))
    camera, focal = sequence[0].camera, float(np.median(logs)) if len(logs) else 0.0
    # of corridors some steps fit another focal length best, by any factor: no normal errors
    num_beyond = int(np.count_nonzero(logs * math.copysign(1.0, focal) > min_log))
    chance = sum(math.comb(len(logs), k) for k in range(num_beyond, len(logs) + 1)) / 2 ** len(logs)
    if camera is None or chance > 0.05:
        return None
    return (
        f"{sequence.name}: a focal length of about {camera.fx / math.exp(focal):.4g} px fits the"
        f" pictures, not {camera.fx:.4g}; calibrate the camera again, or correct fx and fy"
    )


def _estimate_focal_errors(steps: Sequence[MeasuredStep]) -> list[float]:
    """Return the logarithms of the stated focal length over the right one, of the steps that show
    it."""
    found = [step.points and _fit_focal(step.points) for step in steps]
    return [log for log in found if log is not None]


def estimate_scale_error(
    steps: Sequence[MeasuredStep], poses: Sequence[Rigid3 | None]
) -> float | None:
    """Return depth over that by the motion of poses (world_from_cam, one for each frame). None if
    it is 1, or the images do not decide."""
    min_log = 0.07  # right recordings of ZED, KITTI and 7-Scenes: up to 0.06
    ratios = list[Float[np.ndarray, " 3"]]()
    for step in steps:
        first, last = poses[step.first], poses[step.last]
        if step.points is None or first is None or last is None:
            continue
        given = first.inverse() @ last
        if step.normalized_error(given) >= 1.0 and not step.decides_on(given):
            continue  # equal panels
        if (ratio := _depth_ratios(step.points, given)) is not None:
            ratios.append(ratio)
    if len(ratios) < _MIN_STEPS:
        return None
    (low, sigma), (scale, _), (high, _) = (_median(column) for column in zip(*ratios, strict=True))
    return math.exp(scale) if max(low, -high) - 3.0 * sigma > min_log else None


def _median(logs: Sequence[float]) -> tuple[float, float]:
    """Return the median and its standard deviation, by the scatter of the values. It is infinite
    for few values."""
    if len(logs) < _MIN_STEPS:
        return 0.0, math.inf
    median = float(np.median(logs))
    scatter = 1.4826 * float(np.median(np.abs(np.array(logs) - median)))
    return median, 1.25 * scatter / math.sqrt(len(logs))


def _fit_focal(points: MatchedPoints) -> float | None:
    """Return the logarithm of the stated focal length over the one with which the points fit best
    in the last image. None if it hardly matters."""
    step, min_rise, most = 0.08, 6.0, 9

    @cache
    def cost(row: int) -> float:
        return _focal_cost(points, math.exp(step * row))

    coarse = range(-most, most + 1, 3)
    k = min(coarse, key=cost)
    k = min(range(max(k - 2, -most), min(k + 2, most) + 1), key=cost)
    k = min(max(k, 1 - most), most - 1)
    rows = np.arange(k - 1, k + 2)
    if not np.isfinite([cost(row) for row in (*coarse, *rows.tolist())]).all():
        return None
    square, linear, _ = np.polyfit(step * rows, [cost(row) for row in rows.tolist()], 2)
    if square * step**2 < min_rise:
        return None
    return float(np.clip(0.5 * linear / square, -step * (k + 1), -step * (k - 1)))


def _focal_cost(points: MatchedPoints, factor: float) -> float:
    """Return `_cost` with the focal length times `factor`. Depth by stereo is in proportion to it;
    with measured depth, x and y are in inverse proportion."""
    stretch = [1.0, 1.0, factor] if points.focal_baseline else [1.0 / factor, 1.0 / factor, 1.0]
    return _cost(points, np.array([stretch]), factor)


def _cost(points: MatchedPoints, stretch: Float[np.ndarray, "#n #3"], factor: float = 1.0) -> float:
    """Return the robust sum of squared errors of the best pose, with stretched points and the focal
    length times `factor`."""
    cauchy_square = 9.0
    covariances = points.covariances * (stretch[:, :, None] * stretch[:, None, :])
    stretched = points.points_cam * stretch, covariances
    c = points.camera
    camera = Camera.pinhole(c.width, c.height, factor * c.fx, factor * c.fy, c.cx, c.cy)
    pixels = points.rays * [c.fx, c.fy] + [c.cx, c.cy]
    pose = estimate_absolute_pose(pixels, stretched[0], camera, point_covariances=stretched[1])
    if pose is None:
        return math.inf
    matches = PoseMatches.from_pixels(pixels, *stretched, camera, 1.0)
    _, squares = squared_errors(*matches.kernel_args(pose.cam_from_world))
    squares = squares[np.isfinite(squares)]  # points in front of the camera
    return float(cauchy_square * np.log1p(squares / cauchy_square).sum())


def _find_ray_depth(sequence: StereoSequence, steps: Sequence[MeasuredStep]) -> str | None:
    """Return a note if the points of nearly all steps fit better with depth along the ray."""
    # right recordings: 0 to 31 % of the steps, and the median is negative
    min_share, min_gain, min_steps = 0.85, 3.0, 8
    gains = list[float]()
    for points in (step.points for step in steps):
        if points is not None and points.focal_baseline is None:
            lengths = np.linalg.norm(points.points_cam / points.points_cam[:, 2:], axis=1)
            gain = _cost(points, np.ones((1, 3))) - _cost(points, 1.0 / lengths[:, None])
            gains += [gain] if math.isfinite(gain) else []
    is_better = len(gains) >= min_steps and np.mean(np.array(gains) > 0.0) > min_share
    if not (is_better and np.median(gains) > min_gain):
        return None
    return (
        f"{sequence.name}: depth is the distance from the camera, not z, as some simulators write"
        " it: the pictures fit better then; divide the depth of pixel (u, v) by"
        " sqrt(1 + ((u - cx) / fx)^2 + ((v - cy) / fy)^2)"
    )


def _depth_ratios(points: MatchedPoints, given: Rigid3) -> Float[np.ndarray, " 3"] | None:
    """Return the median logarithm of depth over that by a step of poses: with disparities that are
    larger, equal or smaller by the error that right calibrations leave in them."""
    min_points, max_error_px, min_parallax_px, disparity_error_px = 20, 2.0, 8.0, 0.7
    last_from_first = points.view_from_cam @ given.inverse() @ points.view_from_cam.inverse()
    t, focal, z = last_from_first.translation, points.camera.fx, points.points_cam[:, 2]
    rays = points.points_cam / z[:, None] @ last_from_first.rotation.T
    seen = np.insert(points.rays, 2, 1.0, axis=1)
    across, along = (np.cross(seen, one)[:, :2] for one in (rays, t))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -np.sum(across * along, axis=1) / np.sum(across**2, axis=1)
        far = np.maximum((depth[:, None] * rays + t)[:, 2], 1e-6)
        errors = focal * np.linalg.norm(across * depth[:, None] + along, axis=1) / far
        parallax = focal * np.linalg.norm(along, axis=1) / far
        is_used = (depth > 0.0) & (errors < max_error_px) & (parallax > min_parallax_px)
    if np.count_nonzero(is_used) < min_points:
        return None
    is_used &= z <= np.median(z[is_used])  # near points have larger disparities
    z, depth = z[is_used], depth[is_used]
    if points.focal_baseline is None:
        return np.full(3, np.median(np.log(z / depth)))
    changes = disparity_error_px * np.array([[1.0], [0.0], [-1.0]])
    disparities = np.maximum(points.focal_baseline / z + changes, 0.1)
    return np.median(np.log(points.focal_baseline / disparities / depth), axis=1)
