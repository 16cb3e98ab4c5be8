"""topoloc slam SEQ OUT.tum."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from topoloc import (
    Rigid3,
    SlamResult,
    StereoSequence,
    Trajectory,
    absolute_trajectory_errors,
    relative_drift,
    run_slam,
    write_tum,
)
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Format,
    Topics,
    check_outputs,
    open_recording,
    print_fields,
    progress_bar,
    write_json,
)


@dataclass(frozen=True)
class Command:
    """What `topoloc slam` takes."""

    sequence: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SEQ")]
    """A stereo or RGB-D recording. PATH@0::2 takes every second frame of PATH."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT.tum")]
    """The trajectory to write: t tx ty tz qx qy qz qw, world_from_cam; the world is the camera of
    the first frame."""
    format: Format = None
    """The recording's format: kitti, euroc, tum, seven_scenes, nerfstudio, record3d, colmap,
    rosbag, mcap, zed, video or folder."""
    camera: CameraOption = None
    """Calibration of the recording instead of its own: camera.json, OpenCV's or Kalibr's YAML,
    SN*.conf, or `fx,fy,cx,cy`."""
    topics: Topics = None
    """Of a bag, which topic is what: left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom."""
    json: File = None
    """Write what is printed to this file, too (- for standard output)."""

    def run(self) -> int:
        check_outputs([self.out, self.json])
        sequence = open_recording(self.sequence, self.format, self.camera, self.topics)
        start = time.perf_counter()
        with progress_bar() as progress:
            result = run_slam(sequence, progress)
        seconds = time.perf_counter() - start
        known = [
            (t_ns, pose)
            for t_ns, pose in zip(sequence.t_ns, result.poses[0], strict=True)
            if pose is not None
        ]
        write_tum(
            Path(self.out), Trajectory([pose for _, pose in known], [t_ns for t_ns, _ in known])
        )
        facts = describe_slam(sequence, result) | {
            "frames_per_second": round(len(sequence) / seconds, 2)
        }
        if self.json != "-":
            _print(self.out, facts)
        write_json(self.json, facts)
        return 0


def describe_slam(sequence: StereoSequence, result: SlamResult) -> dict[str, Any]:
    """What `topoloc slam` says of its result, but for the time that it took; errors where the
    recording has truth."""
    poses = result.poses[0]
    facts: dict[str, Any] = {
        "num_frames": len(poses),
        "num_tracked": sum(pose is not None for pose in poses),
        "num_keyframes": result.num_keyframes,
        "num_loops": result.num_loops,
        "num_submaps": result.num_submaps,
        "num_joined": result.num_joined,
        "length_m": round(_length([pose for pose in poses if pose is not None]), 3),
        "disparity_bias_px": round(result.disparity_bias_px[0], 3),
        "right_residual_px": _median(result.right_residuals_px),
    }
    both = [
        (true, pose)
        for true, pose in zip(sequence.poses, poses, strict=True)
        if true is not None and pose is not None
    ]
    if both:
        truth, found = [true for true, _ in both], [pose for _, pose in both]
        errors, drift = absolute_trajectory_errors(truth, found), relative_drift(truth, found)
        facts["ate_m"] = float(np.sqrt(np.mean(errors**2)))
        facts["max_error_m"] = float(errors.max())
        facts["drift_percent"] = 100.0 * drift.translation if drift else None
        facts["drift_deg_per_m"] = float(np.rad2deg(drift.rotation)) if drift else None
    return facts


def _length(poses: Sequence[Rigid3]) -> float:
    return (
        float(np.linalg.norm(np.diff([pose.translation for pose in poses], axis=0), axis=1).sum())
        if len(poses) > 1
        else 0.0
    )


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return round(float(np.median(known)), 3) if len(known) else None


def _print(out: str, facts: dict[str, Any]) -> None:
    apart = facts["num_submaps"] - facts["num_joined"]
    rows = [
        (
            "trajectory",
            (
                f"{out}, {facts['num_tracked']} of {facts['num_frames']} frames,"
                f" {facts['length_m']:.1f} m"
            ),
        ),
        ("key frames", str(facts["num_keyframes"])),
        ("loops", str(facts["num_loops"])),
        (
            "sub-maps",
            f"{facts['num_submaps']}"
            + (
                f", of which {apart} could not be joined: their frames are left out"
                if apart
                else ""
            ),
        ),
        ("frames a second", f"{facts['frames_per_second']:.1f}"),
    ]
    if "ate_m" in facts:
        rows.append(
            ("error (ATE)", f"{facts['ate_m']:.4f} m, at most {facts['max_error_m']:.4f} m")
        )
    if facts.get("drift_percent") is not None:
        rows.append(
            ("drift", f"{facts['drift_percent']:.2f} %, {facts['drift_deg_per_m']:.4f} deg/m")
        )
    print_fields(rows)
