"""Define a world small enough for tests: one room with pictures on its walls, a lamp, and a pillar
in the middle."""

from __future__ import annotations

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.noise import fractal_noise, rng_of
from topoloc_worlds.scene import Material, Scene, Surface
from topoloc_worlds.shapes import box, panel
from topoloc_worlds.worlds import World

LOOP = ((1.2, 1.2), (4.8, 1.2), (4.8, 3.8), (1.2, 3.8))
CAMERA_HEIGHT = 1.2
BOX_WORLD = World("box", "a room for tests", __name__, spacing=0.2)
RAINY_WORLD = World(
    "box", "a room for tests, its roof leaking", __name__, outdoor=True, spacing=0.2
)


def build(seed: int, condition: Condition, arrangement: int = 0) -> Scene:
    noise = fractal_noise(rng_of(seed, "walls"), (256, 256), coarsest_px=10.0)
    picture = np.clip(128 + 70 * np.sign(noise) * np.abs(noise) ** 0.5, 0, 255).astype(np.uint8)
    paper = Material(
        "matt", np.ascontiguousarray(np.stack([picture, picture[::-1], picture.T], axis=-1))
    )
    lamp = Material("light", (1.0, 0.95, 0.9), radiance=0.02 + condition.daylight)
    return Scene(
        (
            Surface("room", box((0, 0, 0), (6, 5, 2.6), texels=0.4), paper),
            Surface(
                "pillar",
                box((2.4, 2.2, 0), (3.0 + 0.2 * arrangement, 2.8, 2.6), texels=0.6, faces="nsew"),
                paper,
            ),
            Surface("lamp", panel((1.5, 1.5, 2.55), (3, 0, 0), (0, 2, 0)), lamp),
        )
    )
