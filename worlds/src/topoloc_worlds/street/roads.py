"""The circuit itself: its centre line, asphalt with markings and wear, kerbs, pavements, puddles.

Places along the street are given by `station`, metres along the centre line in the direction of the
drive (counter-clockwise seen from above), and `offset`, metres to the right of it (outwards).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float64

from topoloc_worlds.noise import rng_of, smooth_noise
from topoloc_worlds.scene import Material, Mesh, Picture, Surface
from topoloc_worlds.shapes import join
from topoloc_worlds.street.textures import blotches, colored, crack, slabs

HALF_LENGTH, HALF_WIDTH, RADIUS = 164.75, 38.75, 10.25
"""The rounded rectangle of the centre line."""
LANE = 3.5
HALF_ROAD = 5.7
"""From the centre line to the kerb: a lane and a place to park."""
PAVEMENT = 5.85, 8.7
"""Offsets of its two edges."""
KERB = 0.12
_LONG, _SHORT, _ARC = 2 * (HALF_LENGTH - RADIUS), 2 * (HALF_WIDTH - RADIUS), RADIUS * np.pi / 2
LENGTH = 2 * (_LONG + _SHORT) + 4 * _ARC
_HALF = ((0.0, _LONG), (_LONG + _ARC, _LONG + _ARC + _SHORT))
SIDES = tuple((half + start, half + end) for half in (0.0, LENGTH / 2) for start, end in _HALF)
"""Stations where each of the four straight stretches begins and ends."""
_TEXEL = 0.016
_TILE_PX = (round(2 * HALF_ROAD / _TEXEL), 1000)
_NUM_PLAIN = 6


def centre_line(
    stations: Float64[np.ndarray, "n"],
) -> tuple[Float64[np.ndarray, "n 2"], Float64[np.ndarray, "n"]]:
    """Points (x, y) of the centre line and its direction there (radians from +x)."""
    s = np.mod(np.asarray(stations, dtype=np.float64), LENGTH)
    half = s >= LENGTH / 2
    s = np.where(half, s - LENGTH / 2, s)
    x0, y0, r = HALF_LENGTH, HALF_WIDTH, RADIUS
    first = np.clip((s - _LONG) / RADIUS, 0, np.pi / 2)
    second = np.clip((s - _LONG - _ARC - _SHORT) / RADIUS, 0, np.pi / 2)
    yaw = first + second
    x = -x0 + r + np.clip(s, 0, _LONG) + r * np.sin(first) - r * (1 - np.cos(second))
    y = -y0 + r * (1 - np.cos(first)) + np.clip(s - _LONG - _ARC, 0, _SHORT) + r * np.sin(second)
    sign = np.where(half, -1.0, 1.0)
    return np.column_stack([sign * x, sign * y]), yaw + np.pi * half


def position(station: float, offset: float) -> tuple[float, float, float]:
    """World (x, y) of a place, and the direction of the street there."""
    points, yaws = centre_line(np.array([station]))
    yaw = float(yaws[0])
    return (
        float(points[0, 0] + offset * np.sin(yaw)),
        float(points[0, 1] - offset * np.cos(yaw)),
        yaw,
    )


def sweep(
    stations: Float64[np.ndarray, "n"],
    u: Float64[np.ndarray, "n"],
    profile: Sequence[tuple[float, float, float]],
) -> Mesh:
    """A band along the street: the profile (offset, z, v), from left to right, drawn along the
    stations."""
    points, yaws = centre_line(stations)
    right = np.column_stack([np.sin(yaws), -np.cos(yaws)])
    n, k = len(points), len(profile)
    vertices = np.empty((n, k, 3))
    uv = np.empty((n, k, 2))
    for j, (offset, z, v) in enumerate(profile):
        vertices[:, j, :2] = points + offset * right
        vertices[:, j, 2] = z
        uv[:, j] = np.column_stack([u, np.full(n, v)])
    a = (np.arange(n - 1)[:, None] * k + np.arange(k - 1)[None, :]).ravel()
    faces = np.concatenate(
        [np.column_stack([a, a + 1, a + k + 1]), np.column_stack([a, a + k + 1, a + k])]
    )
    return Mesh(vertices.reshape(-1, 3), faces.astype(np.int32), uv.reshape(-1, 2))


@cache
def tiles() -> tuple[tuple[float, float], ...]:
    """The stretches of street that carry one picture of asphalt each: about 16 m, an arc is one."""
    result = []
    for (start, end), following in zip(
        SIDES, [*(side[0] for side in SIDES[1:]), LENGTH], strict=True
    ):
        cuts = np.linspace(start, end, round((end - start) / 16.0) + 1)
        result += list(pairwise(cuts.tolist()))
        result.append((end, float(following)))
    return tuple(result)


def crossings(seed: int) -> list[int]:
    """Indices of the tiles with a zebra crossing: at both ends of each straight stretch, and two
    within each long one."""
    all_tiles = tiles()
    rng = rng_of(seed, "crossings")
    found = []
    for start, end in SIDES:
        inside = [i for i, (a, b) in enumerate(all_tiles) if a >= start - 1e-6 and b <= end + 1e-6]
        found += [inside[0], inside[-1]] if len(inside) > 8 else [inside[len(inside) // 2]]
        found += (
            [inside[len(inside) * k // 3 + int(rng.integers(-1, 2))] for k in (1, 2)]
            if len(inside) > 8
            else []
        )
    return found


def roads(seed: int, wet: bool) -> list[Surface]:
    """Build asphalt, kerbs and pavements of the whole circuit, and puddles on wet ground."""
    rng = rng_of(seed, "roads")
    pictures = [_asphalt(rng, "plain") for _ in range(_NUM_PLAIN)] + [
        _asphalt(rng, "crossing"),
        _asphalt(rng, "arrows"),
    ]
    chosen = rng.integers(0, _NUM_PLAIN, len(tiles()))
    zebra = crossings(seed)
    chosen[zebra] = _NUM_PLAIN
    chosen[[i - 1 for i in zebra if i > 0 and not _is_arc(tiles()[i - 1][0])]] = _NUM_PLAIN + 1
    materials = [ground(picture, wet) for picture in pictures]
    profile = [
        (-HALF_ROAD, -0.03, 0.0),
        (-LANE, 0.01, 0.193),
        (0.0, 0.04, 0.5),
        (LANE, 0.01, 0.807),
        (HALF_ROAD, -0.03, 1.0),
    ]
    result = []
    for (start, end), kind in zip(tiles(), chosen.tolist(), strict=True):
        stations = np.linspace(start, end, 17 if end - start > 16.05 and _is_arc(start) else 2)
        flip = bool(rng.uniform() < 0.5) and kind < _NUM_PLAIN
        u = np.linspace(1.0, 0.0, len(stations)) if flip else np.linspace(0.0, 1.0, len(stations))
        turned = [(o, z, 1.0 - v) for o, z, v in profile] if flip else profile
        result.append(Surface("road", sweep(stations, u, turned), materials[kind]))
    result += _edges(rng, wet)
    return result + (_puddles(rng) if wet else [])


def ground(picture: Picture, wet: bool) -> Material:
    """Make the surface of roads and pavements: matt if dry. Water makes it darker and glossy."""
    if not wet:
        return Material("matt", picture)
    return Material("polished", (picture * 0.72).astype(np.uint8), roughness=0.14)


def _is_arc(station: float) -> bool:
    return any(abs(station - end) < 1e-6 for _, end in SIDES)


def _edges(rng: np.random.Generator, wet: bool) -> list[Surface]:
    kerb_picture = colored(
        (0.6, 0.59, 0.57),
        1.0 + 0.09 * smooth_noise(rng, (24, 512), 0.8) + 0.08 * blotches(rng, (24, 512), 40.0),
    )
    kerb_picture[:, ::128] = 70
    kerb = ground(kerb_picture, wet)
    tones = [(0.63, 0.62, 0.6), (0.6, 0.59, 0.58), (0.66, 0.62, 0.57), (0.56, 0.55, 0.55)]
    pavements = [
        ground(slabs(rng, (228, 640), (30, 40) if i < 3 else (14, 18), tone), wet)
        for i, tone in enumerate(tones)
    ]
    near, far = PAVEMENT
    result = []
    for start, end in tiles():
        stations = np.linspace(start, end, 17 if _is_arc(start) else 2)
        for side in (-1.0, 1.0):
            material = pavements[int(rng.integers(0, len(pavements)))]
            along = (stations - start) / 8.0 + float(rng.integers(0, 20)) / 20
            slope = [(near, KERB, 0.0), (far, KERB + 0.03, 1.0)]
            edge = [
                (HALF_ROAD, -0.03, 0.0),
                (HALF_ROAD, KERB - 0.01, 0.45),
                (HALF_ROAD + 0.015, KERB, 0.55),
                (near, KERB, 1.0),
            ]
            for name, line, what, u in (
                ("pavement", slope, material, along),
                ("kerb", edge, kerb, stations / 4.0),
            ):
                profile = line if side > 0 else [(-o, z, v) for o, z, v in reversed(line)]
                result.append(Surface(name, sweep(stations, u, profile), what))
    return result


def _asphalt(rng: np.random.Generator, kind: str) -> Picture:
    """One picture of the whole width, left kerb on top; 16 m."""
    h, w = _TILE_PX
    value = (
        1.0
        + 0.075 * smooth_noise(rng, (h, w), 0.6)
        + 0.02 * smooth_noise(rng, (h, w), 2.0)
        + 0.05 * blotches(rng, (h, w), 90.0)
    )
    offsets = (np.arange(h) + 0.5) * _TEXEL - HALF_ROAD
    for lane in (-LANE / 2, LANE / 2):
        value *= 1.0 - 0.10 * np.exp(-(((offsets - lane) / 0.3) ** 2))[:, None] * (
            1.0 + 0.4 * blotches(rng, (h, w), 60.0)
        )
        for wheel in (-0.75, 0.75):
            value *= 1.0 + 0.06 * np.exp(-(((offsets - lane - wheel) / 0.25) ** 2))[:, None]
    value[np.abs(offsets) > LANE] *= (
        0.93 + 0.04 * blotches(rng, (h, w), 50.0)[np.abs(offsets) > LANE]
    )
    _repairs(rng, value)
    picture = colored((0.355, 0.355, 0.36), value)
    gutter = np.abs(offsets) > HALF_ROAD - 0.32
    setts = colored((0.5, 0.49, 0.47), 1.0 + 0.12 * smooth_noise(rng, (h, w), 1.0))
    setts[:, ::14] = 60
    picture[gutter] = setts[gutter]
    paint = _markings(kind)
    wear = smooth_noise(rng, (h, w), 1.3) + 0.9 * blotches(rng, (h, w), 40.0)
    solid = paint * np.clip(2.2 - wear, 0.05, 0.92)[..., None]
    white = (
        np.array([215, 214, 208], np.float32)
        * (0.92 + 0.05 * smooth_noise(rng, (h, w), 1.0))[..., None]
    )
    result = picture * (1.0 - solid) + white * solid
    _covers(rng, result)
    return np.clip(result, 0, 255).astype(np.uint8)


def _repairs(rng: np.random.Generator, value: np.ndarray) -> None:
    """Patches of newer asphalt, trenches across, cracks, cracks filled with tar, spots of oil."""
    h, w = value.shape
    for _ in range(rng.integers(1, 4)):
        x, y = int(rng.integers(0, w)), int(rng.integers(0, h))
        size = (int(rng.integers(60, 260)), int(rng.integers(40, 150)))
        tone = float(rng.choice([0.72, 0.82, 1.14]))
        value[y : y + size[1], x : x + size[0]] = tone * (
            1.0 + 0.8 * (value[y : y + size[1], x : x + size[0]] - 1.0)
        )
        cv2.rectangle(value, (x, y), (x + size[0], y + size[1]), 0.55, 2)
    if rng.uniform() < 0.5:
        x = int(rng.integers(0, w - 70))
        value[:, x : x + 55] *= 0.8
        cv2.line(value, (x, 0), (x, h), 0.55, 2)
        cv2.line(value, (x + 55, 0), (x + 55, h), 0.55, 2)
    for _ in range(rng.integers(4, 10)):
        cv2.polylines(
            value, [crack(rng, (h, w), int(rng.integers(30, 200)))], False, 0.5, 1, cv2.LINE_AA
        )
    for _ in range(rng.integers(1, 4)):
        cv2.polylines(
            value, [crack(rng, (h, w), int(rng.integers(60, 220)))], False, 0.6, 4, cv2.LINE_AA
        )
    for _ in range(rng.integers(3, 9)):
        spot = np.zeros((h, w), np.float32)
        row = int((rng.choice([-4.6, -1.75, 1.75, 4.6]) + HALF_ROAD + rng.normal(0, 0.25)) / _TEXEL)
        cv2.ellipse(
            spot,
            (int(rng.integers(0, w)), row),
            (int(rng.integers(8, 30)), int(rng.integers(5, 16))),
            0,
            0,
            360,
            0.3,
            -1,
        )
        value *= 1.0 - cv2.GaussianBlur(spot, (0, 0), 4)


def _markings(kind: str) -> np.ndarray:
    """Return a mask of white paint, as (h, w, 1)."""
    h, w = _TILE_PX
    paint = np.zeros((h, w), np.float32)

    def stripe(x0: float, x1: float, o0: float, o1: float) -> None:
        low, high = (
            (round(x0 / _TEXEL), round((o0 + HALF_ROAD) / _TEXEL)),
            (round(x1 / _TEXEL), round((o1 + HALF_ROAD) / _TEXEL)),
        )
        cv2.rectangle(paint, low, high, 1.0, -1)

    for x in (1.0, 9.0) if kind != "crossing" else ():
        stripe(x, x + 4.0, -0.07, 0.07)
    for side in (-1.0, 1.0):
        edge, far = side * LANE, side * (LANE + 0.45)
        for x in np.arange(0.0, 16.0, 5.34) if kind != "crossing" else (0.0, 15.8):
            stripe(x, x + 0.1, min(edge, far), max(edge, far))
            stripe(x - 0.5, x + 0.6, edge - 0.05, edge + 0.05)
    if kind == "crossing":
        for offset in np.arange(-5.2, 5.0, 1.0):
            stripe(6.2, 9.8, offset, offset + 0.5)
        stripe(4.6, 5.0, 0.2, LANE)
        stripe(11.0, 11.4, -LANE, -0.2)
    if kind == "arrows":
        for centre, way in ((LANE / 2, 1.0), (-LANE / 2, -1.0)):
            middle = 8.0
            stripe(middle - 1.6, middle + 1.2, centre - 0.08, centre + 0.08)
            tip = np.array(
                [
                    [middle + way * 2.3, centre],
                    [middle + way * 1.0, centre - 0.42],
                    [middle + way * 1.0, centre + 0.42],
                ]
            )
            cv2.fillPoly(
                paint, [np.round((tip + np.array([0.0, HALF_ROAD])) / _TEXEL).astype(np.int32)], 1.0
            )
    return cv2.GaussianBlur(paint, (0, 0), 0.6)[..., None]


def _covers(rng: np.random.Generator, picture: np.ndarray) -> None:
    """Manholes with their pattern, a drain in each gutter, small lids of valves."""
    h, w = picture.shape[:2]
    for offset in rng.choice([-1.9, -0.5, 0.9, 2.3], int(rng.integers(1, 3)), replace=False):
        x, y, r = int(rng.integers(60, w - 60)), int((offset + HALF_ROAD) / _TEXEL), 21
        cv2.circle(picture, (x, y), r + 3, (58.0, 58.0, 56.0), -1, cv2.LINE_AA)
        cv2.circle(picture, (x, y), r, (96.0, 92.0, 86.0), -1, cv2.LINE_AA)
        for k in range(-18, 19, 6):
            reach = int(np.sqrt(r * r - k * k)) - 2
            cv2.line(picture, (x - reach, y + k), (x + reach, y + k), (54.0, 52.0, 50.0), 1)
            cv2.line(picture, (x + k, y - reach), (x + k, y + reach), (54.0, 52.0, 50.0), 1)
    for offset in (-HALF_ROAD + 0.2, HALF_ROAD - 0.2):
        x, y = int(rng.integers(60, w - 60)), int((offset + HALF_ROAD) / _TEXEL)
        cv2.rectangle(picture, (x - 16, y - 10), (x + 16, y + 9), (70.0, 68.0, 66.0), -1)
        for k in range(-13, 14, 5):
            cv2.line(picture, (x + k, y - 7), (x + k, y + 6), (15.0, 15.0, 15.0), 2)
    for _ in range(rng.integers(0, 3)):
        x, y = int(rng.integers(20, w - 20)), int(rng.integers(60, h - 60))
        cv2.rectangle(picture, (x, y), (x + 11, y + 9), (72.0, 70.0, 68.0), -1)
        cv2.rectangle(picture, (x, y), (x + 11, y + 9), (40.0, 40.0, 40.0), 1)


def _puddles(rng: np.random.Generator) -> list[Surface]:
    """Standing water in the gutters and in the tracks of the wheels: thin irregular mirrors just
    above the asphalt."""
    water = Material("polished", (0.13, 0.13, 0.13), roughness=0.01)
    meshes = []
    for _ in range(420):
        in_gutter = rng.uniform() < 0.55
        side = rng.choice([-1.0, 1.0])
        offset = (
            side * (HALF_ROAD - 0.55)
            if in_gutter
            else side * (LANE / 2 + rng.choice([-0.75, 0.75]))
        )
        reach = (
            (rng.uniform(0.8, 4.0), rng.uniform(0.2, 0.5))
            if in_gutter
            else (rng.uniform(0.4, 2.2), rng.uniform(0.12, 0.35))
        )
        meshes.append(_blob(rng, rng.uniform(0.0, LENGTH), offset, reach))
    return [Surface("puddle", join(meshes), water)]


def _blob(
    rng: np.random.Generator, station: float, offset: float, reach: tuple[float, float]
) -> Mesh:
    angles = np.linspace(0.0, 2 * np.pi, 28, endpoint=False)
    ring = 1.0 + sum(
        rng.uniform(0.0, 0.5 / k) * np.cos(k * angles + rng.uniform(0, 2 * np.pi))
        for k in range(2, 7)
    )
    stations, offsets = (
        station + reach[0] * ring * np.cos(angles),
        offset + reach[1] * ring * np.sin(angles),
    )
    stations, offsets = np.append(stations, station), np.append(offsets, offset)
    points, yaws = centre_line(stations)
    xy = points + offsets[:, None] * np.column_stack([np.sin(yaws), -np.cos(yaws)])
    heights = np.interp(np.abs(offsets), [0.0, LANE, HALF_ROAD], [0.04, 0.01, -0.03]).max() + 0.002
    i = np.arange(28)
    faces = np.column_stack([np.full(28, 28), (i + 1) % 28, i]).astype(np.int32)
    return Mesh(np.column_stack([xy, np.full(29, heights)]), faces, np.zeros((29, 2)))
