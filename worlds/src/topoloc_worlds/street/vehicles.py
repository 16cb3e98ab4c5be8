"""Parked cars: hatchbacks, saloons, estates and vans, each lofted from its side view; glossy, with
windows, wheels, lamps and plates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float64

from topoloc_worlds.furnishing.lettering import blank, write
from topoloc_worlds.scene import Color, Material, Mesh, Surface
from topoloc_worlds.shapes import box, join, panel, placed


@dataclass(frozen=True)
class CarShape:
    """A side view, front at x = 0. Points (x, z) in metres: the body's upper edge at the window
    line, and the roof line over it."""

    length: float
    width: float
    belt: tuple[tuple[float, float], ...]
    roof: tuple[tuple[float, float], ...]
    wheels: tuple[float, float]
    pillars: tuple[float, ...]
    blind_from: float = 99.0
    """Behind this x there are no side windows."""
    tyre: float = 0.32
    roof_width: float = 0.74
    """As a share of the width."""


SHAPES = (
    CarShape(
        4.0, 1.75, ((0.0, 0.62), (0.15, 0.78), (0.95, 0.95), (3.7, 1.02), (4.0, 0.95)),
        ((0.95, 0.95), (1.65, 1.4), (2.2, 1.48), (3.2, 1.44), (3.8, 1.02)), (0.75, 3.25), (2.3, 3.2),  # noqa: E501
    ),
    CarShape(
        4.65, 1.82, ((0.0, 0.58), (0.15, 0.72), (1.25, 0.92), (3.8, 0.98), (4.55, 0.98), (4.65, 0.85)),  # noqa: E501
        ((1.25, 0.92), (2.05, 1.38), (2.6, 1.44), (3.3, 1.4), (4.05, 0.98)), (0.9, 3.65), (2.7, 3.55),  # noqa: E501
    ),
    CarShape(
        4.7, 1.82, ((0.0, 0.6), (0.15, 0.75), (1.2, 0.95), (4.5, 1.03), (4.7, 0.95)),
        ((1.2, 0.95), (1.95, 1.42), (2.5, 1.5), (4.0, 1.47), (4.55, 1.03)), (0.88, 3.65), (2.6, 3.5),  # noqa: E501
    ),
    CarShape(
        4.4, 1.86, ((0.0, 0.75), (0.12, 0.95), (1.05, 1.1), (4.2, 1.15), (4.4, 1.05)),
        ((1.05, 1.1), (1.7, 1.6), (2.3, 1.68), (3.7, 1.65), (4.25, 1.15)), (0.85, 3.5), (2.4, 3.4), tyre=0.37,  # noqa: E501
    ),
    CarShape(
        5.2, 1.98, ((0.0, 0.85), (0.12, 1.05), (0.9, 1.2), (5.0, 1.25), (5.2, 1.2)),
        ((0.9, 1.2), (1.6, 1.95), (2.1, 2.05), (5.05, 2.04), (5.18, 1.25)), (0.85, 4.2), (2.0,),
        blind_from=2.05, tyre=0.35, roof_width=0.88,
    ),
)  # fmt: skip
PAINTS: tuple[Color, ...] = (
    (0.88, 0.88, 0.87), (0.66, 0.67, 0.68), (0.34, 0.35, 0.37), (0.08, 0.08, 0.09), (0.12, 0.2, 0.42),  # noqa: E501
    (0.55, 0.08, 0.09), (0.2, 0.3, 0.24), (0.72, 0.62, 0.42),
)  # fmt: skip
_PLATES = 24


@dataclass(frozen=True, eq=False)
class CarMaterials:
    """Shared by all cars of a town."""

    paints: tuple[Material, ...]
    glass: Material
    rubber: Material
    rim: Material
    trim: Material
    headlamp: Material
    tail: Material
    plates: Material


def car_materials(rng: np.random.Generator) -> CarMaterials:
    """Paints, glass, tyres, and a picture of number plates."""
    plates = []
    for _ in range(_PLATES):
        plate = blank((24, 112), (0.93, 0.93, 0.91))
        plate[:, :9] = (20, 60, 150)
        letters = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVWXYZ"), 4))
        write(
            plate,
            f"{letters[:2]} {letters[2:]} {rng.integers(10, 999)}",
            (14.0, 19.0),
            17.0,
            (0.05, 0.05, 0.06),
            92.0,
            bold=True,
        )
        cv2.rectangle(plate, (0, 0), (111, 23), (30, 30, 30), 1)
        plates.append(plate)
    return CarMaterials(
        paints=tuple(Material("polished", tone, roughness=0.06) for tone in PAINTS),
        glass=Material("polished", (0.07, 0.08, 0.09), roughness=0.01),
        rubber=Material("matt", (0.14, 0.14, 0.14)),
        rim=Material("polished", (0.6, 0.61, 0.62), roughness=0.15),
        trim=Material("polished", (0.1, 0.1, 0.11), roughness=0.25),
        headlamp=Material("polished", (0.8, 0.82, 0.84), roughness=0.02),
        tail=Material("polished", (0.55, 0.04, 0.05), roughness=0.02),
        plates=Material("matt", np.concatenate(plates, axis=0)),
    )


def car(shape: CarShape, paint: int, plate: int, kit: CarMaterials) -> list[Surface]:
    """A car with its front towards +x, its middle at the origin, wheels on z = 0."""
    result = []
    for name, mesh in _meshes(shape):
        material = kit.paints[paint] if name == "body" else getattr(kit, name)
        if name == "plates":
            mesh = Mesh(
                mesh.vertices,
                mesh.faces,
                (mesh.uv + np.array([0.0, plate])) / np.array([1.0, _PLATES]),
            )
        result.append(Surface(f"parked car {name}", mesh, material))
    return result


@cache
def _meshes(shape: CarShape) -> tuple[tuple[str, Mesh], ...]:
    """The parts of a car by the names that their materials have in CarMaterials."""
    belt_x, belt_z = np.array(shape.belt).T
    stations = np.unique(
        np.round(
            np.concatenate(
                [belt_x, np.linspace(0.15, shape.length - 0.12, 12), *_arch_ends(shape)]
            ),
            3,
        )
    )
    half = _half_width(shape, stations)
    cabin, glass = _cabin(shape)
    parts = [
        ("body", join([_body(shape, stations, half, np.interp(stations, belt_x, belt_z)), *cabin])),
        ("glass", join(glass)),
        *_wheels(shape),
        *_ends(shape),
    ]
    turned = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0]])
    centre = np.array([shape.length / 2, 0.0, 0.0])
    return tuple(
        (name, Mesh((mesh.vertices - centre) @ turned, mesh.faces, mesh.uv)) for name, mesh in parts
    )


def _arch_ends(shape: CarShape) -> list[Float64[np.ndarray, "k"]]:
    reach = shape.tyre + 0.06
    return [axle + reach * np.cos(np.linspace(0, np.pi, 7)) for axle in shape.wheels]


def _half_width(shape: CarShape, x: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    """Rounded towards both ends, seen from above."""
    end = np.minimum(x, shape.length - x)
    return shape.width / 2 * (1.0 - 0.22 * np.exp(-end / 0.16))


def _body(
    shape: CarShape,
    x: Float64[np.ndarray, "n"],
    half: Float64[np.ndarray, "n"],
    belt: Float64[np.ndarray, "n"],
) -> Mesh:
    """Sides with wheel arches, bulging at the middle height; bonnet, boot and ends."""
    reach, low = shape.tyre + 0.06, np.full(len(x), 0.2)
    for axle in shape.wheels:
        inside = np.abs(x - axle) < reach
        low[inside] = np.maximum(
            low[inside], shape.tyre + np.sqrt(reach**2 - (x[inside] - axle) ** 2) * 0.95
        )
    low = np.minimum(low, belt - 0.05)
    middle = low + 0.62 * (belt - low)
    ring = [
        (0.0, low),
        (0.93, low),
        (1.0, middle),
        (0.985, belt - 0.06),
        (0.93, belt),
        (0.0, belt + 0.035),
    ]
    right = np.stack([np.column_stack([x, share * half, z]) for share, z in ring], axis=1)
    ring_all = np.concatenate([right, right[:, -2::-1] * [1.0, -1.0, 1.0]], axis=1)
    n, k = ring_all.shape[:2]
    a = (np.arange(n - 1)[:, None] * k + np.arange(k - 1)[None]).ravel()
    faces = [np.column_stack([a, a + 1, a + k + 1]), np.column_stack([a, a + k + 1, a + k])]
    for start in (0, (n - 1) * k):
        faces.append(np.array([[start, start + j, start + j + 1] for j in range(1, k - 1)]))
    return Mesh(
        ring_all.reshape(-1, 3), np.concatenate(faces).astype(np.int32), np.zeros((n * k, 2))
    )


def _cabin(shape: CarShape) -> tuple[list[Mesh], list[Mesh]]:
    """Roof and pillars; panes: windscreen, rear window, side windows between the pillars."""
    roof_x, roof_z = np.array(shape.roof).T
    belt_x, belt_z = np.array(shape.belt).T
    top, foot = shape.width / 2 * shape.roof_width, shape.width / 2 * 0.93
    cabin, glass = [], []
    upper = np.where((roof_x == roof_x[0]) | (roof_x == roof_x[-1]), foot, top)
    for i in range(len(roof_x) - 1):
        sheet = _quad(
            (roof_x[i], upper[i], roof_z[i]), (roof_x[i + 1], upper[i + 1], roof_z[i + 1])
        )
        is_pane = i in (0, len(roof_x) - 2)
        (glass if is_pane else cabin).append(sheet)
        if is_pane:
            cabin.append(_rim(sheet))
    cuts = np.unique(np.concatenate([roof_x, *[[p - 0.05, p + 0.05] for p in shape.pillars]]))
    for x0, x1 in pairwise(cuts.tolist()):
        middle = (x0 + x1) / 2
        is_pane = middle < shape.blind_from and not any(
            abs(middle - p) < 0.05 for p in shape.pillars
        )
        for side in (-1.0, 1.0):
            corners = []
            for x in (x0, x1):
                height, line = (
                    float(np.interp(x, roof_x, roof_z)),
                    float(np.interp(x, belt_x, belt_z)),
                )
                share = 0.0 if height - line < 1e-6 else 1.0
                corners += [
                    (x, side * foot, line),
                    (x, side * (foot + (top - foot) * share), height),
                ]
            mesh = Mesh(
                np.array(corners), np.array([[0, 1, 3], [0, 3, 2]], np.int32), np.zeros((4, 2))
            )
            (glass if is_pane else cabin).append(mesh)
    drop = np.array([0.0, 0.02, -0.07])  # the strip of paint between the roof and the side windows
    for side in (-1.0, 1.0):
        for i in range(len(roof_x) - 1):
            a, b = (
                np.array([roof_x[i], side * upper[i], roof_z[i]]),
                np.array([roof_x[i + 1], side * upper[i + 1], roof_z[i + 1]]),
            )
            cabin.append(
                Mesh(
                    np.array([a, b, b + drop * [1, side, 1], a + drop * [1, side, 1]]),
                    _TWO,
                    np.zeros((4, 2)),
                )
            )
    return cabin, glass


_TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def _quad(a: tuple[float, float, float], b: tuple[float, float, float]) -> Mesh:
    """A sheet across the car from `a` to `b` and their mirror images."""
    corners = np.array([a, b, (b[0], -b[1], b[2]), (a[0], -a[1], a[2])])
    return Mesh(corners, _TWO, np.zeros((4, 2)))


def _rim(sheet: Mesh) -> Mesh:
    """The painted strips at both sides of a wind-screen."""
    a, b, c, d = sheet.vertices
    out = np.array([0.0, 0.0, 0.006])
    strips = []
    for p, q, across in ((a, b, d - a), (d, c, a - d)):
        inner = across * 0.045
        strips.append(Mesh(np.array([p, q, q + inner, p + inner]) + out, _TWO, np.zeros((4, 2))))
    return join(strips)


def _wheels(shape: CarShape) -> list[tuple[str, Mesh]]:
    tyres, rims, wells = [], [], []
    r, angles = shape.tyre, np.linspace(0.0, 2 * np.pi, 19)
    for axle in shape.wheels:
        wells.append(
            box(
                (axle - r - 0.05, -shape.width / 2 + 0.1, 0.25),
                (axle + r + 0.05, shape.width / 2 - 0.1, r * 2 + 0.06),
            )
        )
        for side in (-1.0, 1.0):
            out, back = side * (shape.width / 2 - 0.035), side * (shape.width / 2 - 0.26)
            for radius_in, radius_out, y0, y1, into in (
                (r, r, back, out, tyres), (0.62 * r, r, out, out, tyres), (0.25 * r, 0.62 * r, out - side * 0.05, out - side * 0.01, rims),  # noqa: E501
            ):  # fmt: skip
                rings = [
                    np.column_stack(
                        [axle + q * np.cos(angles), np.full(19, y), r + q * np.sin(angles)]
                    )
                    for q, y in ((radius_in, y0), (radius_out, y1))
                ]
                i = np.arange(18)
                keep = i if into is tyres else i[i % 3 != 0]
                faces = np.concatenate(
                    [
                        np.column_stack([keep, keep + 1, keep + 20]),
                        np.column_stack([keep, keep + 20, keep + 19]),
                    ]
                )
                into.append(Mesh(np.concatenate(rings), faces.astype(np.int32), np.zeros((38, 2))))
    return [("rubber", join(tyres)), ("rim", join(rims)), ("trim", join(wells))]


def _ends(shape: CarShape) -> list[tuple[str, Mesh]]:
    """Lamps, grille, bumpers' dark strips, mirrors, handles and number plates."""
    wide, long, belt = shape.width / 2, shape.length, shape.belt
    nose, tail = belt[0][1], belt[-1][1]
    head = [
        box(
            (-0.012, s * wide * 0.56 - 0.19, nose - 0.16),
            (0.1, s * wide * 0.56 + 0.19, nose - 0.03),
        )
        for s in (-1.0, 1.0)
    ]
    rear = [
        box(
            (long - 0.1, s * wide * 0.6 - 0.14, tail - 0.24),
            (long + 0.01, s * wide * 0.6 + 0.14, tail - 0.07),
        )
        for s in (-1.0, 1.0)
    ]
    dark = [
        box((-0.02, -wide * 0.3, nose - 0.16), (0.1, wide * 0.3, nose - 0.05)),
        box((-0.02, -wide * 0.7, 0.24), (0.1, wide * 0.7, 0.36)),
        box((long - 0.1, -wide * 0.7, 0.24), (long + 0.02, wide * 0.7, 0.38)),
        box((0.5, -wide + 0.06, 0.17), (long - 0.4, wide - 0.06, 0.22)),
    ]
    mirror_x = shape.roof[0][0] + 0.45
    for s in (-1.0, 1.0):
        dark.append(
            box(
                (mirror_x, min(s * wide, s * (wide + 0.16)), belt[2][1]),
                (mirror_x + 0.1, max(s * wide, s * (wide + 0.16)), belt[2][1] + 0.14),
            )
        )
        for x in (shape.pillars[0] + 0.12, shape.pillars[0] - 0.85, *shape.pillars[1:]):
            seam = min(s * wide, s * (wide + 0.004))
            dark.append(box((x, seam, 0.3), (x + 0.012, seam + 0.004, belt[2][1])))
            dark.append(
                box(
                    (x + 0.06, seam - 0.012, belt[2][1] - 0.14),
                    (x + 0.22, seam + 0.016, belt[2][1] - 0.11),
                )
            )
    fronts = [
        panel((-0.03, 0.26, 0.52), (0, -0.52, 0), (0, 0, -0.11)),
        panel((long + 0.03, -0.26, 0.66), (0, 0.52, 0), (0, 0, -0.11)),
    ]
    return [
        ("headlamp", join(head)),
        ("tail", join(rear)),
        ("trim", join(dark)),
        ("plates", join(fronts)),
    ]


def parked(surfaces: list[Surface], at: tuple[float, float, float], yaw: float) -> list[Surface]:
    """A car at its place, its front towards `yaw`."""
    return [Surface(s.name, placed(s.mesh, at, yaw), s.material) for s in surfaces]
