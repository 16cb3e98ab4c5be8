"""Stereo visual SLAM, read from the top: recordings in, the pose of each of their frames out, in one world.

Odometry turns each recording into chains of key frames (sub-maps); loops join them, and themselves, where the same place is seen
again; a pose graph and a bundle adjustment of the whole make them agree. The world is the camera of the first frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.frame import StereoSequence
from topoloc.slam.input_checks import InputCheckConfig, InputChecks
from topoloc.slam.keyframes import KeyFrame, Landmarks
from topoloc.slam.odometry import FramePose, Odometry, OdometryConfig

Progress = Callable[[str, int, int], None]
"""Called with a stage's name, steps done and steps in all."""


@dataclass(frozen=True)
class SlamConfig:
    """All steps' settings."""

    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    checks: InputCheckConfig = field(default_factory=InputCheckConfig)


@dataclass(frozen=True, eq=False)
class SlamResult:
    """`poses[r][i]` is world_from_cam of frame i of recording r, None where it is not known."""

    poses: list[list[Rigid3 | None]]
    keyframes: list[KeyFrame]
    right_residuals_px: np.ndarray


def run_slam(sequences: Sequence[StereoSequence], config: SlamConfig | None = None, progress: Progress | None = None) -> SlamResult:
    config = config or SlamConfig()
    progress = progress or (lambda stage, done, total: None)
    keyframes: list[KeyFrame] = []
    landmarks = Landmarks()
    poses, residuals = [], []
    for number, sequence in enumerate(sequences):
        checks = InputChecks(sequence.name, config.checks)
        odometry = Odometry(number, keyframes, landmarks, checks, config.odometry)
        tracked: list[FramePose | None] = []
        for i, frame in enumerate(_read_ahead(sequence)):
            checks.check_rig(frame)
            tracked.append(odometry.process(i, frame))
            progress(f"odometry {sequence.name}", i + 1, len(sequence))
        checks.verdict()
        poses.append([pose.world_from_cam() if pose is not None else None for pose in tracked])
        residuals += checks.right_residuals_px
    return SlamResult(poses, keyframes, np.concatenate(residuals) if residuals else np.zeros(0))


def _read_ahead(sequence: StereoSequence):
    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(sequence.__getitem__, 0)
        for i in range(len(sequence)):
            frame = coming.result()
            if i + 1 < len(sequence):
                coming = reader.submit(sequence.__getitem__, i + 1)
            yield frame
