"""A stream of pictures: each is tracked from the one before where that is possible, and what the
motion does not allow for is refused.

    python examples/follow_stream.py [MAP SEQ]

Without arguments the built-in lab is asked with a walk by day, a few of whose pictures are covered
by a hand, and one of which is from another end of the room. `topoloc localize MAP SEQ --stream`
does the same.
"""

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.alignment import translation_error
from topoloc.tracking.config import HypothesesConfig
from topoloc.tracking.motion import MotionConfig

COVERED, MISPLACED = range(8, 10), 20


def main(map_file: Path | None, recording: str | None) -> None:
    if map_file is None:
        topomap = topoloc.build_map(
            [topoloc.open_sequence(SHIPPED / name) for name in ("map_lap1", "map_lap2")]
        )
    else:
        topomap = topoloc.TopoMetricMap.load(map_file)
    walk = topoloc.open_sequence(recording or SHIPPED / "day")
    # A cart at walking pace, two pictures a second: what a hand could do within half a second, it
    # cannot.
    slow = HypothesesConfig(
        motion=MotionConfig(sigma_acceleration=0.5, sigma_angular_acceleration=1.5)
    )
    tracker = topoloc.Tracker(topoloc.Localizer(topomap), topoloc.TrackerConfig(hypotheses=slow))
    states: Counter[str] = Counter()
    errors_cm = []
    for i in range(len(walk)):
        frame = walk[i]
        picture = frame.image
        if recording is None and i in COVERED:
            picture = np.full_like(picture, 90)
        if recording is None and i == MISPLACED:
            picture = walk[i - 16].image
        streamed = tracker.process(picture, frame.camera, frame.t_ns)
        states[streamed.state] += 1
        why = "" if streamed.result.localized else f" ({streamed.result.reason})"
        line = f"{frame.name}: {streamed.state}{why}"
        if streamed.smoothed is not None and frame.world_from_cam is not None:
            errors_cm.append(100.0 * translation_error(frame.world_from_cam, streamed.smoothed))
            line += f", off by {errors_cm[-1]:.2f} cm"
        print(line)
    print(", ".join(f"{count} {state}" for state, count in states.items()))
    if errors_cm:
        print(f"median error {np.median(errors_cm):.2f} cm")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", nargs="?", type=Path, help="a map file")
    parser.add_argument("recording", nargs="?", help="a recording with times")
    args = parser.parse_args()
    main(args.map, args.recording)
