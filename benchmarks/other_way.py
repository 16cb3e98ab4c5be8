"""Measure queries in reverse direction of a route mapped in one direction, beside the requirements.

    python benchmarks/other_way.py MAP_SEQ QUERY_SEQ [--json FILE]

Recordings are as by `topoloc simulate corridor corridor_map --laps 1` and `topoloc simulate
corridor corridor_reverse --reverse --mono --take 6` (of a map of two laps take the first:
`corridor_map@0:269`), with exact truth. A query shares content with the map if, by ground truth, at
least 50 map points seen from the other side lie in one of its virtual views. An answer is right
within 0.5 m and 5 degrees, far off beyond 0.5 m or 10 degrees. The same queries are localized
without virtual views (`walls.num_places=0`) for comparison.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import numpy as np

from topoloc.errors import MapError
from topoloc.features.extraction import make_virtual_views
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.config import VirtualViewSearchConfig
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence

CHI_SQUARE_6_AT_95 = 12.592
MIN_POINTS, MAX_METRES = 50, 60.0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mapped")
    parser.add_argument("asked")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    topomap = build_map(open_sequence(arguments.mapped))
    if topomap.sides is None:
        raise MapError(f"{arguments.mapped}: a lens too narrow for side nodes")
    sequence = open_sequence(arguments.asked)
    frames = [sequence[i] for i in range(len(sequence))]
    shown = [
        (node.summary.world_from_cam, points_world(node.summary.world_from_cam, node.points_cam))
        for node in topomap.sides.nodes
    ]
    seen_twice = [frame for frame in frames if num_seen_twice(frame, shown) >= MIN_POINTS]
    print(
        f"{len(topomap.nodes)} nodes, {len(topomap.sides.nodes)} side nodes; {len(frames)} queries,"
        f" {len(seen_twice)} see something twice"
    )
    figures = {"with side nodes": asked(Localizer(topomap), frames)}
    without = LocalizerConfig(walls=VirtualViewSearchConfig(num_places=0))
    figures["without"] = asked(Localizer(topomap, without), frames)
    for name, f in figures.items():
        print(
            f"{name}: {f['right']} right ({100 * f['right'] / max(len(seen_twice), 1):.0f} % of"
            f" what is seen twice, asked >= 40 %), {f['far_off']} far off (asked 0),"
            f" {f['answered']} answered, median {100 * f['median_m']:.1f} cm,"
            f" {100 * f['inside']:.0f} % inside the 95 % ellipsoid, {f['ms']:.0f} ms; refused"
            f" {f['reasons']}"
        )
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"queries": len(frames), "seen_twice": len(seen_twice), **figures}, indent=1)
        )


def points_world(world_from_cam: Rigid3, points_cam: np.ndarray) -> np.ndarray:
    return world_from_cam.apply(points_cam.astype(np.float64))


def num_seen_twice(frame: StereoFrame, shown: list[tuple[Rigid3, np.ndarray]]) -> int:
    """Most points of one side node that lie in one of the frame's side views."""
    assert frame.camera is not None
    assert frame.world_from_cam is not None
    return max(
        (num_in_view(frame.camera, frame.world_from_cam, *node) for node in shown), default=0
    )


def num_in_view(
    camera: Camera, world_from_cam: Rigid3, world_from_node: Rigid3, points: np.ndarray
) -> int:
    best = 0
    for view in make_virtual_views(camera):
        world_from_side = world_from_cam @ view.cam_from_virtual
        is_near = (
            np.linalg.norm(world_from_node.translation - world_from_side.translation) < MAX_METRES
        )
        if is_near and world_from_node.rotation[:, 2] @ world_from_side.rotation[:, 2] > 0.8:
            pixels = np.rint(
                np.nan_to_num(
                    view.camera.img_from_cam(world_from_side.inverse().apply(points)), nan=-1.0
                )
            ).astype(int)
            inside = (
                (pixels >= 0).all(axis=1)
                & (pixels[:, 0] < view.camera.width)
                & (pixels[:, 1] < view.camera.height)
            )
            best = max(best, int(view.inside[pixels[inside, 1], pixels[inside, 0]].sum()))
    return best


def asked(localizer: Localizer, frames: list[StereoFrame]) -> dict:
    """Right, far off, and how sure."""
    errors, squares, milliseconds, reasons = [], [], [], Counter()
    localizer.localize(frames[0].image, frames[0].camera)  # compiled, and what is measured once
    for frame in frames:
        assert frame.world_from_cam is not None
        started = time.perf_counter()
        result = localizer.localize(frame.image, frame.camera)
        milliseconds.append(1e3 * (time.perf_counter() - started))
        if not isinstance(result, Localization):
            reasons[result.reason] += 1
            continue
        error = result.world_from_cam.inverse() @ frame.world_from_cam
        errors.append((float(np.linalg.norm(error.translation)), float(np.rad2deg(error.angle()))))
        xi = (frame.world_from_cam @ result.world_from_cam.inverse()).log()
        squares.append(float(xi @ np.linalg.solve(result.covariance, xi)))
    right = [metres for metres, degrees in errors if metres < 0.5 and degrees < 5.0]
    return {
        "answered": len(errors),
        "right": len(right),
        "far_off": sum(metres > 0.5 or degrees > 10.0 for metres, degrees in errors),
        "median_m": float(np.median(right)) if right else float("nan"),
        "inside": (
            float(np.mean(np.array(squares) < CHI_SQUARE_6_AT_95)) if squares else float("nan")
        ),
        "ms": float(np.median(milliseconds)),
        "reasons": dict(reasons),
    }


if __name__ == "__main__":
    main()
