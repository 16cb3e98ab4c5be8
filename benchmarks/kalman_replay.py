"""A small Kalman filter that fuses odometry with the poses that a robot gets.

    python benchmarks/kalman_replay.py [--map MAP] [--seeds 3]

Replays the demo's lab by day, and by night with things moved, with drifting odometry. Images of
other places, darkness and a kidnapping come in between. The poses that pass the health gate
correct an error-state filter on SE(3) with their covariances, without any gate of its own. Errors
are the root mean square over a replay, for the filter and for dead reckoning from the true start.
The filter may not be worse than dead reckoning by more than a tenth: exit status 1.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from topoloc.apps.robots.map_to_odom import HealthGate, MeasuredPose
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc.tracking.tracker import Tracker

TESTS = Path(__file__).parents[1] / "tests"
sys.path.insert(0, str(TESTS))
from played_robot import Step  # noqa: E402

DEMO = Path(__file__).parents[1] / "src" / "topoloc" / "demo" / "lab"
INTERVAL_NS = 520_000_000  # of the demo's recordings
MAX_RATIO = 1.1


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    args = parser.parse_args()
    laps = [open_sequence(DEMO / "map_lap1"), open_sequence(DEMO / "map_lap2")]
    localizer = Localizer(TopoMetricMap.load(args.map) if args.map else build_map(laps))
    worst = 0.0
    print(f"{'scene':22} {'filter':>8} {'odometry':>8} {'ratio':>6}  poses, wrong")
    for name, (camera, steps) in make_scenes().items():
        for seed in range(args.seeds):
            filtered, reckoned, poses = replay(localizer, camera, steps, seed)
            ratio = rms(filtered) / rms(reckoned)
            wrong, worst = int((poses > 0.3).sum()), max(worst, ratio)
            cells = f"{rms(filtered):6.3f} m {rms(reckoned):6.3f} m {ratio:6.2f}"
            print(f"{name:22} {cells}  {len(poses)}, {wrong}", flush=True)
    raise SystemExit(int(worst > MAX_RATIO))


def make_scenes() -> dict[str, tuple[Camera, list[Step]]]:
    """Return camera and steps of each scene."""
    camera, day = steps_of("day")
    _, night = steps_of("night")
    elsewhere = [step.picture for name in ("corridor", "street") for step in steps_of(name)[1]]
    wrong, dark = list(day), list(day)
    for number in range(len(day)):
        if number % 8 >= 4:  # other buildings, then the other side of this room
            pictures = elsewhere if number < 16 else [step.picture for step in day[::-1]]
            wrong[number] = replace(day[number], picture=pictures[number % len(pictures)])
        if 8 <= number < 20 or number >= 28:
            dark[number] = replace(day[number], picture=np.zeros_like(day[0].picture))
    carried = [*day[:10], replace(day[22], is_carried=True), *day[23:]]
    mirrored = [*night[:12], replace(night[24], is_carried=True), *night[25:]]
    return {
        "day": (camera, day),
        "images of elsewhere": (camera, wrong),
        "darkness": (camera, dark),
        "kidnapping": (camera, carried),
        "things moved, night": (camera, night),
        "the same, kidnapping": (camera, mirrored),
    }


def steps_of(name: str) -> tuple[Camera, list[Step]]:
    sequence, steps = open_sequence(DEMO / name), list[Step]()
    frames = [sequence[index] for index in range(len(sequence))]
    for frame in frames:
        steps.append(Step(frame.world_from_cam or Rigid3.identity(), frame.image))
    camera = frames[0].camera
    if camera is None:
        raise SystemExit(f"{name}: no calibration")
    return camera, steps


def replay(
    localizer: Localizer, camera: Camera, steps: list[Step], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors in metres of the filter, of dead reckoning and of the published poses."""
    odometry = measured_odometry(steps, seed)
    tracker, gate = Tracker(localizer), HealthGate()
    filtered = Filter(steps[0].world_from_cam)
    travelled, errors, reckoned, poses = np.zeros(2), list[float](), list[float](), list[float]()
    for number, step in enumerate(steps):
        t_ns, odom_from_cam = number * INTERVAL_NS, odometry[number]
        if number:
            motion = odometry[number - 1].inverse() @ odom_from_cam
            way, turn = float(np.linalg.norm(motion.translation)), motion.angle()
            travelled = travelled + np.array([way, turn])
            filtered.predict(motion, gate.odometry_error * np.repeat([way, turn], 3) + 1e-3)
        picture = step.picture ^ np.uint8(number % 2)  # a dark camera has noise as well
        answer = tracker.process(picture, camera, t_ns, odom_from_cam)
        covariance = answer.smoothed_covariance
        is_measured = isinstance(answer.result, Localization) and not answer.is_repeated
        if is_measured and answer.smoothed is not None and covariance is not None:
            is_localized = answer.state == "localized"
            evidence = MeasuredPose(
                t_ns, answer.smoothed, covariance, odom_from_cam, travelled, is_localized
            )
            is_sure = answer.result.probability >= gate.min_probability
            if is_sure and gate.judge(evidence) != "doubted":
                filtered.update(answer.smoothed, evidence.local_covariance)
                poses.append(distance(answer.smoothed, step.world_from_cam))
        errors.append(distance(filtered.pose, step.world_from_cam))
        dead = steps[0].world_from_cam @ odometry[0].inverse() @ odom_from_cam
        reckoned.append(distance(dead, step.world_from_cam))
    return np.array(errors), np.array(reckoned), np.array(poses)


def measured_odometry(steps: list[Step], seed: int) -> list[Rigid3]:
    """Return odom_from_cam of each step: the scale, the turn and the noise of each drive are
    drawn."""
    rng, poses = np.random.default_rng(seed), [Rigid3.identity()]
    scale, turn = 1.0 + rng.normal(0.0, 0.02), rng.normal(0.0, 0.02)
    for before, after in pairwise(steps):
        motion = Rigid3.identity()
        if not after.is_carried:
            motion = before.world_from_cam.inverse() @ after.world_from_cam
        way = float(np.linalg.norm(motion.translation))
        noise = rng.normal(0.0, 0.01, 6) * way + [0.0, 0.0, 0.0, 0.0, turn * way, 0.0]
        scaled = Rigid3(motion.rotation, scale * motion.translation)
        poses.append(poses[-1] @ scaled @ Rigid3.exp(noise))
    return poses


class Filter:
    """An error-state Kalman filter of a pose. The error is the right perturbation."""

    def __init__(self, pose: Rigid3) -> None:
        self.pose, self.covariance = pose, np.diag([1e-4] * 6)

    def predict(self, motion: Rigid3, sigmas: np.ndarray) -> None:
        moved = motion.inverse().transform_covariance(self.covariance)
        self.pose, self.covariance = self.pose @ motion, moved + np.diag(sigmas**2)

    def update(self, pose: Rigid3, covariance: np.ndarray) -> None:
        error = (self.pose.inverse() @ pose).log()
        gain = np.linalg.solve(self.covariance + covariance, self.covariance).T
        self.pose = self.pose @ Rigid3.exp(gain @ error)
        self.covariance = (np.eye(6) - gain) @ self.covariance


def distance(one: Rigid3, other: Rigid3) -> float:
    return float(np.linalg.norm(one.translation - other.translation))


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


if __name__ == "__main__":
    main()
