"""Build the fixed parts of the corridor in the wall's frame of corridor_plan: doors, windows, a
lift, handrails, radiators, lamps, signs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from topoloc_worlds.corridor.plan import (
    DOOR_HEIGHT,
    DOOR_WIDTH,
    HEIGHT,
    WALL_THICKNESS,
    Opening,
    shifted,
    solid,
)
from topoloc_worlds.furnishing import interiors, printed_things
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Color, Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import box, cylinder, join, panel, placed, tube

_JAMB = 0.07
_VENEERS: tuple[Color, ...] = (interiors.BEECH, interiors.OAK, (0.62, 0.66, 0.7), (0.5, 0.3, 0.2))


@dataclass(frozen=True, eq=False)
class Fittings:
    """The materials that every door and window of one corridor shares."""

    frame: Material
    leaf: Material
    metal: Material
    chrome: Material
    aluminium: Material
    white: Material
    black: Material
    red: Material
    wood: Material
    rail: Material
    plaster: Material
    carpet: Material
    linoleum: Material
    tiles: Material

    @staticmethod
    def of(seed: int) -> Fittings:
        rng = rng_of(seed, "corridor/fittings")
        veneer = _VENEERS[int(rng.integers(len(_VENEERS)))]
        return Fittings(
            frame=interiors.painted_metal(rng, (0.55, 0.57, 0.6)),
            leaf=interiors.wood(rng, veneer, size=(768, 384)),
            metal=interiors.brushed_metal(rng),
            chrome=interiors.chrome(),
            aluminium=interiors.painted_metal(rng, (0.33, 0.34, 0.36)),
            white=interiors.plastic((0.86, 0.86, 0.84)),
            black=interiors.plastic(),
            red=interiors.plastic((0.72, 0.06, 0.05)),
            wood=interiors.wood(rng, interiors.OAK),
            rail=interiors.wood(rng, interiors.BEECH, size=(64, 512)),
            plaster=interiors.plaster(rng),
            carpet=interiors.carpet(rng),
            linoleum=interiors.linoleum(rng),
            tiles=interiors.ceiling_tiles(rng),
        )


def door_frame(fittings: Fittings) -> list[Surface]:
    """The steel frame of a doorway; x = 0 is its left edge."""
    deep = (-0.02, WALL_THICKNESS)
    posts = [
        box((x, deep[0], 0.0), (x + _JAMB, deep[1], DOOR_HEIGHT)) for x in (0.0, DOOR_WIDTH - _JAMB)
    ]
    lintel = box((0.0, deep[0], DOOR_HEIGHT - _JAMB), (DOOR_WIDTH, deep[1], DOOR_HEIGHT))
    sill = panel((0.0, 0.0, 0.003), (DOOR_WIDTH, 0.0, 0.0), (0.0, WALL_THICKNESS, 0.0))
    return [
        solid("door frame", fittings.frame, *posts, lintel),
        solid("door sill", fittings.aluminium, sill),
    ]


def door_leaf(fittings: Fittings, angle: float = 0.0, name: str = "door leaf") -> list[Surface]:
    """A leaf hinged on the right of its frame, opened by `angle` into the room."""
    width, high = DOOR_WIDTH - 2 * _JAMB, DOOR_HEIGHT - _JAMB
    leaf = box((-width, 0.0, 0.008), (0.0, 0.04, high), faces="nsewt")
    kick = box((-width + 0.04, -0.003, 0.03), (-0.04, 0.0, 0.26), faces="sewtb")
    plate = box((-width + 0.05, -0.006, 0.95), (-width + 0.09, 0.0, 1.19), faces="sewtb")
    lever = [
        tube((-width + 0.07, 0.0, 1.1), (-width + 0.07, -0.055, 1.1), 0.009),
        tube((-width + 0.06, -0.055, 1.1), (-width + 0.2, -0.055, 1.1), 0.01),
    ]
    parts = [
        solid(name, fittings.leaf, leaf),
        solid(f"{name} kick plate", fittings.metal, kick),
        solid(f"{name} handle", fittings.chrome, plate, *lever),
    ]
    return shifted(parts, (DOOR_WIDTH - _JAMB, 0.06, 0.0), -angle)


def door_plate(rng: np.random.Generator) -> list[Surface]:
    """The plate beside a door, to the left of its frame."""
    return [
        Surface(
            "door plate",
            box((-0.27, -0.008, 1.45), (-0.09, 0.0, 1.57), faces="sewtb"),
            interiors.laminated(printed_things.door_sign(rng)),
        )
    ]


def window_front(fittings: Fittings, opening: Opening, glazed: bool) -> list[Surface]:
    """Panes from the floor to the lintel between posts of aluminium, with a door of glass among
    them; x = 0 is its left edge.

    Args:
        glazed: with panes. Against the light of day their reflection is nothing, and the sun is
            found through an opening only.
    """
    width, high = opening.right - opening.left, opening.top
    count = round(width / 1.2)
    posts = [
        box((x - 0.03, -0.02, 0.0), (x + 0.03, 0.1, high))
        for x in np.linspace(0.03, width - 0.03, count + 1)
    ]
    rails = [box((0.0, -0.01, z), (width, 0.09, z + 0.06)) for z in (0.0, high - 0.06)]
    sill = panel((0.0, 0.0, 0.004), (width, 0.0, 0.0), (0.0, 0.3, 0.0))
    step, door = width / count, count // 2
    transom = box((door * step, -0.01, 2.1), ((door + 1) * step, 0.09, 2.15))
    low = [
        box((i * step, 0.0, 0.9), ((i + 1) * step, 0.05, 0.94)) for i in range(count) if i != door
    ]
    bars = [tube((x, -0.07, 0.85), (x, -0.07, 1.5), 0.015) for x in (door * step + 0.12,)]
    surfaces = [
        solid("window frame", fittings.aluminium, *posts, *rails, transom, *low, sill),
        solid(
            "glass door handle",
            fittings.chrome,
            *bars,
            tube((door * step + 0.12, -0.07, 0.9), (door * step + 0.12, 0.02, 0.9), 0.008),
        ),
    ]
    if glazed:
        surfaces.append(
            solid(
                "window pane",
                interiors.glass_pane(),
                panel((0.0, 0.03, high), (width, 0.0, 0.0), (0.0, 0.0, -high)),
            )
        )
    return surfaces


def lift(fittings: Fittings, opening: Opening) -> list[Surface]:
    """Two sliding doors of steel in a deep frame, with its call button."""
    width, high = opening.right - opening.left, opening.top
    sides = [box((x, -0.03, 0.0), (x + 0.1, 0.12, high)) for x in (0.0, width - 0.1)]
    doors = [
        panel((x, 0.1, high), (width / 2 - 0.1 - 0.003, 0.0, 0.0), (0.0, 0.0, -high), (2.0, 4.0))
        for x in (0.1, width / 2 + 0.003)
    ]
    gap = panel((0.1, 0.105, high), (width - 0.2, 0.0, 0.0), (0.0, 0.0, -high))
    button = box((width + 0.12, -0.012, 1.05), (width + 0.21, 0.0, 1.3), faces="sewtb")
    arrow = panel((width + 0.15, -0.014, 1.2), (0.03, 0.0, 0.0), (0.0, 0.0, -0.03))
    return [
        solid(
            "lift frame", fittings.metal, *sides, box((0.0, -0.03, high - 0.1), (width, 0.12, high))
        ),
        Surface("lift doors", join(doors), Material("metal", (0.72, 0.72, 0.71), roughness=0.12)),
        Surface("lift gap", gap, fittings.black),
        Surface("lift panel", button, fittings.black),
        Surface("lift button", arrow, Material("light", (1.0, 0.55, 0.2), radiance=0.3)),
    ]


def fire_door(fittings: Fittings, width: float) -> list[Surface]:
    """A portal across the corridor with both leaves held open; x along the corridor, the walls at y
    = +-width / 2."""
    half = width / 2
    posts = [box((-0.06, y, 0.0), (0.06, y + 0.09, HEIGHT)) for y in (-half, half - 0.09)]
    lintel = box((-0.06, -half, 2.2), (0.06, half, HEIGHT))
    pane = np.full((256, 96, 3), (150, 152, 150), np.uint8)
    pane[30:150, 18:78] = (34, 40, 44)
    pane[30:150:12, 18:78] = (58, 64, 66)
    pane[30:150, 18:78:12] = (58, 64, 66)
    material = Material("polished", pane, roughness=0.15)
    leaves = [box((0.08, y, 0.01), (0.98, y + 0.05, 2.15)) for y in (-half + 0.06, half - 0.11)]
    bars = [tube((0.2, y, 1.05), (0.9, y, 1.05), 0.016) for y in (-half + 0.16, half - 0.16)]
    return [
        solid("fire door portal", fittings.frame, *posts, lintel),
        solid("fire door leaves", material, *leaves),
        solid("fire door bars", fittings.chrome, *bars),
    ]


def handrail(fittings: Fittings, length: float) -> list[Surface]:
    """A wooden rail on brackets."""
    brackets = [tube((x, 0.0, 0.86), (x, -0.07, 0.9), 0.01) for x in np.arange(0.3, length, 1.2)]
    rail = box((0.0, -0.095, 0.88), (length, -0.05, 0.94))
    return [
        solid("handrail", fittings.rail, rail),
        solid("handrail bracket", fittings.metal, *brackets),
    ]


def radiator(fittings: Fittings, width: float = 1.2) -> list[Surface]:
    """A ribbed heating panel with its pipes."""
    ribs = [box((x, -0.13, 0.16), (x + 0.045, -0.04, 0.86)) for x in np.arange(0.0, width, 0.06)]
    back = box((0.0, -0.1, 0.18), (width, -0.06, 0.84))
    pipes = [tube((width + x, -0.08, 0.2), (width + x, -0.08, 0.0), 0.011) for x in (0.04, 0.09)]
    valve = [placed(cylinder((0.0, 0.0), 0.025, 0.0, 0.07), (width + 0.04, -0.08, 0.2))]
    return [
        solid("radiator", fittings.white, *ribs, back, *pipes),
        solid("radiator valve", fittings.black, *valve),
    ]


def extinguisher(fittings: Fittings, rng: np.random.Generator) -> list[Surface]:
    """A fire extinguisher on its hook below its sign."""
    body = placed(cylinder((0.0, 0.0), 0.08, 0.0, 0.42), (0.0, -0.1, 0.5))
    neck = placed(cylinder((0.0, 0.0), 0.025, 0.0, 0.08), (0.0, -0.1, 0.92))
    grip = box((-0.02, -0.18, 0.98), (0.02, -0.05, 1.01))
    hose = [
        tube((0.03, -0.12, 0.98), (0.1, -0.14, 0.85), 0.012),
        tube((0.1, -0.14, 0.85), (0.095, -0.14, 0.58), 0.012),
    ]
    tag = panel((-0.05, -0.186, 0.84), (0.1, 0.0, 0.0), (0.0, 0.0, -0.14))
    return [
        solid("extinguisher", fittings.red, body),
        solid("extinguisher valve", fittings.black, neck, grip, *hose),
        Surface("extinguisher label", tag, interiors.printed(printed_things.label(rng))),
        Surface(
            "extinguisher sign",
            box((-0.1, -0.006, 1.7), (0.1, 0.0, 1.9), faces="sewtb"),
            interiors.laminated(_fire_sign()),
        ),
    ]


def hydrant(fittings: Fittings) -> list[Surface]:
    """A hose cupboard let into the wall."""
    cupboard = box((-0.35, -0.025, 0.9), (0.35, 0.0, 1.7), faces="sewtb")
    frame = box((-0.38, -0.012, 0.87), (0.38, 0.0, 1.73), faces="sewtb")
    sign = panel((-0.09, -0.027, 1.55), (0.18, 0.0, 0.0), (0.0, 0.0, -0.18))
    return [
        solid("hydrant", fittings.red, cupboard),
        solid("hydrant frame", fittings.metal, frame),
        Surface("hydrant sign", sign, interiors.laminated(_fire_sign())),
    ]


def hung_sign(
    picture: Picture, lit: bool, fittings: Fittings, size: tuple[float, float] = (0.48, 0.2)
) -> list[Surface]:
    """A sign below the ceiling, to be read from both sides; faces +-x, hung at the origin's x and
    y."""
    width, high = size
    low, top = 2.28, 2.28 + high
    faces = [
        panel((0.031, -width / 2, top), (0.0, width, 0.0), (0.0, 0.0, -high)),
        panel((-0.031, width / 2, top), (0.0, -width, 0.0), (0.0, 0.0, -high)),
    ]
    material = Material("light", picture, radiance=0.12) if lit else interiors.laminated(picture)
    body = box((-0.03, -width / 2 - 0.008, low - 0.008), (0.03, width / 2 + 0.008, top + 0.008))
    rods = [tube((0.0, y, top), (0.0, y, HEIGHT), 0.006) for y in (-width / 3, width / 3)]
    return [
        solid("hung sign", fittings.white, body, *rods),
        Surface("hung sign face", join(faces), material),
    ]


def ceiling_lamp(
    radiance: float, warmth: float, fittings: Fittings, size: tuple[float, float] = (1.2, 0.4)
) -> list[Surface]:
    """Build a flat lamp under the ceiling around the origin, with shining sides. `warmth` in [0, 1]
    is the colour of its light.

    Args:
        radiance: 1 is full light, 0 is off.
    """
    x, y = size[0] / 2, size[1] / 2
    cover = box((-x, -y, HEIGHT - 0.065), (x, y, HEIGHT - 0.015), faces="nsewb")
    plate = box(
        (-x - 0.015, -y - 0.015, HEIGHT - 0.015), (x + 0.015, y + 0.015, HEIGHT), faces="nsewb"
    )
    caps = [
        box((s * x - 0.01, -y - 0.005, HEIGHT - 0.07), (s * x + 0.01, y + 0.005, HEIGHT - 0.01))
        for s in (-1, 1)
    ]
    color = (1.0, 0.985 - 0.06 * warmth, 0.96 - 0.14 * warmth)
    return [
        Surface("lamp cover", cover, interiors.ceiling_lamp(radiance > 0.0, radiance, color)),
        solid("lamp frame", fittings.white, plate, *caps),
    ]


def pillar(material: Material) -> Surface:
    """A round pillar before the wall."""
    return Surface(
        "pillar",
        placed(cylinder((0.0, 0.0), 0.16, 0.0, HEIGHT, num_sides=24), (0.0, -0.2, 0.0)),
        material,
    )


def framed(
    width: float, height: float, centre_z: float, frame: Material, material: Material
) -> list[Surface]:
    """A print or board on the wall around x = 0, in a thin frame."""
    low, high = centre_z - height / 2, centre_z + height / 2
    border = box(
        (-width / 2 - 0.018, -0.016, low - 0.018),
        (width / 2 + 0.018, 0.0, high + 0.018),
        faces="sewtb",
    )
    return [
        Surface("picture frame", border, frame),
        Surface(
            "picture",
            panel((-width / 2, -0.0175, high), (width, 0.0, 0.0), (0.0, 0.0, -height)),
            material,
        ),
    ]


def switches(fittings: Fittings, rng: np.random.Generator) -> list[Surface]:
    """A light switch and a socket below it, sometimes a red call point."""
    plates = [box((-0.04, -0.012, z), (0.04, 0.0, z + 0.08), faces="sewtb") for z in (0.25, 1.05)]
    surfaces = [solid("switch", fittings.white, *plates)]
    if rng.random() < 0.35:
        surfaces.append(
            Surface(
                "call point",
                box((-0.045, -0.04, 1.35), (0.045, 0.0, 1.44), faces="sewtb"),
                fittings.red,
            )
        )
    return surfaces


def smoke_detector(fittings: Fittings) -> Surface:
    return Surface(
        "smoke detector",
        cylinder((0.0, 0.0), 0.05, HEIGHT - 0.045, HEIGHT, num_sides=12),
        fittings.white,
    )


def air_vent(fittings: Fittings) -> list[Surface]:
    """A square grille of the ventilation in the ceiling."""
    slats = [
        box((x, -0.22, HEIGHT - 0.02), (x + 0.02, 0.22, HEIGHT - 0.004))
        for x in np.arange(-0.2, 0.2, 0.05)
    ]
    hole = panel((-0.23, -0.23, HEIGHT - 0.003), (0.46, 0.0, 0.0), (0.0, 0.46, 0.0))
    return [
        solid("air vent", fittings.metal, *slats),
        Surface("air vent hole", hole, fittings.black),
    ]


def pipes(length: float) -> list[Mesh]:
    """Two heating pipes along the upper edge of a wall, with their clamps."""
    runs = [tube((0.0, -0.09, z), (length, -0.09, z), 0.028, num_sides=12) for z in (2.58, 2.68)]
    clamps = [box((x, -0.13, 2.54), (x + 0.025, 0.0, 2.72)) for x in np.arange(0.8, length, 2.0)]
    return [*runs, *clamps]


def _fire_sign() -> Picture:
    """An extinguisher and a flame, white on red."""
    picture = np.full((96, 96, 3), (190, 22, 20), np.uint8)
    white = (245, 245, 245)
    cv2.rectangle(picture, (4, 4), (91, 91), white, 2)
    cv2.rectangle(picture, (24, 38), (44, 84), white, -1)
    cv2.rectangle(picture, (31, 24), (37, 38), white, -1)
    cv2.line(picture, (34, 25), (50, 20), white, 4, cv2.LINE_AA)
    cv2.ellipse(picture, (34, 40), (18, 16), 0.0, 180.0, 262.0, white, 3, cv2.LINE_AA)
    flame = [
        (66, 84),
        (56, 72),
        (58, 56),
        (63, 62),
        (66, 42),
        (74, 54),
        (76, 50),
        (82, 68),
        (76, 82),
    ]
    cv2.fillPoly(picture, [np.array(flame, np.int32)], white, cv2.LINE_AA)
    return picture
