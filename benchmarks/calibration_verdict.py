"""Of wrong calibrations (5 % of focal length or width, k1 of 0.1), how many do N pictures in a row
name; how often is a right one accused?

python benchmarks/calibration_verdict.py kitchen.topo kitchen@60-99/100 --every 3
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from topoloc.geometry.calibration_check import (
    CalibrationConsistency,
    IntrinsicsDeviation,
    check_calibration_consistency,
)
from topoloc.geometry.camera import MODELS, Camera
from topoloc.localization.localizer import Localizer
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence


class Change(NamedTuple):
    """How a calibration is wrong: focal length times `scale`, principal point moved by shares of
    the width, and a lens that the camera has not."""

    scale: float = 1.0
    across: float = 0.0
    down: float = 0.0
    k1: float = 0.0

    def of(self, camera: Camera) -> Camera:
        values = dict(zip(MODELS[camera.model], camera.params, strict=True))
        values |= {name: self.scale * values[name] for name in ("f", "fx", "fy") if name in values}
        values["cx"] += self.across * camera.width
        values["cy"] += self.down * camera.width
        if not self.k1:
            return replace(camera, params=tuple(values.values()))
        assert not camera.is_distorted, "a pinhole camera is needed"
        parameters = camera.fx, camera.fy, camera.cx, camera.cy, self.k1, 0.0, 0.0, 0.0
        return Camera("OPENCV", camera.width, camera.height, parameters)

    def is_named(self, verdict: CalibrationConsistency) -> bool:
        if self.k1:
            return verdict.has_distortion_mismatch
        is_focal = self.scale != 1.0
        return verdict.has_focal_mismatch if is_focal else verdict.has_principal_point_mismatch


RIGHT = Change()
WRONG = (
    *(Change(scale=one) for one in (0.95, 1.05)),
    *(Change(across=one) for one in (0.05, -0.05)),
    *(Change(down=one) for one in (0.05, -0.05)),
    *(Change(k1=one) for one in (0.1, -0.1)),
)
NUM_PICTURES = (5, 10, 15, 20)


def seen_with(
    localizer: Localizer, sequence: StereoSequence, every: int, case: Change
) -> tuple[list[IntrinsicsDeviation], Camera]:
    """Return the estimated camera of each image, and the calibration of the queries."""
    first = sequence[0].camera
    assert first is not None, "a recording with a calibration is needed"
    camera = case.of(first)
    results = [
        localizer.localize(sequence[index].image, camera)
        for index in range(0, len(sequence), every)
    ]
    return [result.seen_camera for result in results if result.seen_camera is not None], camera


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map")
    parser.add_argument("recording", help="of one camera, rightly calibrated")
    parser.add_argument("--every", type=int, default=1, help="ask every Nth frame")
    parser.add_argument("--json", type=Path, help="write the counts to this file")
    args = parser.parse_args()
    localizer, sequence = Localizer(TopoMetricMap.load(args.map)), open_sequence(args.recording)
    counts = {(num, is_right): [0, 0] for num in NUM_PICTURES for is_right in (True, False)}
    for case in (RIGHT, *WRONG):
        seen, camera = seen_with(localizer, sequence, args.every, case)
        for num in NUM_PICTURES:
            verdicts = [
                check_calibration_consistency(seen[first : first + num], camera)
                for first in range(len(seen) - num + 1)
            ]
            said = [case.is_named(one) for one in verdicts if one is not None]
            accused = [one.is_contradicted for one in verdicts if one is not None]
            counts[num, case == RIGHT][0] += sum(accused if case == RIGHT else said)
            counts[num, case == RIGHT][1] += len(said)
    for num in NUM_PICTURES:
        (accused, of), (named, of_wrong) = counts[num, True], counts[num, False]
        print(
            f"{num:3d} pictures: {named} of {of_wrong} wrong calibrations named, {accused} of {of}"
            " right ones accused"
        )
    if args.json:
        columns = ("accused", "right", "named", "wrong")
        rows = {
            num: dict(zip(columns, (*counts[num, True], *counts[num, False]), strict=True))
            for num in NUM_PICTURES
        }
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
