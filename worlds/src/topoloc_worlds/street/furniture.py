"""Build objects on pavements: lamps, traffic signs and lights, bins, post boxes, advertising
pillars, bus stops, benches, bollards."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from topoloc_worlds.furnishing.lettering import blank, to_bytes, vivid, write
from topoloc_worlds.furnishing.prints import poster
from topoloc_worlds.scene import Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import box, cylinder, join, panel, tube
from topoloc_worlds.street.materials import StreetMaterials

_SIGNS = 8


@dataclass(frozen=True, eq=False)
class FurnitureMaterials:
    """Shared by all things on the pavements."""

    signs: Material
    posters: tuple[Material, ...]
    yellow: Material
    green: Material
    blue: Material
    red: Material
    off: Material
    wood: Material
    glass: Material


def furniture_materials(rng: np.random.Generator) -> FurnitureMaterials:
    """Plates of signs, posters, and the colours of bins and boxes."""
    return FurnitureMaterials(
        signs=Material(
            "matt", np.concatenate([_plate(rng, kind) for kind in range(_SIGNS)], axis=1)
        ),
        posters=tuple(Material("matt", poster(rng, (360, 252))) for _ in range(6)),
        yellow=Material("polished", (0.86, 0.7, 0.1), roughness=0.15),
        green=Material("polished", (0.12, 0.3, 0.2), roughness=0.25),
        blue=Material("polished", (0.12, 0.2, 0.4), roughness=0.25),
        red=Material("polished", (0.6, 0.08, 0.08), roughness=0.2),
        off=Material("polished", (0.12, 0.1, 0.08), roughness=0.1),
        wood=Material("matt", (0.5, 0.36, 0.24)),
        glass=Material("glass"),
    )


def _plate(rng: np.random.Generator, kind: int) -> Picture:
    """Round: no parking, 30, no entry; square: crossing, parking; triangles; a street's name."""
    picture = blank((64, 64), (0.5, 0.5, 0.5))
    white, red, blue = (240, 240, 238), (190, 25, 30), (25, 70, 160)
    if kind == 0:
        cv2.circle(picture, (32, 32), 31, red, -1, cv2.LINE_AA)
        cv2.circle(picture, (32, 32), 23, blue, -1, cv2.LINE_AA)
        cv2.line(picture, (16, 16), (48, 48), red, 6)
    elif kind == 1:
        cv2.circle(picture, (32, 32), 31, red, -1, cv2.LINE_AA)
        cv2.circle(picture, (32, 32), 24, white, -1, cv2.LINE_AA)
        write(picture, "30", (16.0, 42.0), 28.0, (0.05, 0.05, 0.05), 34.0, bold=True)
    elif kind == 2:
        cv2.circle(picture, (32, 32), 31, red, -1, cv2.LINE_AA)
        cv2.rectangle(picture, (10, 26), (54, 38), white, -1)
    elif kind in (3, 4):
        picture[:] = blue
        if kind == 3:
            cv2.fillPoly(picture, [np.array([[32, 8], [58, 54], [6, 54]], np.int32)], white)
            cv2.line(picture, (32, 20), (32, 40), (10, 10, 10), 4)
            cv2.line(picture, (32, 40), (22, 52), (10, 10, 10), 4)
            cv2.line(picture, (32, 40), (42, 52), (10, 10, 10), 4)
        else:
            write(picture, "P", (18.0, 52.0), 52.0, (0.95, 0.95, 0.95), 40.0, bold=True)
    elif kind == 5:
        picture[:] = (225, 225, 220)
        cv2.fillPoly(picture, [np.array([[32, 60], [2, 6], [62, 6]], np.int32)], red)
        cv2.fillPoly(picture, [np.array([[32, 46], [14, 14], [50, 14]], np.int32)], white)
    else:
        picture[:] = to_bytes(vivid(rng))
        write(
            picture,
            str(rng.choice(["BUS", "H", "TAXI", "Zone", "100m"])),
            (6.0, 42.0),
            30.0,
            (0.95, 0.95, 0.93),
            54.0,
            bold=True,
        )
    return picture


def _disc(centre: tuple[float, float, float], radius: float, kind: int, num_corners: int) -> Mesh:
    """A plate that faces -x and carries one of the pictures."""
    angles = np.linspace(0.0, 2 * np.pi, num_corners, endpoint=False) + np.pi / num_corners
    reach = radius / np.cos(np.pi / num_corners) if num_corners == 4 else radius
    y, z = -reach * np.cos(angles), reach * np.sin(angles)
    vertices = np.column_stack([np.full(num_corners, centre[0]), centre[1] + y, centre[2] + z])
    uv = np.column_stack([(kind + 0.5 - 0.5 * y / radius) / _SIGNS, 0.5 - 0.5 * z / radius])
    return Mesh(
        vertices, np.array([[0, i, i + 1] for i in range(1, num_corners - 1)], np.int32), uv
    )


def lamp_post(lit: bool, kit: StreetMaterials) -> list[Surface]:
    """A post of 7 m with an arm over the street, towards +y."""
    post = join(
        [
            tube((0, 0, 0), (0, 0, 1.0), 0.09),
            tube((0, 0, 1.0), (0, 0, 7.0), 0.055),
            tube((0, 0, 6.9), (0, 1.7, 7.25), 0.04),
        ]
    )
    head = join(
        [box((-0.15, 1.4, 7.22), (0.15, 2.2, 7.34)), box((-0.1, -0.11, 0.5), (0.1, -0.05, 1.1))]
    )
    glow = box((-0.12, 1.5, 7.17), (0.12, 2.15, 7.22), faces="nsewb")
    return [
        Surface("lamp post", join([post, head]), kit.steel),
        Surface("street lamp", glow, kit.lamp[int(lit)]),
    ]


def traffic_sign(
    rng: np.random.Generator, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """One or two plates on a post, facing -x."""
    kinds = rng.permutation(_SIGNS)[: int(rng.integers(1, 3))]
    plates, backs = [], []
    for i, kind in enumerate(kinds.tolist()):
        at = (-0.05, 0.0, 2.55 - 0.68 * i + 0.3)
        corners = 16 if kind < 3 else 4
        plates.append(_disc(at, 0.31, kind, corners))
        backs.append(_disc((-0.04, at[1], at[2]), 0.31, kind, corners))
    return [
        Surface("sign post", join([tube((0, 0, 0), (0, 0, 3.15), 0.035), *backs]), kit.steel),
        Surface("traffic sign", join(plates), things.signs),
    ]


def traffic_light(kit: StreetMaterials, things: FurnitureMaterials) -> list[Surface]:
    """A post with a head of three lamps before a dark board, facing -x."""
    dark = [
        tube((0, 0, 0), (0, 0, 3.4), 0.06),
        box((-0.16, -0.16, 2.4), (0.12, 0.16, 3.35)),
        box((-0.3, -0.35, 2.3), (-0.29, 0.35, 3.45)),
    ]
    shades = [box((-0.5, -0.13, z + 0.1), (-0.3, 0.13, z + 0.12)) for z in (2.5, 2.8, 3.1)]
    dots = [_disc((-0.31, 0.0, z), 0.1, 0, 12) for z in (2.5, 2.8)]
    return [
        Surface("traffic light", join([*dark, *shades]), kit.iron),
        Surface("traffic light", _disc((-0.31, 0.0, 3.1), 0.1, 0, 12), things.red),
        Surface("traffic light", join(dots), things.off),
    ]


def advertising_pillar(
    rng: np.random.Generator, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """A round pillar pasted with posters, under a small roof."""
    result = [
        Surface(
            "pillar",
            join(
                [
                    cylinder((0, 0), 0.62, 0.0, 0.45),
                    cylinder((0, 0), 0.6, 2.75, 3.0),
                    cylinder((0, 0), 0.72, 3.0, 3.15),
                ]
            ),
            kit.concrete,
        )
    ]
    edges = np.linspace(0.0, 2 * np.pi, 25)
    order = rng.permutation(len(things.posters))
    for k in range(6):
        a = edges[4 * k : 4 * k + 5]
        vertices = np.concatenate(
            [
                np.column_stack([0.6 * np.cos(a), 0.6 * np.sin(a), np.full(5, z)])
                for z in (2.75, 0.45)
            ]
        )
        uv = np.concatenate(
            [np.column_stack([np.linspace(0, 1, 5), np.full(5, v)]) for v in (0.0, 2.6)]
        )
        i = np.arange(4)
        faces = np.concatenate(
            [np.column_stack([i, i + 5, i + 6]), np.column_stack([i, i + 6, i + 1])]
        ).astype(np.int32)
        result.append(
            Surface("poster", Mesh(vertices, faces, uv), things.posters[int(order[k % len(order)])])
        )
    return result


def bus_stop(
    rng: np.random.Generator, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """A shelter of 4 m along x, open to +y, with a bench and a lit-up poster's case at its end."""
    frame = [tube((x, y, 0), (x, y, 2.5), 0.04) for x in (-2.0, 0.0, 2.0) for y in (-0.6, 0.6)]
    roof = box((-2.2, -0.75, 2.5), (2.2, 0.85, 2.6))
    panes = [panel((x, -0.6, 2.4), (1.9, 0, 0), (0, 0, -2.1)) for x in (-1.95, 0.05)]
    bench = box((-1.5, -0.45, 0.42), (0.9, -0.05, 0.47))
    case = box((2.0, -0.7, 0.3), (2.15, 0.7, 2.3))
    which = things.posters[int(rng.integers(0, len(things.posters)))]
    fronts = [
        panel((1.99, 0.6, 2.15), (0, -1.2, 0), (0, 0, -1.7)),
        panel((2.16, -0.6, 2.15), (0, 1.2, 0), (0, 0, -1.7)),
    ]
    return [
        Surface("bus stop", join([*frame, roof, case]), kit.iron),
        Surface("bus stop glass", join(panes), things.glass),
        Surface("bench", bench, things.wood),
        Surface("poster", join(fronts), which),
    ]


def bin_of(
    rng: np.random.Generator, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """Build a dustbin on wheels in front of a house."""
    body = [things.green, things.blue, kit.iron, things.yellow][int(rng.integers(0, 4))]
    tub = join(
        [box((-0.28, -0.3, 0.08), (0.28, 0.3, 0.95)), box((-0.31, -0.34, 0.95), (0.31, 0.36, 1.05))]
    )
    return [
        Surface("bin", tub, body),
        Surface("bin wheels", box((-0.24, 0.22, 0.0), (0.24, 0.36, 0.16)), kit.iron),
    ]


def small_thing(
    rng: np.random.Generator, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """A post box, a cabinet of the telephones, a litter basket, a bench or some bollards; front
    towards +y."""
    kind = int(rng.integers(0, 5))
    if kind == 0:
        parts = [box((-0.25, -0.2, 0.5), (0.25, 0.2, 1.3)), tube((0, 0, 0), (0, 0, 0.5), 0.06)]
        return [
            Surface("post box", join(parts), things.yellow),
            Surface("post box", box((-0.15, 0.2, 1.15), (0.15, 0.21, 1.19)), kit.iron),
        ]
    if kind == 1:
        return [
            Surface("cabinet", box((-0.6, -0.2, 0.0), (0.6, 0.2, 1.15)), kit.concrete),
            Surface(
                "poster", panel((0.3, 0.21, 1.0), (-0.5, 0, 0), (0, 0, -0.6)), things.posters[0]
            ),
        ]
    if kind == 2:
        return [
            Surface(
                "litter basket",
                join([cylinder((0, 0), 0.22, 0.35, 0.95, 10), tube((0, 0, 0), (0, 0, 1.2), 0.03)]),
                things.green,
            )
        ]
    if kind == 3:
        seats = [box((-0.8, y, 0.45), (0.8, y + 0.1, 0.49)) for y in (-0.2, -0.07, 0.06)] + [
            box((-0.8, -0.3, z), (0.8, -0.26, z + 0.1)) for z in (0.62, 0.78)
        ]
        legs = [box((x, -0.3, 0.0), (x + 0.06, 0.16, 0.45)) for x in (-0.65, 0.6)]
        return [Surface("bench", join(seats), things.wood), Surface("bench", join(legs), kit.iron)]
    return [
        Surface(
            "bollard",
            join([cylinder((x, 0.0), 0.07, 0.0, 0.95, 8) for x in (-1.5, 0.0, 1.5)]),
            kit.iron,
        )
    ]
