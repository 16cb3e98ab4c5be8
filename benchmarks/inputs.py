"""Measure answers for images as users have them: cropped, zoomed, with wrong EXIF data, with a
distortion missing in the calibration, panoramas.

    python benchmarks/inputs.py [--shared ../shared] [--places lab,zed] [--situations NAMES]
        [--num 30] [--json FILE]

Each situation is made from images with a known pose. An answer is right within 0.25 m and 2
degrees. The row of a cropped image counts the right answers among those images whose whole image is
answered right without a calibration. Rows "together" localize all images of one camera, as `topoloc
localize MAP photos/` does. `lab`, `kitchen` and `street1` served to choose the thresholds.
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.recordings.open import open_sequence
from topoloc.tracking.shared_cameras import SharedCameras
from topoloc_paper.fit.corpus import read_rigid

MAX_METRES, MAX_DEGREES = 0.25, 2.0
WHOLE = "whole, focal length unknown"

Given = tuple[np.ndarray, Camera | UncalibratedCamera]
"""An image, and the camera that the caller states."""


@dataclass(frozen=True)
class Place:
    """A map and its queries, as addresses of recordings below the data or the demo."""

    mapping: str
    queries: str
    d_thresh: float | None = None
    map_from_truth: str | None = None


PLACES = {
    "lab": Place("demo:map_lap1", "demo:day"),
    "kitchen": Place("seven_scenes/kitchen@0::2", "seven_scenes/kitchen@1::2"),
    "zed": Place(
        "zed_lab/session1",
        "zed_lab/session2@0:99",
        0.5,
        "zed_lab/session1_from_session2.json",
    ),
    "kitchen60": Place("seven_scenes/kitchen@0-59/100", "seven_scenes/kitchen@60-99/100", 0.5),
    "street1": Place("kitti/sequences/street1@0::2", "kitti/sequences/street1@1::2"),
    "street2": Place("kitti/sequences/street2@0::2", "kitti/sequences/street2@1::2"),
}


def unknown(image: np.ndarray) -> UncalibratedCamera:
    """Return the camera of an image without calibration and EXIF data."""
    return UncalibratedCamera.unknown(image.shape[1], image.shape[0])


def by_exif(image: np.ndarray, whole: Camera, error: float = 1.0) -> UncalibratedCamera:
    """Return the camera by the 35-mm focal length that the whole image had: it is converted by the
    diagonal of this one."""
    height, width = image.shape[:2]
    diagonals = math.hypot(width, height) / math.hypot(whole.width, whole.height)
    return UncalibratedCamera.from_focal_guess(width, height, error * whole.fx * diagonals)


def cropped(image: np.ndarray, left: float, top: float, right: float, bottom: float) -> np.ndarray:
    """Return the image without shares of its width and height at the four sides."""
    height, width = image.shape[:2]
    x, y = round(left * width), round(top * height)
    return np.ascontiguousarray(
        image[y : height - round(bottom * height), x : width - round(right * width)]
    )


def warped(
    image: np.ndarray,
    camera: Camera,
    size: tuple[float, float],
    undistort: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, Camera]:
    """Return the image through another lens, cut to half of `size` around the principal point, in
    focal lengths; and the pinhole camera that leaves the lens out.

    `undistort` returns the coordinates on the plane z = 1 of those on the new image plane.
    """
    f = camera.fx
    half_x, half_y = int(size[0] * f), int(size[1] * f)
    x, y = np.meshgrid(np.arange(-half_x, half_x + 1) / f, np.arange(-half_y, half_y + 1) / f)
    u, v = undistort(x, y)
    map_x = (u * camera.fx + camera.cx).astype(np.float32)
    map_y = (v * camera.fy + camera.cy).astype(np.float32)
    made = cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)
    height, width = made.shape[:2]
    return made, Camera.pinhole(width, height, f, f, float(half_x), float(half_y))


def reach(camera: Camera) -> tuple[float, float]:
    """Return the distances from the principal point to the nearer sides, in focal lengths."""
    x = min(camera.cx, camera.width - 1 - camera.cx) / camera.fx
    return x, min(camera.cy, camera.height - 1 - camera.cy) / camera.fy


def through_radial(
    image: np.ndarray, camera: Camera, distorted: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, Camera]:
    """Return the image through a lens that moves radii r on the plane z = 1 to `distorted`(r)."""
    x, y = reach(camera)
    corner = math.hypot(x, y)
    radii = np.linspace(0.0, corner, 2000)
    table = distorted(radii)

    def undistort(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.hypot(u, v)
        scale = np.interp(r, table, radii) / np.maximum(r, 1e-9)
        return u * scale, v * scale

    size = table[-1] / corner
    return warped(image, camera, (x * size, y * size), undistort)


def through_fisheye(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return the image of an equidistant fisheye lens."""
    return through_radial(image, camera, np.arctan)


def through_barrel(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return the image of a lens that moves the corners by 5 % inwards."""
    corner = math.hypot(*reach(camera))
    return through_radial(image, camera, lambda r: r * (1.0 - 0.05 * (r / corner) ** 2))


def panorama(image: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the image on a cylinder."""
    x, y = reach(camera)

    def undistort(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.tan(u), v / np.cos(u)

    return warped(image, camera, (math.atan(x), y / math.hypot(1.0, x)), undistort)[0]


def rolled(image: np.ndarray, camera: Camera, degrees: float) -> np.ndarray:
    """Return the image of a rolling shutter, during which the camera turns by an angle: to the
    right and down alike. The pose is that of the middle row."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = camera.normalized_from_img(np.column_stack([x.ravel(), y.ravel()]).astype(np.float64))
    angle = math.radians(degrees) * (y.ravel() / camera.height - 0.5) / math.sqrt(2.0)
    u, v = np.tan(np.arctan(rays[:, 0]) + angle), np.tan(np.arctan(rays[:, 1]) + angle)
    map_x = (u * camera.fx + camera.cx).astype(np.float32).reshape(x.shape)
    map_y = (v * camera.fy + camera.cy).astype(np.float32).reshape(x.shape)
    return cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR)


def zoomed(image: np.ndarray, factor: float) -> np.ndarray:
    """Return the middle of the image, enlarged to the size of the whole."""
    side = (1.0 - 1.0 / factor) / 2.0
    size = image.shape[1], image.shape[0]
    return cv2.resize(cropped(image, side, side, side, side), size, interpolation=cv2.INTER_CUBIC)


def scaled_apart(image: np.ndarray, camera: Camera, factor: float) -> Given:
    """Return the image with its rows scaled, and the calibration as the whole image's width gives
    it: only the principal point follows."""
    height = round(factor * camera.height)
    resized = cv2.resize(image, (camera.width, height), interpolation=cv2.INTER_AREA)
    cy = (camera.cy + 0.5) * height / camera.height - 0.5
    return resized, Camera.from_json(camera.to_json() | {"height": height, "cy": cy})


def made_of(image: np.ndarray, camera: Camera) -> Iterator[tuple[str, Given]]:
    """Return each situation with the image and the camera that the caller states."""

    def of(made: np.ndarray) -> Given:
        return made, unknown(made)

    yield WHOLE, of(image)
    yield "whole, EXIF 5 % off", (image, by_exif(image, camera, 1.05))
    yield "left 10 % cut off", of(cropped(image, 0.1, 0.0, 0.0, 0.0))
    yield "right 10 % cut off", of(cropped(image, 0.0, 0.0, 0.1, 0.0))
    yield "left 25 % cut off", of(cropped(image, 0.25, 0.0, 0.0, 0.0))
    yield "top 25 % cut off", of(cropped(image, 0.0, 0.25, 0.0, 0.0))
    cut = cropped(image, 0.25, 0.0, 0.0, 0.0)
    yield "left 25 % cut off, EXIF kept", (cut, by_exif(cut, camera))
    half = cropped(image, 0.25, 0.25, 0.25, 0.25)
    yield "middle half, EXIF kept", (half, by_exif(half, camera))
    near = zoomed(image, 1.5)
    yield "zoomed x 1.5, EXIF kept", (near, by_exif(near, camera))
    yield "fisheye, lens left out", through_fisheye(image, camera)
    yield "barrel, lens left out", through_barrel(image, camera)
    yield "fisheye, no calibration", of(through_fisheye(image, camera)[0])
    yield "panorama, no calibration", of(panorama(image, camera))
    yield "calibrated", (image, camera)
    yield "rows x 0.8, calibrated by the width", scaled_apart(image, camera, 0.8)
    yield "rows x 0.9, calibrated by the width", scaled_apart(image, camera, 0.9)
    yield "rows x 1.25, calibrated by the width", scaled_apart(image, camera, 1.25)
    yield "calibrated, rolling shutter, 1 degree", (rolled(image, camera, 1.0), camera)
    yield "calibrated, rolling shutter, 2 degrees", (rolled(image, camera, 2.0), camera)


def compare(result: Localization | NotLocalized, truth: Rigid3) -> dict[str, Any]:
    """Return the answer for one image, compared with the truth."""
    if not isinstance(result, Localization):
        return {"p": 0.0, "reason": result.reason, "detail": result.detail}
    error = truth.inverse() @ result.world_from_cam
    xi = (truth @ result.world_from_cam.inverse()).log()
    return {
        "p": result.probability,
        "metres": float(np.linalg.norm(error.translation)),
        "degrees": math.degrees(error.angle()),
        "sigma_m": result.position_sigma_m,
        "sigma_deg": result.rotation_sigma_deg,
        "square": float(xi @ np.linalg.solve(result.covariance, xi)),
    }


def is_right(answer: dict[str, Any]) -> bool:
    """Return whether the image is localized within the tolerance."""
    return answer["p"] > 0.0 and answer["metres"] <= MAX_METRES and answer["degrees"] <= MAX_DEGREES


def row_of(answers: dict[int, dict[str, Any]], whole: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of one situation. Both arguments are by image."""
    given = [answer for answer in answers.values() if answer["p"] > 0.0]
    wrong = [answer for answer in given if not is_right(answer)]
    usual = [k for k, answer in whole.items() if is_right(answer)]
    return {
        "images": len(answers),
        "right": len(given) - len(wrong),
        "right of usual": f"{sum(is_right(answers[k]) for k in usual)} of {len(usual)}",
        "refused": len(answers) - len(given),
        "wrong, p > .5": sum(answer["p"] > 0.5 for answer in wrong),
        "wrong, p > .9": sum(answer["p"] > 0.9 for answer in wrong),
        "p > .9": sum(answer["p"] > 0.9 for answer in given),
        "p > .95 against sigma": sum(
            answer["p"] > 0.95
            and (answer["sigma_m"] > MAX_METRES or answer["sigma_deg"] > MAX_DEGREES)
            for answer in given
        ),
        "cm": 100.0 * float(np.median([answer["metres"] for answer in given] or [math.nan])),
        "deg": float(np.median([answer["degrees"] for answer in given] or [math.nan])),
        "sigma_deg": max([answer["sigma_deg"] for answer in given], default=math.nan),
        "inside 95 %": sum(answer["square"] < 12.592 for answer in given),
    }


def measure(
    place: Place, data: Path, chosen: set[str], num: int
) -> Iterator[tuple[str, dict[int, dict[str, Any]]]]:
    """Yield the answers of each situation, by image."""

    def address(name: str) -> str:
        is_demo = name.startswith("demo:")
        return str(SHIPPED / name.removeprefix("demo:")) if is_demo else str(data / name)

    nodes = NodeConfig(d_thresh=place.d_thresh)
    topomap = build_map(open_sequence(address(place.mapping)), BuildConfig(nodes=nodes))
    localizer, sequence = Localizer(topomap), open_sequence(address(place.queries))
    world_from_truth = Rigid3.identity()
    if place.map_from_truth:
        world_from_truth = read_rigid(data / place.map_from_truth)
    asked: dict[str, dict[int, tuple[Given, Rigid3]]] = {}
    for k in np.unique(np.linspace(0, len(sequence) - 1, num).astype(int)):
        frame = sequence[int(k)]
        assert frame.world_from_cam is not None
        assert frame.camera is not None
        truth = world_from_truth @ frame.world_from_cam
        for name, given in made_of(frame.image, frame.camera):
            if not chosen or name in chosen or name == WHOLE:
                asked.setdefault(name, {})[int(k)] = given, truth
    for name, images in asked.items():
        alone = {k: localizer.localize(*given) for k, (given, _) in images.items()}
        yield name, {k: compare(result, images[k][1]) for k, result in alone.items()}
        cameras, given = SharedCameras(localizer), images[min(images)][0]
        if isinstance(given[1], UncalibratedCamera):
            found: dict[int, dict[str, Any]] = {}
            for k, ((image, camera), truth) in [*images.items(), *images.items()]:
                assert isinstance(camera, UncalibratedCamera)
                found[k] = compare(cameras.localize(image, camera), truth)  # the second time counts
            yield f"{name}, together", found


def lines(rows: Iterable[tuple[str, dict[str, Any]]]) -> Iterator[str]:
    """Return the table as Markdown."""
    for number, (name, row) in enumerate(rows):
        if number == 0:
            yield "| situation | " + " | ".join(row) + " |"
            yield "|---|" + "---|" * len(row)
        values = (f"{v:.2f}" if isinstance(v, float) else str(v) for v in row.values())
        yield f"| {name} | " + " | ".join(values) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shared = Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    parser.add_argument("--shared", type=Path, default=shared)
    parser.add_argument("--places", default=",".join(PLACES), help="of these, split by commas")
    parser.add_argument("--situations", default="", help="split by semicolons; all by default")
    parser.add_argument("--num", type=int, default=30, help="images of each place")
    parser.add_argument("--json", type=Path, help="write all answers to this file")
    arguments = parser.parse_args()
    chosen = {name for name in arguments.situations.split(";") if name}
    known: dict[str, dict[str, dict[int, dict[str, Any]]]] = {}
    for name in (part.strip() for part in arguments.places.split(",")):
        data = arguments.shared.resolve() / "data"
        known[name] = dict(measure(PLACES[name], data, chosen, arguments.num))
        whole = known[name][WHOLE]
        rows = ((f"{name}: {one}", row_of(each, whole)) for one, each in known[name].items())
        print("\n".join(lines(rows)), flush=True)
    shares = [
        sum(one["p"] > 0.5 and not is_right(one) for one in each.values()) / len(each)
        for answers in known.values()
        for each in answers.values()
    ]
    print(f"wrong at p > .5: {100 * np.mean(shares):.2f} % in the mean, {100 * max(shares):.1f} %")
    if arguments.json:
        arguments.json.write_text(json.dumps(known))


if __name__ == "__main__":
    main()
