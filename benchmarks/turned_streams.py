"""Streams with quick turns, motion blur and dark seconds, with a gyroscope and without it:
`benchmarks/streams.py --turns`.

The images of a recording are turned about the camera's centre as if by a hand, which a homography
does exactly: every 1.5 s by up to 90 degrees of roll and a few of pan and tilt, within 0.25 s. An
image is the mean over an exposure of 33 ms, so it is blurred. Two stretches of 1.5 s are dark. The
gyroscope's rates are those of the turned truth, 200 a second, in axes of its own that are not
given, with the noise and the bias of a phone's (0.01 deg/s/sqrt(Hz), 1 deg/s).

An image is lost if it has no pose, measured or predicted, within 0.5 m and 5 degrees of the truth.

    python benchmarks/turned_streams.py (a part of `streams.py --turns`)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3, log_so3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.recordings.frame import StereoFrame
from topoloc.tracking.gyroscope import Gyroscope
from topoloc.tracking.stream_result import StreamedPose
from topoloc.tracking.tracker import Tracker

SHARE = 0.7  # of the width and height that is left, so that no pan leaves the image
EXPOSURE, STEP = 0.033, 0.005  # seconds
BIAS, NOISE = np.radians(1.0), np.radians(0.01) / np.sqrt(STEP)  # rad/s
CAM_FROM_IMU = exp_so3(np.array([0.3, -2.1, 0.8]))
MAX_METRES, MAX_RADIANS = 0.5, np.radians(5.0)  # of a pose that is not lost


def compare_with_gyroscope(
    localizer: Localizer, frames: list[StereoFrame], truths: list[Rigid3]
) -> dict[str, int]:
    """Print how a stream of turned images does without and with a gyroscope. Return the images
    lost."""
    frames, truths, samples = turn_frames(frames, truths)
    lost = dict[str, int]()
    for name in ("without gyroscope", "with gyroscope"):
        gyroscope = Gyroscope() if name == "with gyroscope" else None
        for sample in samples if gyroscope else ():
            gyroscope.add(*sample)
        tracker = Tracker(localizer, gyroscope=gyroscope)
        answers = [tracker.process(one.image, one.camera, one.t_ns) for one in frames]
        lost[name.replace(" ", "_")] = report(f"turned, {name}", answers, truths)
        if gyroscope is not None:
            bias = ", ".join(f"{value:.1f}" for value in np.degrees(gyroscope.bias))
            print(f"  {'bias found (true: 1.0, -0.6, 0.4)':<44} {'':>9}   {bias} deg/s")
    return lost


def report(name: str, answers: list[StreamedPose], truths: list[Rigid3]) -> int:
    """Print the figures of a stream, and return the number of lost images."""
    measured = [
        translation_error(answer.result.world_from_cam, truth)
        for answer, truth in zip(answers, truths, strict=True)
        if isinstance(answer.result, Localization)
    ]
    num_lost = sum(
        answer.smoothed is None
        or translation_error(answer.smoothed, truth) > MAX_METRES
        or rotation_error(answer.smoothed, truth) > MAX_RADIANS
        for answer, truth in zip(answers, truths, strict=True)
    )
    print(
        f"  {name:<26} {num_lost:4d} of {len(answers)} images lost; {len(measured)} measured poses,"
        f" median {1e3 * np.median(measured):.1f} mm, largest {1e3 * max(measured):.1f} mm"
    )
    return num_lost


def turn_frames(
    frames: list[StereoFrame], truths: list[Rigid3], seed: int = 1
) -> tuple[list[StereoFrame], list[Rigid3], list[tuple[int, np.ndarray]]]:
    """Return the turned frames, their truth, and the gyroscope's samples."""
    rng = np.random.default_rng(seed)
    times = np.array([frame.t_ns for frame in frames]) / 1e9
    turned = make_turns(times, rng)
    camera = cropped(frames[0].camera)
    dark = np.zeros(len(frames), bool)
    for share in (0.4, 0.75):
        start = times[0] + share * (times[-1] - times[0])
        dark |= (times >= start) & (times < start + 1.5)
    images = []
    for frame, time, is_dark in zip(frames, times, dark, strict=True):
        image = expose(frame, camera, turned, time)
        if is_dark:
            image = np.clip(rng.normal(4.0, 2.0, image.shape), 0, 255).astype(np.uint8)
        images.append(image)
    made = [
        replace(frame, image=image, camera=camera)
        for frame, image in zip(frames, images, strict=True)
    ]
    poses = [
        truth @ Rigid3(turned(time), np.zeros(3)) for truth, time in zip(truths, times, strict=True)
    ]
    return made, poses, measure_rates(times, truths, turned, rng)


def make_turns(times: np.ndarray, rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """Return the rotation old_from_turned at a time."""
    interval, duration, sizes = 1.5, 0.25, np.radians([4.0, 5.0, 90.0])
    starts = np.arange(times[0] + interval, times[-1] + interval, interval)
    targets = np.vstack([np.zeros(3), rng.uniform(-sizes, sizes, (len(starts), 3))])

    def rotation(time: float) -> np.ndarray:
        row = int(np.searchsorted(starts, time, side="right"))
        if row == 0:
            return np.eye(3)
        share = min((time - starts[row - 1]) / duration, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        pan, tilt, roll = targets[row - 1] + smooth * (targets[row] - targets[row - 1])
        return exp_so3(np.array([tilt, pan, 0.0])) @ exp_so3(np.array([0.0, 0.0, roll]))

    return rotation


def cropped(camera: Camera) -> Camera:
    width, height = round(SHARE * camera.width), round(SHARE * camera.height)
    focal = camera.fx
    return Camera.pinhole(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def expose(
    frame: StereoFrame, camera: Camera, turned: Callable[[float], np.ndarray], time: float
) -> np.ndarray:
    """Return the mean of the turned images over the exposure, whose middle is `time`."""
    num, total = 9, 0.0
    for share in np.linspace(-0.5, 0.5, num):
        old_from_new = frame.camera.matrix() @ turned(time + share * EXPOSURE)
        old_from_new = old_from_new @ np.linalg.inv(camera.matrix())
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size = (camera.width, camera.height)
        total = total + cv2.warpPerspective(frame.image, old_from_new, size, flags=flags).astype(
            np.float32
        )
    return np.rint(total / num).astype(np.uint8)


def measure_rates(
    times: np.ndarray,
    truths: list[Rigid3],
    turned: Callable[[float], np.ndarray],
    rng: np.random.Generator,
) -> list[tuple[int, np.ndarray]]:
    """Return the gyroscope's samples: time (ns) and rates in its own axes, rad/s."""
    grid = np.arange(times[0], times[-1], STEP)
    rows = np.clip(np.searchsorted(times, grid, side="right") - 1, 0, len(times) - 2)
    shares = (grid - times[rows]) / (times[rows + 1] - times[rows])
    poses = [
        truths[row].interpolate(truths[row + 1], share).rotation @ turned(time)
        for row, share, time in zip(rows, shares, grid, strict=True)
    ]
    bias = BIAS * np.array([1.0, -0.6, 0.4])
    samples = []
    for before, after, time in zip(poses, poses[1:], grid, strict=False):
        rate = CAM_FROM_IMU.T @ log_so3(before.T @ after) / STEP
        noise = rng.normal(0.0, NOISE, 3)
        samples.append((round((time + STEP / 2) * 1e9), rate + bias + noise))
    return samples
