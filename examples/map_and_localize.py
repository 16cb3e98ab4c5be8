"""Map a place from one recording, then localize images of another one.

    python examples/map_and_localize.py [--map-from SEQ] [--ask SEQ] [--out FILE]

Without arguments it maps the demo's rendered lab from one stereo lap and localizes single images of
another. Any recording of docs/recordings.md works. The mapped one needs depth and poses.
"""

import argparse
from pathlib import Path

import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.alignment import rotation_error, translation_error


def main(map_from: str, ask: str, out: Path) -> None:
    topomap = topoloc.build_map(topoloc.open_sequence(map_from))
    topomap.save(out)
    print(
        f"{out}: {len(topomap.nodes)} nodes, {out.stat().st_size / 1e6:.1f} MB,"
        f" {topomap.length_m:.1f} m mapped"
    )

    localizer = topoloc.Localizer(topoloc.TopoMetricMap.load(out))
    queries = topoloc.open_sequence(ask)
    for i in range(len(queries)):
        frame = queries[i]
        result = localizer.localize(frame.image, frame.camera)
        if isinstance(result, topoloc.NotLocalized):
            print(f"{frame.name}: not localized ({result.reason})")
            continue
        x, y, z = result.world_from_cam.translation
        sigma_cm = 100.0 * np.sqrt(np.trace(result.position_covariance))
        line = f"{frame.name}: ({x:.3f}, {y:.3f}, {z:.3f}) m, give or take {sigma_cm:.2f} cm"
        if frame.world_from_cam is not None:
            metres, radians = (
                error(frame.world_from_cam, result.world_from_cam)
                for error in (translation_error, rotation_error)
            )
            line += f"; off by {100.0 * metres:.2f} cm and {np.rad2deg(radians):.2f} deg"
        print(line)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--map-from",
        default=str(SHIPPED / "map_lap1"),
        help="a stereo or RGB-D recording with poses",
    )
    parser.add_argument(
        "--ask", default=str(SHIPPED / "day@0::4"), help="pictures of the same place"
    )
    parser.add_argument("--out", type=Path, default=Path("lab.topo"), help="the map file")
    args = parser.parse_args()
    main(args.map_from, args.ask, args.out)
