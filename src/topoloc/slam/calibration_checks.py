"""Check focal length, baseline and depth factor of a recording: errors of some percent that no
single step between images shows, but all of them together.

*Focal length.* A wrong one bends the points of a frame, so that they fit another image less well
after a rotation. It also gives the measured rotations another length than those of the poses.
*Scale.* The depth of points is compared with the depth by the motion between two poses. A wrong
baseline or depth factor changes the first alone, another unit of the poses the second alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.slam.depth_checks import find_depth_shift
from topoloc.slam.input_checks import add_calibration
from topoloc.slam.measured_steps import MatchedPoints, MeasuredStep, measure_steps

MIN_STEPS = 5
# Logarithm of a factor that calibrations are wrong by at least. Right ones of real recordings have
# up to 0.05 by the images, 0.10 by rotations, 0.05 by depth.
_FOCAL_TOLERANCE, _ROTATION_TOLERANCE, _SCALE_TOLERANCE = 0.075, 0.12, 0.07
_NUM_SIGMAS = 2.0
_DISPARITY_BIAS_PX = 0.7  # of right calibrations (KITTI)


@dataclass(frozen=True)
class CalibrationErrors:
    """Hold factors by which a calibration is wrong: the stated value over the one that fits. None
    if it is right, or the images do not decide. `scale`: of depth over that by the poses. Without
    rotations a wrong `focal` looks like a wrong scale, and `is_focal_known` is False."""

    focal: float | None = None
    scale: float | None = None
    is_focal_known: bool = True


def check_calibration(
    sequence: StereoSequence, steps: Sequence[MeasuredStep], are_poses_right: bool
) -> None:
    """Check the calibration of a recording by steps between its images, and by its poses if these
    are right but for some percent.

    Raises:
        TrajectoryError: it does not fit. Contains the value that does.
    """
    poses = sequence.poses if are_poses_right else [None] * len(sequence)
    errors = evaluate_calibration(steps, poses)
    unchecked = "--poses unchecked maps it all the same"
    if errors.focal is not None:
        raise TrajectoryError(f"{describe_focal_error(sequence, errors.focal)}; {unchecked}")
    if errors.scale is not None:
        percent, scale = 100.0 * (errors.scale - 1.0), f"scale={errors.scale:.4g}"
        looks = f"the poses are of another unit than the metre: --poses {scale}"
        explained = add_calibration(looks, sequence, [scale])
        if not errors.is_focal_known:
            explained += ", or the focal length is wrong, which a straight walk does not show"
        raise TrajectoryError(
            f"{sequence.name}: depth is {abs(percent):.0f} % {'more' if percent > 0 else 'less'}"
            f" than the motion of the poses shows; {explained}; {unchecked}"
        )


def find_image_faults(sequence: StereoSequence) -> list[str]:
    """Return a note for each fault of a recording without poses that its images or times show.

    Raises:
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    max_interval_s = 10.0  # median; a longer one is of another unit than the second
    interval = float(np.median(np.diff(sequence.t_ns))) / 1e9 if len(sequence) > 1 else 0.0
    notes = [find_depth_shift(sequence), _find_focal_error(sequence)]
    if interval > max_interval_s:
        notes.append(
            f"{sequence.name}: {interval:.4g} s from picture to picture (median); are the times in"
            f" {'milliseconds' if interval < 1e4 else 'micro- or nanoseconds'}? Write seconds"
        )
    return [note for note in notes if note is not None]


def _find_focal_error(sequence: StereoSequence) -> str | None:
    """Return a note if the images alone show a wrong focal length of a stereo or RGB-D recording.

    Raises:
        RecordingError, CalibrationError, UnreadableImageError: the recording cannot be read.
    """
    first = sequence[0]
    if first.camera is None or (first.right is None and first.depth is None):
        return None
    steps = measure_steps(sequence, list(range(len(sequence))))
    focal = evaluate_calibration(steps, [None] * len(sequence)).focal
    return None if focal is None else describe_focal_error(sequence, focal)


def describe_focal_error(sequence: StereoSequence, focal: float) -> str:
    """Return the line for a focal length that is `focal` times the one that fits."""
    camera = sequence[0].camera
    stated = 0.0 if camera is None else camera.fx
    return (
        f"{sequence.name}: a focal length of about {stated / focal:.4g} px fits the pictures, not"
        f" {stated:.4g}; calibrate the camera again, or correct fx and fy"
    )


def evaluate_calibration(
    steps: Sequence[MeasuredStep], poses: Sequence[Rigid3 | None]
) -> CalibrationErrors:
    """Compare the steps with poses (world_from_cam in metres, one for each frame), and the points
    of a step with each other. Single cameras are not checked."""
    by_images, by_poses = list[float](), list[float]()
    ratios: list[Float[np.ndarray, " 3"]] = []
    for step in steps:
        first, last = poses[step.first], poses[step.last]
        if step.points is None:
            continue
        if (focal := _fit_focal(step.points)) is not None:
            by_images.append(focal)
        if first is not None and last is not None:
            given = first.inverse() @ last
            if (ratio := _rotation_ratio(step.first_from_last, given)) is not None:
                by_poses.append(ratio)
            if (scales := _depth_ratios(step.points, given)) is not None:
                ratios.append(scales)
    if (focal := _combine(by_images, by_poses)) is not None:
        return CalibrationErrors(focal=math.exp(focal))
    if len(ratios) < MIN_STEPS:
        return CalibrationErrors()
    (low, sigma), (scale, _), (high, _) = (_median(column) for column in zip(*ratios, strict=True))
    nearest = max(0.0, low, -high)
    is_wrong = nearest - 3.0 * sigma > _SCALE_TOLERANCE
    is_focal_known = max(len(by_images), len(by_poses)) >= MIN_STEPS
    return CalibrationErrors(None, math.exp(scale) if is_wrong else None, is_focal_known)


def _combine(by_images: Sequence[float], by_poses: Sequence[float]) -> float | None:
    """Return the logarithm of a focal length's error, or None if it is right. The images decide,
    and the poses only where these do not contradict."""
    image, image_sigma = _median(by_images)
    pose, pose_sigma = _median(by_poses)
    if abs(image) - _NUM_SIGMAS * image_sigma > _FOCAL_TOLERANCE:
        return image
    is_wrong = abs(pose) - _NUM_SIGMAS * pose_sigma > _ROTATION_TOLERANCE
    return pose if is_wrong and (len(by_images) < MIN_STEPS or image * pose > 0.0) else None


def _median(logs: Sequence[float]) -> tuple[float, float]:
    """Return the median and its standard deviation, by the scatter of the values. It is infinite
    for few values."""
    if len(logs) < MIN_STEPS:
        return 0.0, math.inf
    median = float(np.median(logs))
    scatter = 1.4826 * float(np.median(np.abs(np.array(logs) - median)))
    return median, 1.25 * scatter / math.sqrt(len(logs))


def _rotation_ratio(measured: Rigid3, given: Rigid3) -> float | None:
    """Return the logarithm of the given over the measured angle: that of the stated focal length
    over the right one, since a longer lens needs a smaller rotation."""
    min_angle, max_ratio = math.radians(4.0), 2.0
    angles = given.angle(), measured.angle()
    if min(angles) < min_angle or max(angles) > max_ratio * min(angles):
        return None
    return math.log(angles[0] / angles[1])


def _fit_focal(points: MatchedPoints) -> float | None:
    """Return the logarithm of the stated focal length over the one with which the points fit best
    in the last image. None if it hardly matters."""
    step, min_rise = 0.08, 6.0
    factors = step * np.arange(-9.0, 10.0)
    costs = np.array([_focal_cost(points, math.exp(factor)) for factor in factors])
    if not np.isfinite(costs).all():
        return None
    k = int(np.clip(np.argmin(costs), 1, len(costs) - 2))
    before, at, after = costs[k - 1 : k + 2]
    curvature = before - 2.0 * at + after
    if curvature < 2.0 * min_rise:
        return None
    shift = float(np.clip(0.5 * (before - after) / curvature, -1.0, 1.0))
    return -(factors[k] + step * shift)


def _focal_cost(points: MatchedPoints, factor: float) -> float:
    """Return the robust sum of squared errors with the focal length times `factor`. Depth by stereo
    is in proportion to it; with measured depth, x and y are in inverse proportion."""
    cauchy_square = 9.0
    stretch = [1.0, 1.0, factor] if points.focal_baseline else [1.0 / factor, 1.0 / factor, 1.0]
    of, c = points.points_cam * stretch, points.camera
    spread = points.covariances * np.outer(stretch, stretch)
    camera = Camera.pinhole(c.width, c.height, factor * c.fx, factor * c.fy, c.cx, c.cy)
    pose = estimate_absolute_pose(points.pixels, of, camera, point_covariances=spread)
    if pose is None:
        return math.inf
    seen = pose.cam_from_world.apply(of)
    is_front = seen[:, 2] > 0.0
    p, focal = seen[is_front], np.array([camera.fx, camera.fy])
    errors = points.pixels[is_front] - (p[:, :2] / p[:, 2:] * focal + [c.cx, c.cy])
    jacobian = np.zeros((len(p), 2, 3))
    jacobian[:, [0, 1], [0, 1]] = focal / p[:, 2:]
    jacobian[:, :, 2] = -focal * p[:, :2] / p[:, 2:] ** 2
    jacobian = jacobian @ pose.cam_from_world.rotation
    noise = jacobian @ spread[is_front] @ jacobian.transpose(0, 2, 1) + np.eye(2)
    squares = np.einsum("ni,ni->n", errors, np.linalg.solve(noise, errors[:, :, None])[:, :, 0])
    return float(cauchy_square * np.log1p(squares / cauchy_square).sum())


def _depth_ratios(points: MatchedPoints, given: Rigid3) -> Float[np.ndarray, " 3"] | None:
    """Return the median logarithm of depth over that by a step of poses, in ascending order: if
    disparities are too small, as they are, or too large by the bias of right calibrations."""
    min_points, max_error_px, min_parallax_px = 20, 2.0, 8.0
    last_from_first = points.view_from_cam @ given.inverse() @ points.view_from_cam.inverse()
    t, focal = last_from_first.translation, points.camera.fx
    z = points.points_cam[:, 2]
    rays = points.points_cam / z[:, None] @ last_from_first.rotation.T
    seen = np.insert(points.camera_rays, 2, 1.0, axis=1)
    across, along = np.cross(seen, rays)[:, :2], np.cross(seen, np.broadcast_to(t, seen.shape))
    along = along[:, :2]
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
    disparities = points.focal_baseline / z
    biases = np.array([_DISPARITY_BIAS_PX, 0.0, -_DISPARITY_BIAS_PX])
    corrected = points.focal_baseline / np.maximum(disparities + biases[:, None], 0.1)
    return np.median(np.log(corrected / depth), axis=1)
