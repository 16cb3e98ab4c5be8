"""Where a new session was taken, in the world of a map: the pictures that the map localizes hold
the session's own motion in place.

The session's motion is that of its poses (given, or SLAM's) in any world of their own; of a single
camera without poses, see `single_camera_poses.py`. One rigid transform must explain most of what
the map answers, but for a drift; the motion and the answers are then brought to agree as a pose
graph, in which the map stands still, each trusted as far as the session itself shows
(`noise_scale.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float

from topoloc.bounds import Above, AtLeast, Between
from topoloc.errors import TrajectoryError
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.lifelong.calibration_check import check_calibration, check_focal_length
from topoloc.lifelong.noise_scale import LocalizedStep, NoiseScale, estimate_noise_scale
from topoloc.lifelong.scale_estimation import ScaleConfig
from topoloc.lifelong.trajectory_correction import CorrectionConfig
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.config import MapConfig
from topoloc.mapping.nodes import select_node_frames
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.recording import SequenceView
from topoloc.slam.bundle_adjustment import BundleConfig
from topoloc.slam.monocular_config import MonocularOdometryConfig
from topoloc.slam.pose_graph import Edge, PoseGraphConfig, optimize_pose_graph

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""


@dataclass(frozen=True)
class SessionPosesConfig:
    """How a session is held in place, and when it is refused."""

    max_scale: Annotated[float, Above(0)] = 0.03
    """A metre of the motion may be off by this share of a metre of the map, beside three sigmas of
    what the answers say of it, and beside the share that one sigma of an answer is of the way
    between the furthest."""
    max_drift: Annotated[float, Between(0, 1)] = 0.03
    """Of two answers of the map that agree, the motion between them may be off by this share of the
    way ..."""
    max_turn_drift_deg: Annotated[float, AtLeast(0)] = 0.3
    """... and by so many degrees a metre of the way, ..."""
    slack: Annotated[float, Above(0)] = 0.3
    """... and by so many D_thresh in any case, ..."""
    slack_deg: Annotated[float, Above(0)] = 2.0
    """... and by so many degrees."""
    min_agreeing: Annotated[int, Between(2, 1000)] = 5
    """Pictures that the map must localize in agreement with the motion; with fewer the session is
    refused."""
    min_share: Annotated[float, Between(0, 1)] = 0.5
    """Share of the localized pictures that must agree; with fewer the session is refused."""
    drift: Annotated[float, Above(0)] = 0.01
    """Sigma of the motion from picture to picture, as a share of its way, beside a millimetre."""
    turn_drift: Annotated[float, Above(0)] = 0.002
    """Sigma of its rotation, radians a metre of the way and a radian of the turn, beside half a
    milliradian."""
    widened: Annotated[float, Above(0)] = 3.0
    """The map's answers are trusted as if their sigmas were so many times as large: neighbours
    share errors of the map."""
    motion_factors: Annotated[tuple[float, ...], Above(0)] = (0.5, 1.0, 3.0, 10.0)
    """Of stereo, RGB-D and given poses it is measured by how many times the motion's sigmas are as
    large: which of these ..."""
    answer_factors: Annotated[tuple[float, ...], Above(0)] = (1.0 / 3.0, 1.0)
    """... and, beside `widened`, which of these for the answers' sigmas agrees best with what the
    answers say of the motion."""
    rival_share: Annotated[float, Between(0, 1)] = 0.3
    """Of a single camera, answers that agree about one way are believed if fewer than this share of
    them agree about another one."""
    contradiction: Annotated[float, Above(0)] = 0.1
    """Where the map and a single camera's motion say places that are further apart than so many
    D_thresh, beside three of the map's sigmas (widened), a frame has no pose."""
    max_sigma: Annotated[float, Above(0)] = 0.1
    """A frame that no motion holds has the pose that the map answers where that is known to within
    so many D_thresh (a sigma of its position)."""
    graph: PoseGraphConfig = field(default_factory=PoseGraphConfig)
    adjustment: BundleConfig = field(
        default_factory=lambda: BundleConfig(max_steps=30, min_decrease=1e-5, cauchy_scale=0.5)
    )
    """Of a single camera's walk as a whole."""
    points_widened: Annotated[float, Above(0)] = 8.0
    """In it, points that were followed are trusted as if their sigmas were so many times as large:
    one that slides does so in all of its key frames."""
    bend: CorrectionConfig = field(default_factory=CorrectionConfig)
    """How a single camera's walk is drawn to the map's answers."""
    odometry: MonocularOdometryConfig = field(default_factory=MonocularOdometryConfig)
    scale: ScaleConfig = field(default_factory=ScaleConfig)


@dataclass(frozen=True, eq=False)
class SessionPoses:
    """world_from_cam of each frame, up to the last with a pose, in the map's world, None where it
    is not known; what the map answered to the frames that it was asked of, and which of these
    answers hold the session in place."""

    world_from_cams: list[Rigid3 | None]
    answers: Mapping[int, Localization | None]
    inlier_idx: list[int]
    propagated_idx: Sequence[int] = ()
    """Of a single camera, the frames that odometry gave their pose, and not the map."""


def estimate_poses_by_motion(
    sequence: StereoSequence,
    localizer: Localizer,
    map_config: MapConfig,
    config: SessionPosesConfig,
    progress: Progress,
) -> SessionPoses:
    """Of a session that has poses of its own, in any world, or in several, one a stretch. Frames
    about as far apart as nodes are asked.

    Raises:
        TrajectoryError: the map recognises too little of it, or not as its poses say.
        CalibrationError: the pictures contradict their calibration.
        UnreadableImageError, QueryError: from its pictures.
    """
    d_thresh = map_config.nodes.d_thresh
    assert d_thresh is not None, "a map's own configuration is resolved"
    stretches = (sequence.poses, *(sequence.apart if isinstance(sequence, SequenceView) else ()))
    motions = [odom for poses in stretches if (odom := _known_poses(poses))]
    if not motions:
        raise TrajectoryError(
            f"{sequence.name}: none of its frames has a pose; the map stays as it is"
        )
    queried = [_select_node_frames(odom, map_config) for odom in motions]
    indices = sorted({index for of_motion in queried for index in of_motion})
    results = list[Localization | NotLocalized]()
    for done, index in enumerate(indices):
        frame = sequence[index]
        results.append(localizer.localize(frame.image, frame.camera))
        progress(f"localizing {sequence.name}", done + 1, len(indices))
    check_calibration(sequence.name, results)
    if (
        config.min_agreeing > sum(result.localized for result in results)
        and len(indices) >= config.min_agreeing
    ):
        check_focal_length(sequence, indices, localizer)
    answers = {
        index: result if isinstance(result, Localization) else None
        for index, result in zip(indices, results, strict=True)
    }
    return _align_stretches(
        sequence.name,
        motions,
        [{index: answers[index] for index in of_motion} for of_motion in queried],
        d_thresh,
        config,
    )


def _known_poses(poses: Sequence[Rigid3 | None]) -> dict[int, Rigid3]:
    return {index: pose for index, pose in enumerate(poses) if pose is not None}


def _select_node_frames(odom: Mapping[int, Rigid3], map_config: MapConfig) -> list[int]:
    """Frames of a motion about as far apart as nodes of the map."""
    indices = list(odom)
    return [indices[k] for k in select_node_frames(list(odom.values()), map_config.nodes)]


def _align_stretches(
    name: str,
    motions: Sequence[Mapping[int, Rigid3]],
    answers: Sequence[Mapping[int, Localization | None]],
    d_thresh: float,
    config: SessionPosesConfig,
) -> SessionPoses:
    """Each stretch held by what the map answers to its own pictures; stretches that the map does
    not hold have no poses. Raises TrajectoryError, that of the first stretch, where it holds
    none."""
    held, refused = list[SessionPoses](), list[TrajectoryError]()
    for odom, of_motion in zip(motions, answers, strict=True):
        try:
            held.append(align_motion_to_map(name, odom, of_motion, d_thresh, config))
        except TrajectoryError as error:
            refused.append(error)
    if not held:
        raise refused[0]
    world_from_cams: list[Rigid3 | None] = [None] * max(len(one.world_from_cams) for one in held)
    for one in held:
        for index, pose in _known_poses(one.world_from_cams).items():
            world_from_cams[index] = pose
    every = {index: answer for of_motion in answers for index, answer in of_motion.items()}
    return SessionPoses(
        world_from_cams, every, sorted(index for one in held for index in one.inlier_idx)
    )


def align_motion_to_map(
    name: str,
    odom: Mapping[int, Rigid3],
    answers: Mapping[int, Localization | None],
    d_thresh: float,
    config: SessionPosesConfig,
    noise_scale: NoiseScale | None = None,
) -> SessionPoses:
    """A motion of its own world held in place by what a map answers to some of its pictures, all by
    their numbers.

    Args:
        trust: how far to trust the two; without, it is measured.

    Raises:
        TrajectoryError: the map recognises too little of it, or not as the motion says.
    """
    localized = {index: result for index, result in answers.items() if result is not None}
    inlier_idx = _find_consensus(name, odom, localized, len(answers), d_thresh, config)
    anchors = {k: localized[k] for k in inlier_idx}
    return SessionPoses(
        _optimize_motion(
            odom, anchors, noise_scale or _estimate_noise(odom, anchors, config), config
        ),
        answers,
        inlier_idx,
    )


def _find_consensus(
    name: str,
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    num_asked: int,
    d_thresh: float,
    config: SessionPosesConfig,
) -> list[int]:
    """The largest set of answers that one transform of the motion explains."""
    indices = list(localized)
    if num_asked < config.min_agreeing:
        raise TrajectoryError(
            f"{name}: {_too_few_message(num_asked, config)}; the map stays as it is"
        )
    if len(indices) < config.min_agreeing:
        raise TrajectoryError(
            f"{name}: the map recognises {len(indices)} of {num_asked} pictures asked: another"
            " place, or changed; the map stays as it is"
        )
    _check_scale(name, odom, localized, config)
    path_lengths, slack_m = _path_lengths(odom), config.slack * d_thresh
    agrees = np.array(
        [_find_inliers(k, odom, localized, path_lengths, slack_m, config) for k in indices]
    )
    best = agrees[int(np.argmax(agrees.sum(axis=1)))]
    if best.sum() < max(config.min_agreeing, config.min_share * len(indices)):
        raise TrajectoryError(
            f"{name}: of {len(indices)} pictures that the map localizes {int(best.sum())} agree"
            " with its poses; the map stays as it is"
        )
    return [index for index, is_in in zip(indices, best, strict=True) if is_in]


def _find_inliers(
    k: int,
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    path_lengths: Mapping[int, float],
    slack_m: float,
    config: SessionPosesConfig,
) -> Bool[np.ndarray, " n"]:
    """Which answers agree with the transform of the motion that answer `k` says."""
    world_from_odom = localized[k].world_from_cam @ odom[k].inverse()
    agrees = []
    for index, answer in localized.items():
        off = answer.world_from_cam.inverse() @ world_from_odom @ odom[index]
        path_length = abs(path_lengths[index] - path_lengths[k])
        near = float(np.linalg.norm(off.translation)) <= slack_m + config.max_drift * path_length
        agrees.append(
            near
            and np.degrees(off.angle())
            <= config.slack_deg + config.max_turn_drift_deg * path_length
        )
    return np.array(agrees)


def _too_few_message(num_asked: int, config: SessionPosesConfig) -> str:
    found = f"{num_asked} of its pictures are" if num_asked > 1 else "one of its pictures is"
    return (
        f"{found} as far apart as nodes of the map, too few to join: it takes {config.min_agreeing}"
    )


def _check_scale(
    name: str,
    odom: Mapping[int, Rigid3],
    localized: Mapping[int, Localization],
    config: SessionPosesConfig,
) -> None:
    """Hold that a metre of the motion is one of the map, by the distances between what was
    localized."""
    a = np.array([odom[k].translation for k in localized])
    b = np.array([answer.world_from_cam.translation for answer in localized.values()])
    rows, columns = np.triu_indices(len(a), 1)
    odom_lengths, lengths = (
        np.linalg.norm(a[rows] - a[columns], axis=1),
        np.linalg.norm(b[rows] - b[columns], axis=1),
    )
    far = lengths > 0.5 * lengths.max()
    if (odom_lengths[far] == 0.0).any():
        return
    ratios = lengths[far] / odom_lengths[far]
    scale = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(ratios - scale)))
    # the answers are wrong together, too, which their spread does not show; of what hardly moves
    # that is all there is
    sigma_m = float(np.median([answer.position_sigma_m for answer in localized.values()]))
    uncertainty = 3.0 * spread / np.sqrt(len(a)) + sigma_m / lengths.max()
    if abs(scale - 1.0) > config.max_scale + uncertainty:
        raise TrajectoryError(
            f"{name}: a metre of its poses is {scale:.3g} m of the map; the map stays as it is"
        )


def _path_lengths(odom: Mapping[int, Rigid3]) -> dict[int, float]:
    """Metres gone up to each frame."""
    positions = np.array([pose.translation for pose in odom.values()])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return dict(zip(odom, np.concatenate([[0.0], np.cumsum(steps)]).tolist(), strict=True))


def _optimize_motion(
    odom: Mapping[int, Rigid3],
    anchors: Mapping[int, Localization],
    noise_scale: NoiseScale,
    config: SessionPosesConfig,
) -> list[Rigid3 | None]:
    """The motion held in place by the anchors: a pose graph whose first node is the map's world,
    which does not move."""
    indices = list(odom)
    first = min(anchors)
    world_from_odom = anchors[first].world_from_cam @ odom[first].inverse()
    cam_from_worlds = [Rigid3.identity(), *((world_from_odom @ odom[k]).inverse() for k in indices)]
    steps = [_relative_motion(odom[a], odom[b], config) for a, b in pairwise(indices)]
    edges = [
        Edge(row, row + 1, step, noise_scale.motion**2 * spread, is_loop=False)
        for row, (step, spread) in enumerate(steps, 1)
    ]
    row_of = {index: row for row, index in enumerate(indices, 1)}
    for index, answer in anchors.items():
        covariance = (noise_scale.answers * config.widened) ** 2 * inverse_covariance(
            answer.world_from_cam, answer.covariance
        )
        edges.append(
            Edge(0, row_of[index], answer.world_from_cam.inverse(), covariance, is_loop=True)
        )
    optimised = optimize_pose_graph(cam_from_worlds, edges, config.graph)[1:]
    poses: list[Rigid3 | None] = [None] * (max(odom) + 1)
    for index, cam_from_world in zip(indices, optimised, strict=True):
        poses[index] = cam_from_world.inverse()
    return poses


def _estimate_noise(
    odom: Mapping[int, Rigid3], anchors: Mapping[int, Localization], config: SessionPosesConfig
) -> NoiseScale:
    """Of the motion from anchor to anchor and of the anchors, not widened: what neighbours share
    does not scatter."""
    seen, moved, spread = list[LocalizedStep](), Rigid3.identity(), np.zeros((6, 6))
    before = None
    for index, pose in odom.items():
        if before is not None:
            step, of_step = _relative_motion(before, pose, config)
            adjoint = step.adjoint()
            moved, spread = step @ moved, adjoint @ spread @ adjoint.T + of_step
        before = pose
        if index in anchors:
            answer = anchors[index]
            of_answer = inverse_covariance(answer.world_from_cam, answer.covariance)
            seen.append(LocalizedStep(moved, spread, answer.world_from_cam.inverse(), of_answer))
            moved, spread = Rigid3.identity(), np.zeros((6, 6))
    return estimate_noise_scale(seen, config.motion_factors, config.answer_factors)


def _relative_motion(
    odom_from_a: Rigid3, odom_from_b: Rigid3, config: SessionPosesConfig
) -> tuple[Rigid3, Float[np.ndarray, "6 6"]]:
    """b_from_a, and the covariance of its left perturbation."""
    b_from_a = odom_from_b.inverse() @ odom_from_a
    path_length = float(np.linalg.norm(b_from_a.translation))
    sigma_m, sigma_rad = (
        0.001 + config.drift * path_length,
        0.0005 + config.turn_drift * (path_length + b_from_a.angle()),
    )
    return b_from_a, np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3)
