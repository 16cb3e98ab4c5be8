"""Render pictures of one place ahead and to the sides, by several lights, for
`topoloc_training.net.train_wide`:
`python -m topoloc_worlds.wide_views OUT --places corridor:1:0.1 --conditions day night
--photos FOLDER...`.

OUT gets grey WebP pictures of 640x400, depth of every fourth pixel as 16-bit PNG, and `views.json`.
The light is traced for each picture. Mitsuba's variant `cuda_ad_rgb` takes 3 s a picture in each of
ten processes beside one GPU (TOPOLOC_MITSUBA_VARIANT), LLVM much longer.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc_worlds.conditions import find_condition
from topoloc_worlds.noise import rng_of
from topoloc_worlds.rendering import first_hits
from topoloc_worlds.rendering.renderer import RenderConfig, Renderer
from topoloc_worlds.rendering.variant import LLVM, use_best_variant
from topoloc_worlds.routes import Route, plan_route, velocity_at, world_from_cam_at
from topoloc_worlds.sensor import SensorConfig, choose_exposure, take_picture, white_balance_of
from topoloc_worlds.weather import draw_rain, falling_drops
from topoloc_worlds.worlds import World, find_world

CAMERA = Camera.pinhole(640, 400, 380.0, 380.0, 319.5, 199.5)
LIGHTS = ("day", "cloudy", "evening", "rain", "night")
"""The day comes first: its descriptors are those that other pictures of the place learn."""
_STRETCH = {"corridor": 10.0, "street": 45.0, "lab": 9.0, "hospital": 9.0}
_LATERAL = {"corridor": 0.5, "street": 3.5, "lab": 0.2, "hospital": 0.4}
_STEP, _FIRST = 4, 1  # depth is stored of columns and rows 1, 5, 9 ...
_UNIT, _NEAREST, _LAST = math.log(4000) / 65000, 0.1, 65000
_PHOTO_WIDTH, _QUALITY = 640, 82
_RENDERED_SHARE = 0.6  # of the samples that are copies of one picture, beside one photo each


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--places", nargs="+", default=[], help="world:seed:share of the lap at which it begins"
    )
    parser.add_argument("--conditions", nargs="+", default=["day", "night"])
    parser.add_argument("--positions", type=int, default=8, help="each is seen in 3 directions")
    parser.add_argument("--photos", nargs="+", type=Path, default=[])
    parser.add_argument("--num-photos", type=int, default=200)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    records = list(add_photos(args.out, args.photos, args.num_photos))
    share = _RENDERED_SHARE * max(1, len(records))
    views = [
        record
        for place in args.places
        for condition in args.conditions
        for record in render_place(args.out, place, condition, args.positions)
    ]
    records += [record | {"share": share / len(views)} for record in views]
    (args.out / "views.json").write_text(json.dumps(records), encoding="utf-8")


def add_photos(out: Path, folders: list[Path], count: int) -> Iterator[dict[str, Any]]:
    """Store photos evenly spread over the folders, 640 pixels wide, and yield their records."""
    paths = [path for folder in folders for path in sorted(folder.iterdir())]
    for i in np.unique(np.linspace(0, len(paths) - 1, count).astype(int)) if paths else ():
        grey = cv2.imread(str(paths[i]), cv2.IMREAD_GRAYSCALE)
        if grey is None:
            continue
        height = round(grey.shape[0] * _PHOTO_WIDTH / grey.shape[1])
        grey = cv2.resize(grey, (_PHOTO_WIDTH, height), interpolation=cv2.INTER_AREA)
        name = f"photo-{i:04}.webp"
        cv2.imwrite(str(out / name), grey, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
        yield {"file": name, "depth": "", "world_from_cam": None, "place": "", "light": 0} | {
            "share": 1.0
        }


def render_place(
    out: Path, place: str, condition_name: str, positions: int
) -> Iterator[dict[str, Any]]:
    """Render the views of a place under one condition, and yield their records."""
    name, seed, lap_share = place.split(":")
    world, condition = find_world(name), find_condition(condition_name)
    light = LIGHTS.index(condition.name)
    rng = np.random.default_rng([int(seed), int(100 * float(lap_share)), light])
    if use_best_variant() != LLVM:  # recorded kernels miss the weights of lamps that change
        first_hits._recorded_in = lambda _, function: function
    scene = world.build(int(seed), condition, 0)
    renderer = Renderer(scene, RenderConfig(albedo_samples=2, samples=24, bounces=3))
    for k, (route, pose) in enumerate(
        draw_poses(world, int(seed), float(lap_share), positions, rng)
    ):
        rendering = renderer.render(CAMERA, pose, int(rng.integers(2**31)))
        sensor, seen = SensorConfig(), rendering.radiance
        exposure = choose_exposure(seen, sensor)
        if world.outdoor and condition.rain:
            drops = falling_drops(
                condition.rain, CAMERA, pose, velocity_at(route, 0.0), rng_of(k, "rain")
            )
            still = Rigid3(np.eye(3), np.zeros(3))
            seen = draw_rain(seen, rendering.depth, CAMERA, still, drops, exposure.time)
        noise = rng_of(1000 * int(seed) + k, f"sensor/{condition.name}")
        balance = white_balance_of(condition, int(seed), sensor)
        picture = take_picture(seen, exposure, sensor, noise, balance)
        file = f"{place.replace(':', '-')}-{condition.name}-{k:03}"
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        cv2.imwrite(str(out / f"{file}.webp"), grey, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
        store_depth(out / f"{file}.png", rendering.depth)
        yield {
            "file": f"{file}.webp",
            "depth": f"{file}.png",
            "world_from_cam": pose.matrix().tolist(),
            "place": place,
            "light": light,
        }


def draw_poses(
    world: World, seed: int, lap_share: float, positions: int, rng: Generator
) -> Iterator[tuple[Route, Rigid3]]:
    """Yield routes and poses along a stretch: about ahead, and 20, 40 or 60 degrees to both
    sides."""
    base, lateral = world.route(), _LATERAL[world.name]
    start = lap_share * plan_route(world.loop, world.camera_height, base).travelled[-1]
    for i in range(positions):
        at = start + _STRETCH[world.name] * (i + rng.uniform(0, 0.8)) / positions
        side = rng.uniform(-lateral, lateral)
        if world.outdoor:  # one of the two lanes
            side = rng.choice([0.0, lateral]) + rng.uniform(-0.3, 0.3)
        asides = [sign * (20 * rng.choice([1, 2, 3]) + rng.normal(0, 5)) for sign in (1, -1)]
        for k, look in enumerate((rng.normal(0, 3), *asides)):
            moved = replace(
                base,
                start=float(at + rng.uniform(-0.4, 0.4)),
                lateral=float(side + rng.uniform(-0.15, 0.15)),
                look=float(np.radians(look)),
                num_frames=2,
                seed=1000 * seed + 3 * i + k,
            )
            route = plan_route(world.loop, world.camera_height, moved)
            yield route, world_from_cam_at(route, 0.0)


def store_depth(path: Path, depth: Float[np.ndarray, "h w"]) -> None:
    """Store depth as PNG: metres from 0.1 to 400, anything else (NaN in the sky) is none."""
    known = np.nan_to_num(depth[_FIRST::_STEP, _FIRST::_STEP])
    coded = np.rint(np.log(np.maximum(known, _NEAREST) / _NEAREST) / _UNIT).astype(np.int64)
    is_known = (known > _NEAREST) & (coded < _LAST)
    coded = np.where(is_known, coded // 4 * 4 + 2, 0).astype(np.uint16)
    coded[:, 1:] -= coded[:, :-1].copy()
    cv2.imwrite(str(path), coded, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
