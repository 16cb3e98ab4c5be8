"""SLAM on recordings with truth: error, drift, loops, frames a second; what is asked beside what is
measured.

    python benchmarks/slam_accuracy.py [--shared ../shared] [--corridor PATH] [--street PATH]
    [--gaps] [--panels PATH] [--json FILE]

The rendered recordings are made by ``topoloc simulate corridor PATH --laps 2`` and ``topoloc
simulate street PATH``; what is missing is skipped. With ``--gaps`` recordings follow from which
frames were taken out; their ATE is to be compared with that of the whole. With ``--panels`` (such
as ``topoloc simulate hospital PATH --spacing 0.3 --look -80 --draft --size 480x300 --num-frames
100``) it follows without 4 of every 24 frames, from eight starts. "Silent" are steps between two
poses of one world that are more than 0.3 m off. Frames a second are of
the whole (reading, loops, optimisation) on the clock, and of the processor time with two cores at
work, which other programs on the machine disturb less.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import RecordingError
from topoloc.geometry.alignment import (
    absolute_trajectory_errors,
    align_trajectories,
    relative_drift,
)
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence
from topoloc.slam.slam import run_slam


@dataclass(frozen=True)
class Recording:
    """Hold a recording, and the requirements of SLAM on it."""

    name: str
    path: str
    asked: str


RECORDINGS = (
    Recording(
        "KITTI street 1",
        "kitti/sequences/street1",
        "drift 0.8 %, 0.004 deg/m; ATE 0.35 m; 12 frames/s",
    ),
    Recording(
        "KITTI street 2",
        "kitti/sequences/street2",
        "drift 0.8 %, 0.004 deg/m; ATE 0.35 m; 12 frames/s",
    ),
    Recording("ZED session 1", "zed_lab/session1", "ATE 1.5 cm; 20 frames/s"),
    Recording("ZED session 2", "zed_lab/session2@0:99", "ATE 1.5 cm; 20 frames/s"),
    Recording("EuRoC part", "euroc/v1_01_part", "all 50 pairs; right residual 0.7 px"),
    Recording("kitchen, RGB-D", "seven_scenes/kitchen", "ATE 4 cm"),
)

GAPS = (
    ("ZED session 1", "zed_lab/session1", 10, 30),
    ("kitchen", "seven_scenes/kitchen", 20, 50),
    ("kitchen", "seven_scenes/kitchen", 40, 100),
)
"""Name, path, how many frames are taken out of how many."""


def with_gaps(name: str, path: str, num_out: int, period: int) -> Recording:
    """The recording without the last `num_out` of every `period` frames."""
    kept = ",".join(
        f"{start}:{start + period - num_out}"
        for start in range(0, len(open_sequence(path)), period)
    )
    return Recording(
        f"{name}, {num_out} of every {period} frames out",
        f"{path}@{kept}",
        "95 % of the frames; ATE 1.3 x the whole",
    )


def without_four(path: str) -> list[Recording]:
    """The recording without 4 of every 24 frames, from eight starts."""
    num, recordings = len(open_sequence(path)), list[Recording]()
    for start in range(0, 24, 3):
        kept = [i for i in range(num) if (i + start) % 24 >= 4]
        rows = ",".join(f"{i}:{i + 1}" for i in kept)
        recordings.append(Recording(f"panels, {start}", f"{path}@{rows}", "no silent step"))
    return recordings


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    )
    parser.add_argument("--corridor", help="rendered, two laps")
    parser.add_argument("--street", help="rendered, one lap")
    parser.add_argument(
        "--gaps", action="store_true", help="also recordings from which frames were taken out"
    )
    parser.add_argument("--panels", help="rendered, of a wall that repeats itself")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    recordings = [
        Recording(r.name, str(arguments.shared / "data" / r.path), r.asked) for r in RECORDINGS
    ]
    if arguments.corridor:
        recordings.append(
            Recording(
                "rendered corridor",
                arguments.corridor,
                "ATE 5 cm, between the laps 3 cm; 20 frames/s",
            )
        )
    if arguments.street:
        recordings.append(Recording("rendered street", arguments.street, "ATE 1.5 m, drift 0.7 %"))
    if arguments.gaps:
        recordings += [
            with_gaps(name, str(arguments.shared / "data" / path), *out)
            for name, path, *out in GAPS
        ]
    if arguments.panels:
        recordings += without_four(arguments.panels)
    run_slam(open_sequence(recordings[-1].path))  # compiles
    rows = []
    print(
        "| recording | asked | tracked | key frames | loops | ATE | between laps | drift | right"
        " residual | silent | pieces, joined | frames/s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for recording in recordings:
        try:
            row = measure(recording)
        except RecordingError as error:
            print(f"| {recording.name} | skipped: {error} |")
            continue
        rows.append(row)
        print(table_line(row), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def measure(recording: Recording) -> dict[str, Any]:
    sequence = open_sequence(recording.path)
    clock, processor = time.perf_counter(), time.process_time()
    result = run_slam(sequence)
    clock, processor = time.perf_counter() - clock, time.process_time() - processor
    row: dict[str, Any] = {
        "recording": recording.name,
        "asked": recording.asked,
        "frames": len(sequence),
        "tracked": sum(pose is not None for pose in result.poses[0]),
        "keyframes": result.num_keyframes,
        "loops": result.num_loops,
        "pieces": f"{result.num_submaps}, {result.num_joined}",
        "silent": num_silent(sequence.poses, [result.poses[0], *result.apart[0]]),
        "frames_per_second": len(sequence) / clock,
        "frames_per_second_of_processor": 2 * len(sequence) / processor,
    }
    if len(result.right_residuals_px):
        row["right_residual_px"] = float(np.nanmedian(result.right_residuals_px))
    both = [
        (t, p)
        for t, p in zip(sequence.poses, result.poses[0], strict=True)
        if t is not None and p is not None
    ]
    if both:
        truth, found = [t for t, _ in both], [p for _, p in both]
        row["ate_m"] = float(np.sqrt(np.mean(absolute_trajectory_errors(truth, found) ** 2)))
        row["between_laps_m"] = gap_between_laps(truth, found)
        drift = relative_drift(truth, found)
        if drift:
            row["drift_percent"], row["drift_deg_per_m"] = (
                100 * drift.translation,
                float(np.rad2deg(drift.rotation)),
            )
    return row


def num_silent(truth: list[Rigid3 | None], worlds: list[list[Rigid3 | None]]) -> int:
    """Number of steps between two successive poses of one world that are over 0.3 m off."""
    num = 0
    for poses in worlds:
        known = [
            (t, p) for t, p in zip(truth, poses, strict=True) if t is not None and p is not None
        ]
        for (true, pose), (next_true, next_pose) in pairwise(known):
            walked, found = true.inverse() @ next_true, pose.inverse() @ next_pose
            num += bool(np.linalg.norm(walked.translation - found.translation) > 0.3)
    return num


def gap_between_laps(truth: list[Rigid3], found: list[Rigid3]) -> float | None:
    """Return the median error (metres) of frames of a second lap, relative to the nearest frame of
    the first."""
    positions = np.array([pose.translation for pose in truth])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    aligned = align_trajectories(truth, found)
    errors = np.array([(aligned @ pose).translation for pose in found]) - positions
    gaps = []
    for i in range(len(truth)):
        before = np.flatnonzero(way < way[i] - 20.0)
        if len(before):
            nearest = before[np.argmin(np.linalg.norm(positions[before] - positions[i], axis=1))]
            if np.linalg.norm(positions[nearest] - positions[i]) < 0.5:
                gaps.append(float(np.linalg.norm(errors[i] - errors[nearest])))
    return float(np.median(gaps)) if gaps else None


def table_line(row: dict[str, Any]) -> str:
    def shown(key: str, scale: float, unit: str, digits: int = 2) -> str:
        value = row.get(key)
        return "" if value is None else f"{scale * value:.{digits}f} {unit}"

    drift = ", ".join(
        filter(None, [shown("drift_percent", 1, "%"), shown("drift_deg_per_m", 1, "deg/m", 4)])
    )
    speed = f"{row['frames_per_second']:.0f} ({row['frames_per_second_of_processor']:.0f})"
    return (
        f"| {row['recording']} | {row['asked']} | {row['tracked']} of {row['frames']} |"
        f" {row['keyframes']} | {row['loops']} | {shown('ate_m', 100, 'cm')} |"
        f" {shown('between_laps_m', 100, 'cm')} | {drift} | {shown('right_residual_px', 1, 'px')} |"
        f" {row['silent']} | {row['pieces']} |"
        f" {speed} |"
    )


if __name__ == "__main__":
    main()
