"""A folder of photos gets a file of poses: JSON lines for programs, a TUM trajectory for `evo`.

    python examples/localize_folder.py [MAP FOLDER] [--out DIR]

FOLDER holds pictures and a camera.json. A picture that cannot be read is an answer like the others,
and the run goes on. Without arguments a map of the built-in demo is made, and asked by night.
`topoloc localize MAP FOLDER --json FILE` does the same.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.errors import UnreadableImageError
from topoloc.recordings.trajectory import Trajectory


def main(map_file: Path | None, folder: str, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    if map_file is None:
        map_file = out / "lab.topo"
        topoloc.build_map(
            [topoloc.open_sequence(SHIPPED / name) for name in ("map_lap1", "map_lap2")]
        ).save(map_file)
    localizer = topoloc.Localizer(topoloc.TopoMetricMap.load(map_file))
    photos = topoloc.open_sequence(folder)

    lines, poses, times = [], [], []
    reasons: Counter[str] = Counter()
    for i, name in enumerate(photos.names):
        try:
            frame = photos[i]
            result = localizer.localize(frame.image, frame.camera)
        except UnreadableImageError as error:
            result = topoloc.NotLocalized("unreadable", detail=str(error))
        lines.append(json.dumps(result.to_json(name)))
        if isinstance(result, topoloc.Localization):
            poses.append(result.world_from_cam)
            times.append(photos.t_ns[i])
        else:
            reasons[result.reason] += 1

    (out / "poses.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    Trajectory(poses, times).write_tum(out / "poses.tum")
    refused = ", ".join(f"{count} {reason}" for reason, count in reasons.items()) or "none"
    print(
        f"{len(poses)} of {len(lines)} photos localized, not localized: {refused}; written to {out}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", nargs="?", type=Path, help="a map file")
    parser.add_argument(
        "folder", nargs="?", default=str(SHIPPED / "night"), help="photos with a camera.json"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("localized"), help="the folder to write to"
    )
    args = parser.parse_args()
    main(args.map, args.folder, args.out)
