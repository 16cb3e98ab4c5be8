"""Build the lab's empty room: floor, ceiling, walls, the window front with the view outside,
ceiling lamps."""

from __future__ import annotations

from math import pi

import numpy as np
from jaxtyping import Float64

from topoloc_worlds.conditions import CONDITIONS, Condition
from topoloc_worlds.furnishing.interiors import (
    WHITE,
    Finishes,
    carpet,
    ceiling_lamp,
    ceiling_tiles,
    linoleum,
    plaster,
)
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Material, Mesh, Sky, Surface
from topoloc_worlds.shapes import Number, box, join, lathe, panel, placed, tube
from topoloc_worlds.skies import sky_of

LENGTH, WIDTH, HEIGHT = 5.0, 4.0, 2.8
"""Of the room: x, y, z."""
SILL, LINTEL, REVEAL = 0.95, 2.35, 0.25
WINDOWS = ((0.45, 1.6), (1.92, 3.07), (3.4, 4.55))
"""From and to, x; all in the north wall, y = WIDTH."""
CEILING_LAMPS = ((1.2, 0.6), (3.6, 0.6), (1.2, 2.4), (3.6, 2.4))
"""Corners (x, y) of the lamps, which take one tile each."""
DARK = 0.05
"""Share of a clear noon's daylight below which people need lamps."""
_TILE = 0.6
_SCREENED = 0.1
"""Share of the sun's light that comes through the sun-screening film of the windows, which lets the
sky's light through."""


def shell(seed: int, finishes: Finishes, lit: frozenset[int]) -> list[Surface]:
    """Everything that is built in; `lit` are the indices of the ceiling lamps that are on."""
    return [
        *_faces(seed),
        *_window_front(seed, finishes),
        *_blinds(seed, finishes),
        *_ceiling_lamps(finishes, lit),
        *_fittings(finishes),
    ]


def sky_above(condition: Condition, seed: int) -> Sky:
    """Make the sun, if it shines, and a patch of sky around it. All other light from outside is on
    the surfaces of `light_shafts`."""
    to_sun = _to_sun(seed)
    rows, columns = 64, 128
    polar, azimuth = np.meshgrid(
        (np.arange(rows) + 0.5) * pi / rows, np.arange(columns) * 2 * pi / columns, indexing="ij"
    )
    directions = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
    )
    patch = (directions @ to_sun > np.cos(0.35))[..., None] * _outdoors(condition)
    if not condition.sun:
        return Sky(patch.astype(np.float32))
    r, g, b = sky_of(condition, seed).sun_irradiance
    return Sky(patch.astype(np.float32), to_sun, (_SCREENED * r, _SCREENED * g, _SCREENED * b))


def light_shafts(condition: Condition, seed: int) -> list[Surface]:
    """Build the daylight from the windows: panes as bright as the outdoors, and a shaft of equal
    brightness outside of the free window.

    A room that only the sky lights through its windows renders with the most noise: three of a
    hundred light paths find the window, but every path finds a pane. The free window lets the sun
    in, because the walls of its shaft are parallel to the sun's rays. By day all this is
    overexposed like the outdoors, by night it is dark.
    """
    to_sun = _to_sun(seed)
    along = to_sun * (3.0 / to_sun[1])
    y, up = WIDTH + REVEAL, np.array([0.0, 0.0, LINTEL - SILL])
    *covered, free = _window_order(seed)
    panes = [
        panel(
            (WINDOWS[k][0], y, LINTEL), (WINDOWS[k][1] - WINDOWS[k][0], 0, 0), (0, 0, SILL - LINTEL)
        )
        for k in covered
    ]
    x0, x1 = WINDOWS[free]
    low, right = np.array([x0, y, SILL]), np.array([x1 - x0, 0.0, 0.0])
    below = panel(low, along, right)
    above = [
        panel(low + up + along, -along, right),
        panel(low + up, along, -up),
        panel(low + right + up + along, -along, -up),
    ]
    r, g, b = (_outdoors(condition) / max(_outdoors(condition).max(), 1e-9)).tolist()
    sky = Material(
        "light", (r**0.4545, g**0.4545, b**0.4545), radiance=float(_outdoors(condition).max())
    )
    land = Material(
        "light", (r**0.4545, g**0.4545, b**0.4545), radiance=0.5 * float(_outdoors(condition).max())
    )
    return [Surface("outdoors", join([*panes, *above]), sky), Surface("outdoors", below, land)]


def _window_order(seed: int) -> list[int]:
    """The window with slats, the one with a roller blind, the free one."""
    return [int(k) for k in rng_of(seed, "window order").permutation(len(WINDOWS))]


def _to_sun(seed: int) -> Float64[np.ndarray, "3"]:
    """The direction of the sun over this room: its height is that of the seed's sky; it comes
    through the windows at a slant."""
    noon = sky_of(CONDITIONS["day"], seed).sun_direction
    assert noon is not None
    rng = rng_of(seed, "window front")
    azimuth = pi / 2 + float(rng.choice([-1, 1])) * rng.uniform(0.35, 0.85)
    level = float(np.hypot(noon[0], noon[1]))
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), noon[2]])


def _outdoors(condition: Condition) -> Float64[np.ndarray, "3"]:
    """Return the mean radiance of the outdoors: blue before sunrise, white by day, a town's glow by
    night."""
    if condition.daylight <= 0.0:
        return np.array([2.5e-4, 2e-4, 1.6e-4])
    blue = np.array([0.5, 0.75, 1.3]) if condition.daylight < DARK else np.array([0.9, 1.0, 1.12])
    return condition.daylight * blue


def _faces(seed: int) -> list[Surface]:
    rng = rng_of(seed, "room")
    tinted = (0.8, 0.84, 0.86) if rng.uniform() < 0.5 else (0.88, 0.84, 0.74)
    # The floor's picture is 4 m by 4 m.
    floor = carpet(rng, tiles=8) if rng.uniform() < 0.5 else linoleum(rng)
    ceiling = panel((0, 0, HEIGHT), (LENGTH, 0, 0), (0, WIDTH, 0), (LENGTH / 2.4, WIDTH / 2.4))
    skirting = [
        box((0, 0, 0), (LENGTH, 0.015, 0.07), faces="nt"),
        box((0, WIDTH - 0.015, 0), (LENGTH, WIDTH, 0.07), faces="st"),
        box((0, 0, 0), (0.015, WIDTH, 0.07), faces="et"),
        box((LENGTH - 0.015, 0, 0), (LENGTH, 2.4, 0.07), faces="wt"),
        box((LENGTH - 0.015, 3.6, 0), (LENGTH, WIDTH, 0.07), faces="wt"),
    ]
    return [
        Surface(
            "floor",
            panel((0, WIDTH, 0), (LENGTH, 0, 0), (0, -WIDTH, 0), (LENGTH / 4, WIDTH / 4)),
            floor,
        ),
        Surface("ceiling", ceiling, ceiling_tiles(rng)),
        Surface(
            "wall south", panel((LENGTH, 0, HEIGHT), (-LENGTH, 0, 0), (0, 0, -HEIGHT)), plaster(rng)
        ),
        Surface(
            "wall west", panel((0, 0, HEIGHT), (0, WIDTH, 0), (0, 0, -HEIGHT)), plaster(rng, tinted)
        ),
        Surface(
            "wall east",
            panel((LENGTH, WIDTH, HEIGHT), (0, -WIDTH, 0), (0, 0, -HEIGHT)),
            plaster(rng),
        ),
        Surface("skirting", join(skirting), Material("polished", (0.4, 0.38, 0.36), roughness=0.3)),
    ]


def _window_front(seed: int, finishes: Finishes) -> list[Surface]:
    """The north wall around three windows, their reveals, sills and frames. There are no panes: one
    looks out through open air."""
    rng = rng_of(seed, "window wall")

    def piece(x0: Number, x1: Number, z0: Number, z1: Number) -> Mesh:
        mesh = panel((x0, WIDTH, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1))
        uv = np.column_stack([mesh.vertices[:, 0] / LENGTH, 1 - mesh.vertices[:, 2] / HEIGHT])
        return Mesh(mesh.vertices, mesh.faces, uv)

    edges = [0.0, *(x for window in WINDOWS for x in window), LENGTH]
    pieces = [piece(0, LENGTH, 0, SILL), piece(0, LENGTH, LINTEL, HEIGHT)]
    pieces += [piece(edges[i], edges[i + 1], SILL, LINTEL) for i in range(0, len(edges), 2)]
    reveals, sills, frames = [], [], []
    out = WIDTH + REVEAL
    for x0, x1 in WINDOWS:
        reveals.append(panel((x0, WIDTH, LINTEL), (0, REVEAL, 0), (0, 0, SILL - LINTEL)))
        reveals.append(panel((x1, out, LINTEL), (0, -REVEAL, 0), (0, 0, SILL - LINTEL)))
        reveals.append(panel((x0, WIDTH, LINTEL), (x1 - x0, 0, 0), (0, REVEAL, 0)))
        sills.append(
            box((x0 - 0.04, WIDTH - 0.06, SILL), (x1 + 0.04, out, SILL + 0.025), texels=0.8)
        )
        middle = (x0 + x1) / 2
        frames += [
            box((x - 0.03, out - 0.06, SILL), (x + 0.03, out, LINTEL))
            for x in (x0 + 0.03, middle, x1 - 0.03)
        ]
        frames += [
            box((x0, out - 0.06, z - 0.03), (x1, out, z + 0.03))
            for z in (SILL + 0.05, LINTEL - 0.03)
        ]
        frames.append(box((middle + 0.035, out - 0.09, 1.55), (middle + 0.05, out - 0.06, 1.68)))
    return [
        Surface("wall north", join(pieces), plaster(rng)),
        Surface("reveal", join(reveals), Material("matt", WHITE)),
        Surface("sill", join(sills), finishes.board),
        Surface("window frame", join(frames), finishes.ivory),
    ]


def _blinds(seed: int, finishes: Finishes) -> list[Surface]:
    """Slats before one window, a roller blind partly down before another, the third one free."""
    rng = rng_of(seed, "blinds")
    slatted, rolled, _ = _window_order(seed)
    x0, x1 = WINDOWS[slatted]
    low = SILL + rng.uniform(0.1, 0.6)
    slats = [
        panel((x0 + 0.07, WIDTH + 0.11, z + 0.012), (x1 - x0 - 0.14, 0, 0), (0, 0.03, -0.024))
        for z in np.arange(low, LINTEL - 0.05, 0.036)
    ]
    cords = [
        tube((x, WIDTH + 0.125, low), (x, WIDTH + 0.125, LINTEL), 0.002, 4)
        for x in (x0 + 0.25, x1 - 0.25)
    ]
    cords += [
        box((x0 + 0.06, WIDTH + 0.1, LINTEL - 0.05), (x1 - 0.06, WIDTH + 0.15, LINTEL)),
        box((x0 + 0.07, WIDTH + 0.11, low - 0.03), (x1 - 0.07, WIDTH + 0.14, low - 0.01)),
    ]
    x0, x1 = WINDOWS[rolled]
    end = LINTEL - rng.uniform(0.25, 0.7)
    cloth = panel((x0 + 0.03, WIDTH + 0.08, LINTEL), (x1 - x0 - 0.06, 0, 0), (0, 0, end - LINTEL))
    roll = [
        tube(
            (x0 + 0.03, WIDTH + 0.06, LINTEL - 0.03),
            (x1 - 0.03, WIDTH + 0.06, LINTEL - 0.03),
            0.028,
            10,
        ),
        box((x0 + 0.03, WIDTH + 0.072, end - 0.02), (x1 - 0.03, WIDTH + 0.088, end)),
    ]
    return [
        Surface("blind", join(slats), Material("matt", (0.8, 0.8, 0.76))),
        Surface("blind", join([*cords, *roll]), finishes.grey),
        Surface("blind", cloth, Material("matt", (0.78, 0.74, 0.64))),
    ]


def _ceiling_lamps(finishes: Finishes, lit: frozenset[int]) -> list[Surface]:
    on, off = ceiling_lamp(True), ceiling_lamp(False)
    parts = []
    for k, (x, y) in enumerate(CEILING_LAMPS):
        cover = panel(
            (x + 0.02, y + 0.02, HEIGHT - 0.012), (_TILE - 0.04, 0, 0), (0, _TILE - 0.04, 0)
        )
        rim = [
            box((x, y + a, HEIGHT - 0.015), (x + _TILE, y + a + 0.02, HEIGHT))
            for a in (0.0, _TILE - 0.02)
        ]
        rim += [
            box((x + a, y, HEIGHT - 0.015), (x + a + 0.02, y + _TILE, HEIGHT))
            for a in (0.0, _TILE - 0.02)
        ]
        parts += [
            Surface("ceiling lamp", cover, on if k in lit else off),
            Surface("lamp rim", join(rim), finishes.grey),
        ]
    return parts


def _fittings(finishes: Finishes) -> list[Surface]:
    """A cable duct with sockets, heating pipes, a smoke detector, switches, an air conditioner."""
    duct = box((0.0, 0.0, 0.86), (3.9, 0.06, 0.97), faces="netbw")
    sockets = [
        box((x - 0.04, 0.06, 0.875), (x + 0.04, 0.066, 0.955))
        for x in (0.6, 0.72, 1.7, 2.2, 2.32, 3.3)
    ]
    holes = [
        box((x + s - 0.006, 0.0655, 0.907), (x + s + 0.006, 0.067, 0.92))
        for x in (0.6, 0.72, 1.7, 2.2, 2.32, 3.3)
        for s in (-0.012, 0.012)
    ]
    pipes = [tube((0.03, 0.06, z), (4.97, 0.06, z), 0.02, 10) for z in (2.62, 2.7)]
    clamps = [box((x, 0.0, 2.58), (x + 0.02, 0.085, 2.74)) for x in (0.8, 2.2, 3.6)]
    detector = placed(
        lathe([(0.0, -0.045), (0.03, -0.045), (0.045, -0.03), (0.055, -0.028), (0.055, 0.0)], 18),
        (2.7, 1.95, HEIGHT),
    )
    switches = [
        box((LENGTH - 0.012, 2.28 + 0.09 * k, 1.05), (LENGTH, 2.36 + 0.09 * k, 1.13))
        for k in range(1)
    ]
    cooler = [
        box((0.0, 1.6, 2.35), (0.22, 2.5, 2.63)),
        box((0.22, 1.62, 2.37), (0.235, 2.48, 2.41)),
    ]
    slits = [box((0.2195, 1.65, z), (0.222, 2.45, z + 0.008)) for z in 2.46 + 0.025 * np.arange(5)]
    return [
        Surface("fittings", join([duct, *sockets, detector, *switches, *cooler]), finishes.ivory),
        Surface("fittings", join([*holes, *slits]), finishes.rubber),
        Surface("pipes", join([*pipes, *clamps]), finishes.metal),
    ]
