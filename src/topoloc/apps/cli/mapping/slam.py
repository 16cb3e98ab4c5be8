"""topoloc slam SEQ OUT.tum."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from topoloc import Trajectory, run_slam
from topoloc.apps.cli.output import (
    CameraOption,
    File,
    Format,
    MaskOption,
    Topics,
    check_outputs,
    describe_recording,
    open_recording,
    print_fields,
    print_line,
    print_warning,
    progress_bar,
    write_json,
)


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc slam`."""

    sequence: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SEQ")]
    """A stereo or RGB-D recording. PATH@0::2 takes every second frame of PATH."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT.tum")]
    """The trajectory to write: t tx ty tz qx qy qz qw, world_from_cam. The world is the camera of
    the first frame."""
    format: Format = None
    camera: CameraOption = None
    mask: MaskOption = None
    topics: Topics = None
    json: File = None
    """Write the printed facts as JSON to this file (- for standard output)."""

    def run(self) -> int:
        check_outputs([self.out, self.json], [self.sequence, self.mask])
        words = self.sequence, self.format, self.camera, self.topics
        sequence = open_recording(*words, whole_only=True, mask=self.mask)
        if self.json != "-":
            print_line(describe_recording(*words[:3], sequence))
        start = time.perf_counter()
        with progress_bar() as progress:
            result = run_slam(sequence, progress, print_warning)
        seconds = time.perf_counter() - start
        Trajectory.of_frames(result.poses[0], sequence.t_ns).write_tum(Path(self.out))
        rate = round(len(sequence) / seconds, 2)
        facts = result.to_json(sequence) | {"frames_per_second": rate}
        if self.json != "-":
            _print(self.out, facts)
        write_json(self.json, facts)
        return 0


def _print(out: str, facts: dict[str, Any]) -> None:
    submaps, frames = str(facts["num_submaps"]), f"{facts['num_tracked']} of {facts['num_frames']}"
    if apart := facts["num_submaps"] - facts["num_joined"]:
        submaps += f"; {apart} could not be joined, and their frames are left out"
    rows = [
        ("trajectory", f"{out}, {frames} frames, {facts['length_m']:.1f} m"),
        ("key frames", str(facts["num_keyframes"])),
        ("loops", str(facts["num_loops"])),
        ("sub-maps", submaps),
        ("frames a second", f"{facts['frames_per_second']:.1f}"),
    ]
    if "ate_m" in facts:
        errors = f"{facts['ate_m']:.4f} m, at most {facts['max_error_m']:.4f} m"
        rows.append(("error (ATE)", errors))
    if facts.get("drift_percent") is not None:
        drift = f"{facts['drift_percent']:.2f} %, {facts['drift_deg_per_m']:.4f} deg/m"
        rows.append(("drift", drift))
    print_fields(rows)
