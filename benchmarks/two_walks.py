"""Two walks of one place: one maps it by stereo or RGB-D, single images of the other are localized,
each alone, with a known camera. Success, mean, 99 %, and maximum of the error, and milliseconds, on
the protocol by which NVIDIA reports cuVGL (success: an answer; its own figures are of one to four
stereo cameras: 72 to 85 %, mean 7 to 8 cm).

    python benchmarks/two_walks.py NAME=MAP_SEQ,QUERY_SEQ ... [--shared ../shared] [--json FILE]

The recordings share one world (`topoloc simulate hospital h1 --lateral -0.8` and `... h1-near
--take 1 --mono`). With --shared ZED's two sessions are asked in both directions, too; the truth of
these is a tracker's, fitted by one transform.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from topoloc import (
    Localization,
    Localizer,
    Rigid3,
    StereoSequence,
    TopoMetricMap,
    build_map,
    open_sequence,
)

WRONG_M, WRONG_DEG = 0.3, 10.0


def measure(topomap: TopoMetricMap, asked: StereoSequence, map_from_asked: Rigid3) -> dict:
    """Return the figures of all images with a known pose."""
    localizer, off, turned, times, num = Localizer(topomap), [], [], [], 0
    localizer.localize(asked[0].image, asked[0].camera)  # compiles
    for index, pose in enumerate(asked.poses):
        if pose is None:
            continue
        frame, truth = asked[index], map_from_asked @ pose
        result, num = localizer.localize(frame.image, frame.camera), num + 1
        times.append(result.times_ms["total"])
        if isinstance(result, Localization):
            apart = truth.inverse() @ result.world_from_cam
            off.append(float(np.linalg.norm(apart.translation)))
            turned.append(float(np.degrees(apart.angle())))
    wrong = (np.array(off) > WRONG_M) | (np.array(turned) > WRONG_DEG)
    return {
        "images": num,
        "success": len(off) / num,
        "wrong": int(wrong.sum()),
        "mean_m": float(np.mean(off)) if off else None,
        "p99_m": float(np.percentile(off, 99)) if off else None,
        "max_m": max(off, default=None),
        "median_ms": float(np.median(times)),
    }


def nearest_m(mapped: StereoSequence, asked: StereoSequence, map_from_asked: Rigid3) -> float:
    """Return the median distance of the second walk from the first."""
    a = np.array([pose.translation for pose in mapped.poses if pose is not None])
    b = [(map_from_asked @ pose).translation for pose in asked.poses if pose is not None]
    return float(np.median([np.linalg.norm(a - one, axis=1).min() for one in b]))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("walks", nargs="*")
    parser.add_argument("--shared", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rows: list[tuple[str, str, str, Rigid3]] = []
    for text in options.walks:
        name, _, paths = text.partition("=")
        mapped, asked = paths.split(",")
        rows.append((name, mapped, asked, Rigid3.identity()))
    if options.shared is not None:
        lab = options.shared / "data/zed_lab"
        matrix = json.loads((lab / "session1_from_session2.json").read_text())
        known = Rigid3.from_matrix(matrix["session1_from_session2"])
        one, two = str(lab / "session1"), f"{lab / 'session2'}@0:99"
        rows += [("ZED 2 in 1", one, two, known), ("ZED 1 in 2", two, one, known.inverse())]
    facts: list[dict[str, Any]] = []
    maps: dict[str, TopoMetricMap] = {}
    for name, mapped, asked, map_from_asked in rows:
        if mapped not in maps:
            maps = {mapped: build_map(mapped)}
        sequence = open_sequence(asked)
        apart = nearest_m(open_sequence(mapped), sequence, map_from_asked)
        row = {"name": name, "apart_m": apart} | measure(maps[mapped], sequence, map_from_asked)
        facts.append(row)
        cm = [f"{100 * row[k]:.1f}" if row[k] is not None else "-" for k in list(row)[5:8]]
        print(
            f"{name}: {row['apart_m']:.1f} m apart, {100 * row['success']:.0f} % of"
            f" {row['images']}, {row['wrong']} wrong; mean {cm[0]}, 99 % {cm[1]}, at most {cm[2]}"
            f" cm; {row['median_ms']:.0f} ms",
            flush=True,
        )
    if options.json is not None:
        options.json.write_text(json.dumps(facts, indent=1) + "\n")


if __name__ == "__main__":
    main()
