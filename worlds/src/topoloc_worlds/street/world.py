"""World "street": a circuit of town streets about 800 m round, within the paper's 333 by 81 m
(section IV-D, there made by CARLA).

Traffic keeps to the right and the loop is driven counter-clockwise, seen from above; its lane is
the outer one of two.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np

from topoloc_worlds.conditions import Condition
from topoloc_worlds.noise import rng_of
from topoloc_worlds.scene import Haze, Mesh, Scene, Sky, Surface
from topoloc_worlds.shapes import tube
from topoloc_worlds.skies import sky_of
from topoloc_worlds.street.facade_parts import set_at
from topoloc_worlds.street.fronts import fronts
from topoloc_worlds.street.furniture import (
    FurnitureMaterials,
    advertising_pillar,
    bin_of,
    bus_stop,
    furniture_materials,
    lamp_post,
    small_thing,
    traffic_light,
    traffic_sign,
)
from topoloc_worlds.street.materials import StreetMaterials, street_materials
from topoloc_worlds.street.roads import (
    HALF_LENGTH,
    HALF_WIDTH,
    KERB,
    LANE,
    LENGTH,
    PAVEMENT,
    RADIUS,
    SIDES,
    centre_line,
    crossings,
    position,
    roads,
    tiles,
)
from topoloc_worlds.street.trees import tree
from topoloc_worlds.street.vehicles import PAINTS, SHAPES, car, car_materials, parked

CAMERA_HEIGHT = 1.6
OTHER_LANE_OFFSET = 3.5
"""Metres to the left of LOOP: the other lane."""


def _driven_line() -> tuple[tuple[float, float], ...]:
    arcs = [np.linspace(end, end + RADIUS * np.pi / 2, 17) for _, end in SIDES]
    points, yaws = centre_line(np.concatenate(arcs))
    points = points + LANE / 2 * np.column_stack([np.sin(yaws), -np.cos(yaws)])
    return tuple((float(x), float(y)) for x, y in points)


LOOP = _driven_line()
"""Centre line of the right-hand lane: a rectangle of 333 by 81 m, rounded with 12 m."""


def build(seed: int, condition: Condition, arrangement: int = 0) -> Scene:
    """Build the street.

    Args:
        seed: seed of the town.
        condition: light and weather. It moves no object.
        arrangement: seed of the positions of parked cars and bins.
    """
    kit = street_materials(seed, condition)
    things = furniture_materials(rng_of(seed, "street/furniture"))
    surfaces = roads(seed, condition.wet)
    surfaces += fronts(seed, kit, things)
    kept = _kept_free(seed)
    surfaces += _pavements(seed, kept, kit, things)
    surfaces += _corners(seed, kit, things, surfaces)
    surfaces += _cars(seed, kept, arrangement) + _bins(seed, kept, arrangement, kit, things)
    sky = sky_of(condition, seed)
    haze = Haze(condition.visibility, _horizon(sky)) if isfinite(condition.visibility) else None
    return Scene(tuple(surfaces), sky, haze)


def _horizon(sky: Sky) -> tuple[float, float, float]:
    """Mean light from just above the horizon, which is the colour of distant air."""
    h = len(sky.radiance)
    r, g, b = sky.radiance[h * 7 // 16 : h // 2].mean(axis=(0, 1)).tolist()
    return r, g, b


def _beside(
    surfaces: list[Surface], station: float, offset: float, height: float = KERB
) -> list[Surface]:
    """Things made for the right-hand side, set there or, turned round, to the left of the
    street."""
    x, y, yaw = position(station, offset)
    return set_at(surfaces, (x, y, height), yaw if offset > 0 else yaw + np.pi)


@dataclass(frozen=True)
class _KeptFree:
    """Return the places without parked cars: stations of zebra crossings, from and to; stations and
    sides (+1 is right) of bus stops."""

    zebras: tuple[tuple[float, float], ...]
    bus_stops: tuple[tuple[float, float], ...]

    def allows(self, station: float, side: float, margin: float) -> bool:
        """Whether a thing within `margin` metres of a station disturbs neither."""
        at_zebra = any(start - margin < station < end + margin for start, end in self.zebras)
        return not at_zebra and not any(
            side == way and abs(station - stop) < 7.0 + margin for stop, way in self.bus_stops
        )


def _kept_free(seed: int) -> _KeptFree:
    rng = rng_of(seed, "bus stops")
    stops = [
        (start + (end - start) * float(rng.uniform(0.2, 0.8)), side)
        for start, end in (SIDES[0], SIDES[2])
        for side in (1.0, -1.0)
    ]
    made = tiles()
    return _KeptFree(tuple(made[i] for i in crossings(seed)), tuple(stops))


def _pavements(
    seed: int, kept: _KeptFree, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    """Lamps, trees, signs and the rest along the kerbs, shelters, traffic lights at crossings,
    wires overhead."""
    rng = rng_of(seed, "pavements")
    edge = PAVEMENT[0] + 0.45
    result: list[Surface] = []
    count = 0
    for start, end in SIDES:
        for side in (1.0, -1.0):
            leafy = False
            for k, station in enumerate(np.arange(start + 3.0, end - 2.0, 5.6).tolist()):
                if k % 9 == 0:
                    leafy = bool(rng.uniform() < 0.55)
                luck, lamp_luck = rng.uniform(), rng.uniform()
                own = rng_of(seed, f"kerb/{count}")
                count += 1
                if k % 6 == (0 if side > 0 else 3):
                    result += _beside(
                        lamp_post(bool(lamp_luck < kit.lit), kit), station, side * edge
                    )
                elif not kept.allows(station, side, -2.0):
                    continue
                elif leafy and k % 2:
                    result += _beside(
                        tree(own, kit, float(own.uniform(5.5, 8.5)), float(own.uniform(1.7, 2.4))),
                        station,
                        side * (edge + 0.3),
                    )
                elif luck < 0.17:
                    result += _beside(traffic_sign(own, kit, things), station, side * edge)
                elif luck < 0.42:
                    result += _beside(small_thing(own, kit, things), station, side * (edge + 0.1))
    for station, side in kept.bus_stops:
        result += _beside(bus_stop(rng, kit, things), station, side * 7.5)
    for start, end in kept.zebras:
        middle = (start + end) / 2
        result += _beside(traffic_light(kit, things), middle + 3.2, edge) + _beside(
            traffic_light(kit, things), middle - 3.2, -edge
        )
    return result + _wires(rng, kit)


def _wires(rng: np.random.Generator, kit: StreetMaterials) -> list[Surface]:
    result = []
    for station in rng.uniform(0.0, LENGTH, 14).tolist():
        ends = [position(station, side * 8.7)[:2] for side in (-1.0, 1.0)]
        middle = (*((np.array(ends[0]) + ends[1]) / 2).tolist(), 7.3)
        result += [Surface("wire", tube((*at, 7.9), middle, 0.014, 4), kit.iron) for at in ends]
    return result


def _corners(
    seed: int, kit: StreetMaterials, things: FurnitureMaterials, made: list[Surface]
) -> list[Surface]:
    """The open ground outside each bend: paving, a pillar, trees."""
    rng = rng_of(seed, "corners")
    paving = next(surface.material for surface in made if surface.name == "pavement")
    result = []
    for (_, end), (sx, sy) in zip(SIDES, ((1, -1), (1, 1), (-1, 1), (-1, -1)), strict=True):
        corner = np.array([sx * (HALF_LENGTH + PAVEMENT[1]), sy * (HALF_WIDTH + PAVEMENT[1])])
        points, yaws = centre_line(np.linspace(end, end + RADIUS * np.pi / 2, 17))
        arc = points + PAVEMENT[1] * np.column_stack([np.sin(yaws), -np.cos(yaws)])
        outline = np.concatenate([[corner], arc])
        faces = np.array([[0, i, i + 1] for i in range(1, 17)], np.int32)
        vertices = np.column_stack([outline, np.full(18, KERB + 0.03)])
        result.append(Surface("pavement", Mesh(vertices, faces, outline / [8.0, 2.85]), paving))
        middle = end + RADIUS * np.pi / 4
        result += _beside(advertising_pillar(rng, kit, things), middle, 10.3)
        result += _beside(tree(rng, kit, 7.0, 2.2), middle - 4.0, 7.2) + _beside(
            tree(rng, kit, 6.5, 2.0), middle + 4.0, 7.2
        )
    return result


def _cars(seed: int, kept: _KeptFree, arrangement: int) -> list[Surface]:
    """Both edges of the street full of parked cars, with gaps; each heads the way its side
    drives."""
    kit = car_materials(rng_of(seed, "car materials"))
    rng = rng_of(seed, f"cars/{arrangement}")
    result = []
    for start, end in SIDES:
        for side in (1.0, -1.0):
            crowd, station = 0.6, start + 4.0
            while station < end - 4.0:
                shape = SHAPES[int(rng.choice(len(SHAPES), p=[0.3, 0.22, 0.2, 0.18, 0.1]))]
                paint, plate = int(rng.integers(0, len(PAINTS))), int(rng.integers(0, 24))
                crowd = float(np.clip(crowd + rng.normal(0.0, 0.2), 0.25, 0.85))
                offset, askew = (
                    side * (4.68 + float(rng.uniform(-0.06, 0.08))),
                    float(rng.normal(0.0, 0.015)),
                )
                if rng.uniform() < crowd and kept.allows(station, side, 0.0):
                    x, y, yaw = position(station, offset)
                    result += parked(
                        car(shape, paint, plate, kit),
                        (x, y, -0.015),
                        yaw + askew + (0.0 if side > 0 else np.pi),
                    )
                station += 5.4 + float(rng.exponential(0.5))
    return result


def _bins(
    seed: int, kept: _KeptFree, arrangement: int, kit: StreetMaterials, things: FurnitureMaterials
) -> list[Surface]:
    rng = rng_of(seed, f"bins/{arrangement}")
    result = []
    for _ in range(45):
        start, end = SIDES[int(rng.choice(4, p=[0.42, 0.08, 0.42, 0.08]))]
        station, side = float(rng.uniform(start + 3, end - 5)), float(rng.choice([-1.0, 1.0]))
        for k in range(int(rng.integers(1, 4))):
            if kept.allows(station, side, 0.0):
                result += _beside(bin_of(rng, kit, things), station + 0.7 * k, side * 8.05)
    return result
