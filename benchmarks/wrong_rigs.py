"""Wrong and right rigs, localized instant by instant: which cameras are named, which poses wrong?

    python benchmarks/wrong_rigs.py MAP FOLDER [--rounds N] [--every N] [--json FILE]

FOLDER has rig.json, a recording for each camera and true poses. In each round one camera of each
instant is dead (a uniform image with noise), swapped with another, turned by 5 degrees or shifted
by 30 cm in a random direction. A fault is named if `left_out` has the camera, of a swap both.
`known` counts the faults of cameras that the map localizes alone. `late` are images of the instant
after. A right rig is accused if `left_out` has any camera. Wrong: beyond 0.25 m or 2 degrees.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from topoloc import Image, Localizer, Rig, RigCamera, Rigid3, RigLocalization, RigLocalizer
from topoloc.apps.formats.rig import open_instants
from topoloc.rigs.rig import RigFrame

Faulty = tuple[Rig, dict[str, Image], tuple[str, ...]]
Fault = Callable[[RigFrame, str, str, np.random.Generator], Faulty]
COLUMNS = ("rig", "instants", "localized", "wrong", "named", "known", "named", "accused others")


def _move(frame: RigFrame, name: str, rig_from_moved: Rigid3) -> Faulty:
    cameras = dict[str, RigCamera](frame.mounted.cameras)
    of = cameras[name]
    cameras[name] = replace(of, rig_from_cam=of.rig_from_cam @ rig_from_moved)
    return Rig(cameras), dict(frame.images), (name,)


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def turn(frame: RigFrame, name: str, _: str, rng: np.random.Generator) -> Faulty:
    """Turn the mounting of a camera by 5 degrees."""
    xi = np.concatenate([np.zeros(3), np.deg2rad(5.0) * _direction(rng)])
    return _move(frame, name, Rigid3.exp(xi))


def shift(frame: RigFrame, name: str, _: str, rng: np.random.Generator) -> Faulty:
    """Shift the mounting of a camera by 30 cm."""
    return _move(frame, name, Rigid3(np.eye(3), 0.3 * _direction(rng)))


def kill(frame: RigFrame, name: str, _: str, rng: np.random.Generator) -> Faulty:
    """Replace an image by one of a covered sensor: a level with noise."""
    shape = frame.images[name].shape
    noise = rng.normal(rng.uniform(0, 30), rng.uniform(0, 1.5), shape)
    images = dict(frame.images) | {name: np.clip(noise, 0, 255).astype(np.uint8)}
    return frame.mounted, images, (name,)


def swap(frame: RigFrame, name: str, other: str, _: np.random.Generator) -> Faulty:
    """Exchange the images of two cameras."""
    exchanged = {name: frame.images[other], other: frame.images[name]}
    return frame.mounted, dict(frame.images) | exchanged, (name, other)


def keep(frame: RigFrame, name: str, other: str, _: np.random.Generator) -> Faulty:
    """Leave the rig as it is."""
    return frame.mounted, dict(frame.images), ()


FAULTS: dict[str, Fault] = {
    "right": keep,
    "dead": kill,
    "swapped": swap,
    "turned 5 deg": turn,
    "shifted 30 cm": shift,
}


def judge(localizer: Localizer, frame: RigFrame, faulty: Faulty, known: set[str]) -> Counter[str]:
    """Return the counts of one instant."""
    rig, images, names = faulty
    result = RigLocalizer(localizer, rig).localize(images)
    truth = frame.world_from_cam
    assert truth is not None
    counts = Counter(instants=1, localized=int(result.localized))
    if isinstance(result, RigLocalization):
        counts["wrong"] = not truth.is_same(result.world_from_rig, 0.25, np.deg2rad(2.0))
    is_named, is_known = set(names) <= result.left_out.keys(), set(names) <= known
    counts["named"] = is_named and bool(names)
    counts["known"] = is_known and bool(names)
    counts["named of known"] = is_named and counts["known"]
    counts["accused"] = bool(result.left_out.keys() - set(names))
    return counts


def main() -> None:
    """Print a row for each fault."""
    parser = argparse.ArgumentParser(
        description="Count which cameras of wrong and right rigs are named."
    )
    parser.add_argument("map")
    parser.add_argument("folder")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--json")
    options = parser.parse_args()
    localizer, instants = Localizer(options.map), open_instants(options.folder)
    rng, counts = np.random.default_rng(0), {name: Counter[str]() for name in FAULTS}
    start = time.process_time()
    for row in range(0, len(instants), options.every):
        frame = instants[row]
        assert isinstance(frame, RigFrame)
        cameras = list(frame.images)
        alone = RigLocalizer(localizer, frame.mounted).localize(frame.images).cameras
        known = {name for name, one in alone.items() if one.localized}
        for turn_of, (fault, make) in enumerate(FAULTS.items()):
            for number in range(options.rounds if make is not keep else 1):
                k = (row // options.every + number + turn_of) % len(cameras)
                name, other = cameras[k], cameras[(k + 1) % len(cameras)]
                faulty = make(frame, name, other, rng)
                found = judge(localizer, frame, faulty, known)
                counts[fault].update(found)
                if found["wrong"] or found["accused"] or (faulty[2] and not found["named"]):
                    print(f"  {frame.name} {fault} {name}: {dict(+found)}", flush=True)
    print("  ".join(COLUMNS))
    keys = ("instants", "localized", "wrong", "named", "known", "named of known", "accused")
    for fault, of in counts.items():
        print(f"{fault:<14}", *(f"{int(of[key]):>9}" for key in keys))
    print(f"{time.process_time() - start:.0f} s of process time")
    if options.json:
        figures = {fault: {key: int(of[key]) for key in keys} for fault, of in counts.items()}
        Path(options.json).write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
