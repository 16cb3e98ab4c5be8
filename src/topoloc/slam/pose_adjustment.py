"""Treat the given poses of single images as measurements: find wrong poses, a wrong focal length,
and poses that are a little off, which one bundle adjustment corrects.

Images alone would turn and shift a scene: what the calibration leaves out goes into the poses. So
all poses have priors, and how far the images are believed is found by images that are kept back:
localized by the points of the others, they must come nearer to their given poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from topoloc.compiled import parallel_map
from topoloc.disk_list import DiskList
from topoloc.geometry.absolute_pose import estimate_absolute_pose
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3, positions_of
from topoloc.points.metric_points import StereoCamera
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.recording import has_scale, with_poses
from topoloc.slam.bundle.bundle_adjustment import PosePrior, adjust_bundle
from topoloc.slam.image_tracks import (
    ImagePair,
    TrackedImage,
    extract_images,
    join_tracks,
    match_all,
    match_images,
)
from topoloc.slam.keyframes import (
    DisparityBias,
    KeyFrame,
    KeyFrameObservations,
    Landmarks,
    PlaceFeatures,
    triangulate_points,
)

_MIN_IMAGES, _MAX_IMAGES = 8, 600
_MIN_CONTRADICTION_PX = 1.0  # right poses and calibrations: 0.2 to 0.6 px
_MAX_ERROR = 0.04  # of a match, rad: poses and focal lengths that are some percent off
_MAX_POINT_ERROR_PX = 40.0  # of a track's point, before poses are adjusted
_NUM_FOLDS = 4


def correct_poses(sequence: StereoSequence, warn: Callable[[str], object]) -> StereoSequence:
    """Return a recording of single images with corrected poses (world_from_cam), in the world of
    the given ones. Wrong ones are None. Others than 8 to 600 single images stay as they are. `warn`
    is called with each finding, a wrong focal length, too, with which no pose is corrected. Raises
    RecordingError, CalibrationError, UnreadableImageError: a frame cannot be read."""
    posed: dict[int, Rigid3 | None] = {
        k: pose for k, pose in enumerate(sequence.poses) if pose is not None
    }
    if not _MIN_IMAGES <= len(posed) <= _MAX_IMAGES:
        return sequence
    first = sequence[next(iter(posed))]
    is_single = first.right is None and first.depth is None
    if first.camera is None or not (is_single and has_scale(sequence)):
        return sequence
    rows, poses = list(posed), [pose for pose in sequence.poses if pose is not None]
    images = extract_images(sequence, rows)
    pairs, shares = match_images(images, poses, 4, _MAX_ERROR * first.camera.fx)
    doubtful = [k for k in np.argsort(shares)[:6].tolist() if shares[k] <= 0.5]
    of_doubtful = match_all(images, doubtful)
    names = [sequence.names[row] for row in rows]
    for text in _describe_alone(sequence.name, names, pairs + of_doubtful):
        warn(text)
    network = _Network(images, join_tracks(images, pairs + of_doubtful), poses)
    wrong = network.find_wrong_poses(pairs + of_doubtful)
    errors = np.array([_error_px(images, pair, poses) for pair in pairs])
    for k, error in wrong.items():
        posed[rows[k]] = None
        warn(
            f"{sequence.name}: the pose of {names[k]} is wrong: points of the"
            f" other pictures are {error:.0f} px off in it; it is left out"
        )
    is_kept = np.array([not wrong.keys() & {one.first, one.second} for one in pairs], bool)
    pairs = [pair for pair, kept in zip(pairs, is_kept, strict=True) if kept]
    contradiction = float(np.median(errors[is_kept])) if pairs else 0.0
    if contradiction > _MIN_CONTRADICTION_PX:
        focal = find_focal_factor(images, pairs, poses)
        kept = [k for k in range(len(rows)) if k not in wrong]
        some = [images[k] for k in kept], [poses[k] for k in kept]
        found = adjust_poses(*some, contradiction) if focal is None else None
        if focal is not None:
            warn(_describe_focal(sequence.name, focal * first.camera.fx, first.camera.fx))
        elif found is not None:
            warn(f"{sequence.name}: {_describe_changes(some[1], found, contradiction)}")
            posed.update(zip((rows[k] for k in kept), found, strict=True))
    return with_poses(sequence, [posed.get(k) for k in range(len(sequence))])


def _describe_alone(
    recording: str, names: Sequence[str], pairs: Sequence[ImagePair]
) -> Sequence[str]:
    """Return a text if images have no pair and others have."""
    seen = {k for one in pairs for k in (one.first, one.second)}
    alone = [name for k, name in enumerate(names) if k not in seen]
    if not seen or not alone:
        return ()
    return (
        f"{recording}: {len(alone)} of {len(names)} pictures share too little with the others, so"
        f" their poses are not checked: {', '.join(alone[:5])}{' ...' * (len(alone) > 5)}; take"
        " more between them and the others",
    )


def _describe_focal(name: str, fits: float, given: float) -> str:
    return (
        f"{name}: a focal length of about {fits:.4g} px fits the pictures and their poses, not"
        f" {given:.4g}; calibrate the camera again, or correct fx and fy"
    )


def _describe_changes(
    given: Sequence[Rigid3], found: Sequence[Rigid3], contradiction_px: float
) -> str:
    pairs = list(zip(given, found, strict=True))
    metres = float(np.median([translation_error(*pair) for pair in pairs]))
    radians = float(np.median([rotation_error(*pair) for pair in pairs]))
    return (
        f"the pictures contradict the poses by {contradiction_px:.1f} px: poses corrected by"
        f" {100.0 * metres:.1f} cm, {math.degrees(radians):.2f} deg in the median"
    )


def _error_px(images: Sequence[TrackedImage], pair: ImagePair, poses: Sequence[Rigid3]) -> float:
    step = poses[pair.second].inverse() @ poses[pair.first]
    return float(np.median(pair.errors_px(images, step)))


def find_focal_factor(
    images: Sequence[TrackedImage], pairs: Sequence[ImagePair], poses: Sequence[Rigid3]
) -> float | None:
    """Return the factor of the focal length with which the poses fit the images best. None if it is
    near 1, or the images do not decide."""
    min_log, cauchy_px, num_groups = 0.03, 2.0, 8
    logs = 0.02 * np.arange(-8.0, 9.0)
    if len(pairs) < num_groups:
        return None

    def costs_of(pair: ImagePair) -> Float[np.ndarray, " k"]:
        step = poses[pair.second].inverse() @ poses[pair.first]
        errors = [pair.errors_px(images, step, math.exp(log)) for log in logs]
        return np.array([np.log1p(np.square(one / cauchy_px)).mean() for one in errors])

    costs = np.array(list(parallel_map(costs_of, pairs)))
    # without each group of images in turn (jackknife): pairs of an image share its pose's error
    ends = np.array([(one.first, one.second) for one in pairs]) % num_groups
    parts = [costs[(ends != k).all(axis=1)] for k in range(num_groups)]
    best = np.array([_minimum(logs, one.mean(axis=0)) for one in parts if len(one)])
    sigma = math.sqrt((num_groups - 1) * float(np.var(best)))
    log = float(np.mean(best))
    return math.exp(log) if abs(log) - 2.0 * sigma > min_log else None


def _minimum(x: Float[np.ndarray, " k"], y: Float[np.ndarray, " k"]) -> float:
    """Return the minimum of the parabola around the least value. NaN if that is the first or last:
    the images hardly show the focal length then."""
    k = int(np.argmin(y))
    if not 0 < k < len(y) - 1:
        return math.nan
    square, linear, _ = np.polyfit(x[k - 1 : k + 2], y[k - 1 : k + 2], 2)
    return -0.5 * linear / square


@dataclass(frozen=True, eq=False)
class _Network:
    """Hold images, the track of each feature (-1: none), the given poses and the standard
    deviations of their rotations (radians) and positions (metres)."""

    images: Sequence[TrackedImage]
    tracks: Sequence[Int[np.ndarray, " n"]]
    poses: Sequence[Rigid3]
    sigmas: tuple[float, float] = (1.0, 1.0)

    @property
    def num_tracks(self) -> int:
        return 1 + max(int(of_image.max(initial=-1)) for of_image in self.tracks)

    def keyframes(self, used: Bool[np.ndarray, " k"], sigma_factor: float) -> list[KeyFrame]:
        """Return the `used` images as key frames, the features with so many times their sigma."""
        bias, places, keyframes = DisparityBias(), DiskList[PlaceFeatures](), list[KeyFrame]()
        for k in np.flatnonzero(used).tolist():
            image, rows = self.images[k], np.flatnonzero(self.tracks[k] >= 0)
            weights = 1.0 / (sigma_factor * image.sigmas_px[rows])
            zeros = np.zeros(len(rows))
            seen = KeyFrameObservations(
                self.tracks[k][rows],
                np.column_stack([image.points_img[rows], zeros]),
                np.column_stack([weights, weights, zeros]),
                np.ones(len(rows), bool),
            )
            camera, pose = StereoCamera(image.camera, 1.0), self.poses[k].inverse()
            keyframes.append(KeyFrame(0, k, 0, 0, camera, pose, seen, bias, places=places))
        return keyframes

    def adjust(self, used: Bool[np.ndarray, " k"], sigma_factor: float) -> list[KeyFrame]:
        """Return the `used` images with adjusted poses."""
        keyframes, landmarks = self.keyframes(used, sigma_factor), Landmarks()
        landmarks.add(self.triangulate(keyframes, _MAX_POINT_ERROR_PX))
        for keyframe in keyframes:
            seen = keyframe.observations
            seen.active &= np.isfinite(landmarks.positions[seen.landmark_ids]).all(axis=1)
        radians, metres = self.sigmas
        information = np.diag(np.repeat([metres**-2, radians**-2], 3))
        priors = [PosePrior(one, one.cam_from_world, information) for one in keyframes]
        adjust_bundle(keyframes, [], landmarks, priors, max_steps=15)
        return keyframes

    def triangulate(
        self, keyframes: Sequence[KeyFrame], max_error_px: float
    ) -> Float[np.ndarray, "t 3"]:
        """Return the point of each track (world), NaN if it is not certain."""
        min_angle = math.radians(1.0)
        points, _, angles, errors = triangulate_points(keyframes, np.arange(self.num_tracks))
        points[~((angles > min_angle) & (errors < max_error_px))] = np.nan
        return points

    def find_wrong_poses(self, pairs: Sequence[ImagePair]) -> dict[int, float]:
        """Return the images in which points of the others are far off, with their median error
        (pixels), and whose pairs contradict the poses more than others: points of two near images
        may be wrong themselves. Empty if they are more than a tenth: another convention or
        recording is likelier."""
        min_px, min_ratio, min_pair_ratio, max_share = 8.0, 5.0, 2.0, 0.1
        errors = self.kept_back_errors(None)[:, 2]
        known = errors[np.isfinite(errors)]
        if not len(known):
            return {}
        of_pairs = np.array([_error_px(self.images, pair, self.poses) for pair in pairs])
        ends = np.array([(one.first, one.second) for one in pairs])
        far = np.flatnonzero(errors > max(min_px, min_ratio * float(np.median(known)))).tolist()
        least = min_pair_ratio * float(np.median(of_pairs))
        wrong = {
            k: float(errors[k]) for k in far if np.median(of_pairs[(ends == k).any(axis=1)]) > least
        }
        return wrong if len(wrong) <= max_share * len(errors) else {}

    def kept_back_errors(self, sigma_factor: float | None) -> Float[np.ndarray, "k 3"]:
        """Return how far images that are kept back are from their given poses (metres, radians,
        pixels of the points) if the others' points localize them. None: the others have their given
        poses."""
        errors = np.full((len(self.images), 3), np.nan)
        folds = np.arange(len(self.images)) % _NUM_FOLDS
        for fold in range(_NUM_FOLDS):
            used = folds != fold
            given = sigma_factor is None
            others = self.keyframes(used, 1.0) if given else self.adjust(used, sigma_factor)
            points = self.triangulate(others, _MAX_POINT_ERROR_PX / 2.0)
            for k in np.flatnonzero(~used).tolist():
                errors[k] = self._localization_error(k, points)
        return errors

    def _localization_error(
        self, k: int, points: Float[np.ndarray, "t 3"]
    ) -> tuple[float, float, float]:
        min_inliers, min_points, image, given = 12, 25, self.images[k], self.poses[k]
        rows = np.flatnonzero(self.tracks[k] >= 0)
        rows = rows[np.isfinite(points[self.tracks[k][rows]]).all(axis=1)]
        seen, points_world = image.points_img[rows], points[self.tracks[k][rows]]
        by_given = image.camera.img_from_cam(given.inverse().apply(points_world))
        off = np.nan_to_num(np.linalg.norm(by_given - seen, axis=1), nan=image.camera.width)
        error_px = float(np.median(off)) if len(rows) >= min_points else math.nan
        pose = estimate_absolute_pose(seen, points_world, image.camera)
        if pose is None or np.count_nonzero(pose.inliers) < min_inliers:
            return math.nan, math.nan, error_px
        found = pose.cam_from_world.inverse()
        return translation_error(given, found), rotation_error(given, found), error_px


def adjust_poses(
    images: Sequence[TrackedImage], world_from_cams: Sequence[Rigid3], contradiction_px: float
) -> list[Rigid3] | None:
    """Return poses that fit the images better, in the world of the given ones. None if images that
    are kept back do not come nearer to their given poses. `contradiction_px` is by how much the
    poses do not fit the images."""
    # How many times their sigmas features are off, as far as poses cannot explain it. What they
    # share (lens, shutter) does not average out over the hundreds of an image.
    sigma_factors = (64.0, 32.0, 16.0, 8.0)
    min_gain = 3.0  # standard deviations
    max_error_px = 4.0 * contradiction_px
    tracks = join_tracks(images, match_images(images, world_from_cams, 12, max_error_px)[0])
    network = _Network(images, tracks, world_from_cams)
    if network.num_tracks == 0:
        return None
    everything = np.ones(len(images), bool)
    radians = 2.0 * contradiction_px / images[0].camera.fx
    depth = _median_depth(network)
    network = replace(network, sigmas=(radians, 0.3 * depth * radians))
    before = network.kept_back_errors(None)
    gains = {factor: _gain(before, network.kept_back_errors(factor)) for factor in sigma_factors}
    best = max(sigma_factors, key=lambda factor: gains[factor][0])
    mean, sigma = gains[best]
    if mean < min_gain * sigma:
        return None
    # the least change that is about as good
    chosen = next(factor for factor in sigma_factors if gains[factor][0] >= mean - sigma)
    return [one.cam_from_world.inverse() for one in network.adjust(everything, chosen)]


def _gain(before: Float[np.ndarray, "k 3"], after: Float[np.ndarray, "k 3"]) -> tuple[float, float]:
    """Return by how much the logarithm of errors falls in the mean, and its standard deviation."""
    gains = np.log(before[:, :2] / after[:, :2]).mean(axis=1)
    gains = gains[np.isfinite(gains)]
    if len(gains) < _MIN_IMAGES:
        return -math.inf, 1.0
    return float(gains.mean()), float(gains.std()) / math.sqrt(len(gains))


def _median_depth(network: _Network) -> float:
    """Return the median distance of the tracks from the images' centre, or one metre."""
    everything = np.ones(len(network.images), bool)
    points = network.triangulate(network.keyframes(everything, 1.0), _MAX_POINT_ERROR_PX)
    distances = np.linalg.norm(points - np.median(positions_of(network.poses), axis=0), axis=1)
    known = distances[np.isfinite(distances)]
    return float(np.median(known)) if len(known) else 1.0
