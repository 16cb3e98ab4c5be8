"""The spine's figures on real recordings: accuracy, darkened queries, images from elsewhere,
milliseconds, bytes.

    python benchmarks/real_recordings.py [--shared ../shared] [--json FILE]

Each map is built with the default settings but for D_thresh = 0.5 m indoors. `d` in the table is
the share localized of the same queries darkened to a third, with a gradient across the picture,
gamma 0.6 and sensor noise of 4 grey levels (`d2`: gamma 1 / 0.6, far darker). Images from
elsewhere: the queries of the other places, and noise, lettering, shapes, repeated patterns.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame
from topoloc.recordings.open import open_sequence
from topoloc_paper.fit.corpus import read_rigid
from topoloc_paper.fit.pictures import darkened, drawn_pictures


@dataclass(frozen=True)
class Place:
    """A map, and queries to it."""

    name: str
    mapping: str
    queries: str
    d_thresh: float | None = None
    map_from_truth: str | None = None


PLACES = (
    Place(
        "kitchen, 60 of 100 frames map",
        "seven_scenes/kitchen@0-59/100",
        "seven_scenes/kitchen@60-99/100",
        0.5,
    ),
    Place(
        "kitchen, 30 of 50 frames map",
        "seven_scenes/kitchen@0-29/50",
        "seven_scenes/kitchen@30-49/50",
        0.5,
    ),
    Place(
        "ZED lab, session 1 / 2",
        "zed_lab/session1",
        "zed_lab/session2@0:99",
        0.5,
        "zed_lab/session1_from_session2.json",
    ),
    Place(
        "KITTI street 1, even / odd", "kitti/sequences/street1@0::2", "kitti/sequences/street1@1::2"
    ),
    Place(
        "KITTI street 2, even / odd", "kitti/sequences/street2@0::2", "kitti/sequences/street2@1::2"
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    )
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    data = arguments.shared / "data"
    queries = {place.name: list(open_sequence(data / place.queries)) for place in PLACES}
    drawn = drawn_pictures(100)
    rows = []
    for place in PLACES:
        row = measure(place, data, queries, drawn)
        rows.append(row)
        print(json.dumps(row), flush=True)
    print("\n" + table(rows))
    print(
        "peak memory of this process:"
        f" {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB (it holds all"
        " queries)"
    )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def measure(
    place: Place, data: Path, queries: dict[str, list[StereoFrame]], drawn: list[np.ndarray]
) -> dict[str, Any]:
    topomap = build_map(
        open_sequence(data / place.mapping), BuildConfig(nodes=NodeConfig(d_thresh=place.d_thresh))
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "place.topo"
        topomap.save(path)
        num_bytes = path.stat().st_size
        localizer = Localizer(TopoMetricMap.load(path))
        world_from_truth = (
            read_rigid(data / place.map_from_truth) if place.map_from_truth else Rigid3.identity()
        )
        frames = queries[place.name]
        for frame in frames[:5]:  # warm-up
            ask(localizer, frame)
        results = [ask(localizer, frame) for frame in frames]
        errors = [
            (result.world_from_cam.inverse() @ world_from_truth @ frame.world_from_cam)
            for result, frame in zip(results, frames, strict=True)
            if result.localized and frame.world_from_cam is not None
        ]
        dark = {
            gamma: np.mean(
                [
                    ask(localizer, frame, darkened(frame.image, gamma, i)).localized
                    for i, frame in enumerate(frames)
                ]
            )
            for gamma in (0.6, 1 / 0.6)
        }
        others = [
            frame
            for name, other in queries.items()
            if name[:5] != place.name[:5]
            for frame in other
        ]
        camera = Camera.pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
        elsewhere = [ask(localizer, frame).localized for frame in others] + [
            localizer.localize(image, camera).localized for image in drawn
        ]
    stages = results[0].times_ms if results else {}
    return {
        "place": place.name,
        "nodes": len(topomap.summaries),
        "kB_per_node": round(num_bytes / len(topomap.summaries) / 1e3, 1),
        "queries": len(frames),
        "localized_percent": round(100 * float(np.mean([r.localized for r in results])), 1),
        "median_cm": round(
            100 * float(np.median([np.linalg.norm(e.translation) for e in errors])), 2
        ),
        "median_deg": round(float(np.rad2deg(np.median([e.angle() for e in errors]))), 3),
        "dark_percent": round(100 * float(dark[0.6]), 1),
        "darker_percent": round(100 * float(dark[1 / 0.6]), 1),
        "elsewhere": len(elsewhere),
        "accepted": int(np.sum(elsewhere)),
        "median_ms": {
            stage: round(float(np.median([r.times_ms.get(stage, 0.0) for r in results])), 2)
            for stage in stages
        },
    }


def ask(localizer: Localizer, frame: StereoFrame, image: np.ndarray | None = None) -> Any:
    assert frame.camera is not None
    return localizer.localize(frame.image if image is None else image, frame.camera)


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        (
            "| recording | nodes | kB a node | localized | median error | darkened: localized |"
            " from elsewhere: accepted | ms a query |"
        ),
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lines.append(
            f"| {r['place']} | {r['nodes']} | {r['kB_per_node']:.0f} | {r['localized_percent']:g} %"
            f" of {r['queries']} | {r['median_cm']:.2f} cm, {r['median_deg']:.3f} deg |"
            f" {r['dark_percent']:g} % ({r['darker_percent']:g} %) | {r['accepted']} of"
            f" {r['elsewhere']} | {r['median_ms']['total']:.0f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
