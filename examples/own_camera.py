"""A camera of one's own, with a distorted lens: how it is described, and what happens if its
distortion is left out.

    python examples/own_camera.py [--out DIR]

The pictures are those of the built-in demo, bent as a wide lens bends them. They are written to a
folder with a `camera.json`, under COLMAP's model names, as `topoloc localize MAP DIR` reads it, and
localized twice: with that calibration, and as if by a pinhole.
"""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

import topoloc
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.alignment import translation_error

# A lens with barrel distortion: f, c in pixels, (k1, k2, p1, p2) as OpenCV's calibration gives
# them.
LENS = topoloc.Camera("OPENCV", 640, 400, (380.0, 380.0, 319.5, 199.5, -0.28, 0.07, 0.001, -0.0005))


def bend(picture: np.ndarray, taken_with: topoloc.Camera, lens: topoloc.Camera) -> np.ndarray:
    """The picture as `lens` would have taken it from the same place."""
    columns, rows = np.meshgrid(
        np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float)
    )
    rays = lens.rays_from_img(np.stack([columns.ravel(), rows.ravel()], axis=1))
    where = taken_with.img_from_cam(rays).astype(np.float32).reshape(lens.height, lens.width, 2)
    return cv2.remap(picture, where[..., 0], where[..., 1], cv2.INTER_LINEAR)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "camera.json").write_text(json.dumps(LENS.to_json(), indent=2) + "\n", encoding="utf-8")
    straight = topoloc.open_sequence(SHIPPED / "day@0::4")
    truth = []
    for i in range(len(straight)):
        frame = straight[i]
        cv2.imwrite(
            str(out / f"{i:03d}.png"),
            cv2.cvtColor(bend(frame.image, frame.camera, LENS), cv2.COLOR_RGB2BGR),
        )
        truth.append(frame.world_from_cam)

    localizer = topoloc.Localizer(topoloc.build_map(topoloc.open_sequence(SHIPPED / "map_lap1")))
    photos = topoloc.open_sequence(out)
    for what, camera in (("its own calibration", LENS), ("a pinhole's", LENS.undistorted())):
        results = [localizer.localize(photos[i].image, camera) for i in range(len(photos))]
        pairs = [
            (true, found.world_from_cam)
            for true, found in zip(truth, results, strict=True)
            if found.localized
        ]
        errors = [translation_error(*pair) for pair in pairs]
        says = f"median error {100.0 * np.median(errors):.2f} cm" if pairs else results[0].detail
        doubts = [found.calibration_doubt for found in results if found.localized]
        says += next((f"; {doubt}" for doubt in doubts if doubt), "")
        print(f"with {what}: {len(pairs)} of {len(results)} localized, {says}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("wide_lens"),
        help="the folder for the pictures; must hold no others",
    )
    main(parser.parse_args().out)
