"""Check that right poses of real recordings pass and wrong ones are refused, with
depth and without."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular
from topoloc.recordings.trajectory import Trajectory
from topoloc.slam.measured_steps import measure_steps
from topoloc.slam.pose_checks import evaluate_poses

Poses = list[Rigid3 | None]
RECORDINGS = {
    "ZED 1": "zed_lab/session1",
    "ZED 2": "zed_lab/session2",
    "kitchen": "seven_scenes/kitchen/seq-01",
    "KITTI 2": "kitti/sequences/street2",
}
FLIP = np.diag([1.0, -1.0, -1.0])
FLU = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
WRONG: dict[str, Callable[[Rigid3], Rigid3]] = {
    "inverse": Rigid3.inverse,
    "opengl": lambda pose: Rigid3(pose.rotation @ FLIP, pose.translation),
    "flu": lambda pose: Rigid3(pose.rotation @ FLU.T, pose.translation),
    "transposed": lambda pose: Rigid3(pose.rotation.T.copy(), pose.translation),
}


def shifted(sequence: StereoSequence, seconds: float) -> Poses:
    """Return the poses shifted in time against the images."""
    posed = [(p, t) for p, t in zip(sequence.poses, sequence.t_ns, strict=True) if p is not None]
    trajectory = Trajectory([pose for pose, _ in posed], [time for _, time in posed])
    return trajectory.interpolate([t + round(seconds * 1e9) for t in sequence.t_ns], 1.0)


@pytest.mark.parametrize("is_single", [False, True])
@pytest.mark.parametrize("name", RECORDINGS)
def test_verdicts_on_poses(shared: Path, name: str, is_single: bool):
    folder = shared / "data" / RECORDINGS[name]
    if not folder.is_dir():
        pytest.skip(f"no recording at {folder}")
    sequence = open_sequence(folder)
    posed = [row for row, pose in enumerate(sequence.poses) if pose is not None]
    steps = measure_steps(as_monocular(sequence) if is_single else sequence, posed)

    def verdict(poses: Poses) -> tuple[bool, str]:
        result = evaluate_poses(steps, poses, sequence.t_ns)
        return result.is_accepted, ",".join(result.conventions)

    assert verdict(list(sequence.poses)) == (True, "")
    for wrong, spoil in WRONG.items():
        assert verdict([pose and spoil(pose) for pose in sequence.poses]) == (False, wrong)
    if (name, is_single) == ("KITTI 2", False):
        return  # a straight street at an even speed is as well explained 0.3 s later
    for seconds in (-0.3, 0.3):
        is_accepted, convention = verdict(shifted(sequence, seconds))
        assert not is_accepted
        assert abs(float(convention.removeprefix("shift=")) + seconds) < 0.06
