"""Of wrong calibrations (5 % of focal length or width), how many do N pictures in a row name; how
often is a right one accused?

python benchmarks/calibration_verdict.py kitchen.topo kitchen@60-99/100 --every 3
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from topoloc.geometry.calibration_check import check_calibration_consistency
from topoloc.geometry.calibration_mismatch import IntrinsicsDeviation
from topoloc.geometry.camera import MODELS, Camera
from topoloc.localization.localizer import Localizer
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence

RIGHT = (1.0, 0.0, 0.0)
WRONG = (
    (0.95, 0.0, 0.0),
    (1.05, 0.0, 0.0),
    (1.0, 0.05, 0.0),
    (1.0, -0.05, 0.0),
    (1.0, 0.0, 0.05),
    (1.0, 0.0, -0.05),
)
NUM_PICTURES = (5, 10, 15, 20)


def changed(camera: Camera, scale: float, across: float, down: float) -> Camera:
    """Focal length times `scale`, principal point moved by shares of the width."""
    values = dict(zip(MODELS[camera.model], camera.params, strict=True))
    values |= {name: scale * values[name] for name in ("f", "fx", "fy") if name in values}
    values |= {"cx": values["cx"] + across * camera.width, "cy": values["cy"] + down * camera.width}
    return replace(camera, params=tuple(values.values()))


def seen_with(
    localizer: Localizer, sequence: StereoSequence, every: int, case: tuple[float, float, float]
) -> tuple[list[IntrinsicsDeviation], Camera]:
    """What each picture says, and the calibration that it was asked with."""
    first = sequence[0].camera
    assert first is not None, "a recording with a calibration is needed"
    camera = changed(first, *case)
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
            said = [
                one.has_focal_mismatch if case[0] != 1.0 else one.has_principal_point_mismatch
                for one in verdicts
                if one is not None
            ]
            accused = [one.is_contradicted for one in verdicts if one is not None]
            counts[num, case == RIGHT][0] += sum(accused if case == RIGHT else said)
            counts[num, case == RIGHT][1] += len(said)
    for num in NUM_PICTURES:
        (accused, of), (named, of_wrong) = counts[num, True], counts[num, False]
        print(
            f"{num:3d} pictures: {named} of {of_wrong} wrong calibrations named, {accused} of {of}"
            " right ones accused"
        )


if __name__ == "__main__":
    main()
