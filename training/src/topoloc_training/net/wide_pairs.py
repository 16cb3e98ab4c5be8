"""Draw batches of two views of the same points on any device: copies of a picture, and rendered
pictures of one place from elsewhere, to the side and in other light (`wide_views.py`).

Points of rendered pairs are exact: depth and poses are the truth, and hidden points are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Generator, Tensor
from torch.nn import functional

from topoloc_training.net.batch_light import Draws, change_light
from topoloc_training.net.looks import (
    HEIGHT,
    VIEW_HEIGHT,
    VIEW_WIDTH,
    WIDTH,
    crops_around,
    draw_homographies,
    draw_rolls,
    from_source,
    is_within,
    moved_by,
    nudged,
    shift_of_rows,
    source_grid,
)
from topoloc_training.net.losses import sampled
from topoloc_training.net.stored_depth import FIRST as DEPTH_FIRST, STEP as DEPTH_STEP

NUM_POINTS = 384
STRIDE = 4
_FOCAL, _CENTRE = 380.0, (319.5, 199.5)
_EDGE = 6
_NEAR = 8.0
_SLACK = 0.02
_FEWEST = 400
_ANGLES_DEG = (12.0, 30.0, 50.0, 75.0, 180.0)
_SHARES = (0.25, 0.25, 0.25, 0.2, 0.05)
_TAUGHT_DEG = 30.0  # the second view of wider pairs has no descriptors of the teacher


@dataclass(frozen=True, eq=False)
class Library:
    """Hold pictures, the teacher's answers, and depth (metres, 0: none) and poses if rendered."""

    pictures: UInt8[Tensor, "n 1 384 640"]
    scores: Float[Tensor, "n 1 384 640"]
    descriptors: Float[Tensor, "n 64 96 160"]
    depth: Float[Tensor, "n 1 96 160"]
    world_from_cam: Float[Tensor, "n 4 4"]
    shares: Float[Tensor, " n"]
    """How often a picture is drawn as copies of itself."""


@dataclass(frozen=True, eq=False)
class KnownPairs:
    """Hold the pictures (n, 2) of the pairs, their angle, and how often they are drawn."""

    rows: Int[Tensor, "n 2"]
    angles_deg: Float[Tensor, " n"]
    shares: Float[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Batch:
    """Two views, scores and points of b samples; the first b rows are the first views.

    `taught` are the teacher's descriptors of the points in the first picture; `is_like` says
    whether the teacher's descriptors are also those of the view.
    """

    views: Float[Tensor, "b2 1 h w"]
    scores: Float[Tensor, "b2 1 h w"]
    inside: Bool[Tensor, "b2 1 h w"]
    points: Float[Tensor, "b2 n 2"]
    valid: Bool[Tensor, "b2 n"]
    taught: Float[Tensor, "b n 64"]
    near: Bool[Tensor, "b n n"]
    is_like: Bool[Tensor, " b2"]


def grid_pixels(device: torch.device) -> Float[Tensor, "m 2"]:
    """Return the pixels whose depth is known."""
    rows, columns = torch.meshgrid(
        torch.arange(HEIGHT // DEPTH_STEP, device=device),
        torch.arange(WIDTH // DEPTH_STEP, device=device),
        indexing="ij",
    )
    return torch.stack([columns, rows], -1).reshape(-1, 2) * DEPTH_STEP + float(DEPTH_FIRST)


def project(
    library: Library, first: Int[Tensor, " b"], second: Int[Tensor, " b"]
) -> tuple[Float[Tensor, "b m 2"], Bool[Tensor, "b m"]]:
    """Return where the second pictures see the grid pixels of the first, and whether they do."""
    pixels, depth = grid_pixels(first.device), library.depth[first].flatten(1)
    centre = pixels.new_tensor(_CENTRE)
    rays = torch.cat([(pixels - centre) / _FOCAL, torch.ones_like(pixels[:, :1])], 1)
    moved = torch.linalg.inv(library.world_from_cam[second]) @ library.world_from_cam[first]
    points = (rays * depth[..., None]) @ moved[:, :3, :3].mT + moved[:, None, :3, 3]
    z = points[..., 2].clamp(min=1e-3)
    at = points[..., :2] / z[..., None] * _FOCAL + centre
    inverse = torch.where(library.depth[second] > 0, 1 / library.depth[second].clamp(min=1e-3), 0.0)
    size = pixels.new_tensor([WIDTH, HEIGHT]) / DEPTH_STEP
    place = (2 * (at - DEPTH_FIRST) / DEPTH_STEP + 1) / size - 1
    shown = functional.grid_sample(inverse, place[:, :, None].clamp(-2, 2), align_corners=False)
    inside = ((at > 2) & (at < pixels.new_tensor([WIDTH - 3, HEIGHT - 3]))).all(2)
    is_same = (shown[:, 0, :, 0] * z - 1).abs() < _SLACK
    return at, inside & is_same & (depth > 0) & (points[..., 2] > 0.1)


def find_pairs(
    library: Library, places: Int[Tensor, " n"], lights: Int[Tensor, " n"]
) -> KnownPairs:
    """Return the pairs of one place that share points, each group of angle and light as often as
    the others. `places` is -1 without depth; the day is light 0 and comes first."""
    found, angles, groups = [], [], []
    for i in range(len(places)):
        others = torch.nonzero((places == places[i]) & (lights >= lights[i])).flatten()
        others = others[others != i]
        if places[i] < 0 or not len(others):
            continue
        visible = project(library, torch.full_like(others, i), others)[1].sum(1)
        others = others[visible >= _FEWEST]
        axes = library.world_from_cam[:, :3, 2]
        angle = torch.rad2deg(torch.arccos((axes[others] @ axes[i]).clamp(-1, 1)))
        found.append(torch.stack([torch.full_like(others, i), others], 1))
        angles.append(angle)
        group = torch.bucketize(angle, angle.new_tensor(_ANGLES_DEG))
        groups.append(2 * group + (lights[others] != lights[i]))
    group = torch.cat(groups)
    shares = torch.repeat_interleave(group.new_tensor(_SHARES, dtype=torch.float32), 2)
    counts = torch.bincount(group, minlength=len(shares)).clamp(min=1)
    return KnownPairs(torch.cat(found), torch.cat(angles), (shares / counts)[group])


def draw_batch(
    library: Library, pairs: KnownPairs, count: int, num_pairs: int, generator: Generator
) -> Batch:
    """Return `count` samples, the first `num_pairs` of them rendered pairs."""
    drawn = torch.multinomial(pairs.shares, num_pairs, replacement=True, generator=generator)
    parts = list[_Looks]()
    if num_pairs:
        parts.append(_of_pairs(library, pairs, drawn, generator))
    if count > num_pairs:
        rows = torch.multinomial(library.shares, count - num_pairs, True, generator=generator)
        parts.append(_of_copies(library, rows, generator))
    first, second, here, there, source, points, strengths, is_like, is_exact = (
        torch.cat([getattr(part, name) for part in parts]) for name in _Looks.__annotations__
    )
    rolls = draw_rolls(Draws(generator, count))
    rolls = torch.where(is_exact[:, None, None, None], torch.zeros_like(rolls), rolls)
    rows, homographies = torch.cat([first, second]), torch.cat([here, there])
    rolls = torch.cat([torch.zeros_like(rolls), rolls])
    points = torch.cat([points, from_source(there, points_of_second(parts))])
    points = torch.stack([points[..., 0] - shift_of_rows(rolls, points[..., 1]), points[..., 1]], 2)
    grid = source_grid(homographies, rolls)
    shown = functional.grid_sample(
        library.pictures[rows].float() / 255, grid, padding_mode="reflection", align_corners=False
    )
    scores = functional.grid_sample(library.scores[rows].float(), grid, align_corners=False)
    inside = (grid.abs() <= 1).all(-1)[:, None] & torch.cat(
        [torch.ones_like(is_exact), is_exact]
    ).view(-1, 1, 1, 1)
    other = points[len(source) :]
    near = (torch.cdist(source, source) < _NEAR) | (torch.cdist(other, other) < _NEAR)
    near &= ~torch.eye(near.shape[1], dtype=torch.bool, device=near.device)
    known = is_within(source, WIDTH, HEIGHT, 0).repeat(2, 1)
    valid = is_within(points, VIEW_WIDTH, VIEW_HEIGHT, _EDGE) & known
    views = change_light(shown, torch.cat([strengths[:, 0], strengths[:, 1]]), generator)
    taught = sampled(library.descriptors[first].float(), source, STRIDE)
    is_like = torch.cat([torch.ones_like(is_like), is_like])
    return Batch(views, scores, inside, points, valid, taught, near, is_like)


@dataclass(frozen=True, eq=False)
class _Looks:
    """Rows of the pictures, source pixels from those of each view, the points' pixels in the first
    picture and in its view."""

    first: Int[Tensor, " b"]
    second: Int[Tensor, " b"]
    here: Float[Tensor, "b 3 3"]
    there: Float[Tensor, "b 3 3"]
    source: Float[Tensor, "b n 2"]
    points: Float[Tensor, "b n 2"]
    strengths: Float[Tensor, "b 2"]
    is_like: Bool[Tensor, " b"]
    is_exact: Bool[Tensor, " b"]


@dataclass(frozen=True, eq=False)
class _PairLooks(_Looks):
    source_second: Float[Tensor, "b n 2"]


def points_of_second(parts: list[_Looks]) -> Float[Tensor, "b n 2"]:
    """Return the points' pixels in the second pictures, which copies share with the first."""
    return torch.cat([getattr(part, "source_second", part.source) for part in parts])


def _of_pairs(
    library: Library, pairs: KnownPairs, drawn: Int[Tensor, " b"], generator: Generator
) -> _PairLooks:
    first, second = pairs.rows[drawn].unbind(1)
    pixels = grid_pixels(first.device)[None].expand(len(drawn), -1, -1)
    at, visible = project(library, first, second)
    weights = (_told(library, first, pixels) + _told(library, second, at) + 0.02) * visible
    middle = torch.multinomial(weights, 1, generator=generator)[..., None].expand(-1, -1, 2)
    here = crops_around(pixels.gather(1, middle)[:, 0])
    there = crops_around(at.gather(1, middle)[:, 0])
    draws = Draws(generator, len(drawn))
    is_exact = draws.flags(0.6).flatten()
    there = torch.where(is_exact[:, None, None], there, nudged(there, draws, 0.5))
    both = is_within(from_source(here, pixels), VIEW_WIDTH, VIEW_HEIGHT, _EDGE)
    both &= is_within(from_source(there, at), VIEW_WIDTH, VIEW_HEIGHT, _EDGE)
    chosen = torch.multinomial(weights * both + 1e-9, NUM_POINTS, True, generator=generator)
    chosen = chosen[..., None].expand(-1, -1, 2)
    source, other = pixels.gather(1, chosen), at.gather(1, chosen)
    seen = visible.gather(1, chosen[..., 0])[..., None]
    other = torch.where(seen, other, torch.full_like(other, -1e4))  # outside: not valid
    strengths = draws.uniform(0.0, 0.6, 2)[..., 0, 0]
    is_like = pairs.angles_deg[drawn] < _TAUGHT_DEG
    points = from_source(here, source)
    return _PairLooks(
        first, second, here, there, source, points, strengths, is_like, is_exact, other
    )


def _of_copies(library: Library, rows: Int[Tensor, " b"], generator: Generator) -> _Looks:
    draws, count = Draws(generator, len(rows)), len(rows)
    size = library.pictures.new_tensor([WIDTH, HEIGHT], dtype=torch.float32)
    here = crops_around(size * draws.uniform(0.25, 0.75, 2)[..., 0, 0])
    there = nudged(here @ draw_homographies(draws), draws, 1.0)
    scores = library.scores[rows]
    grid = source_grid(here, torch.zeros(count, 1, 1, 4, device=rows.device))
    seen = functional.grid_sample(scores.float(), grid, align_corners=False)
    seen = seen * _interior(seen) + 1e-7
    chosen = torch.multinomial(seen.flatten(1), NUM_POINTS, True, generator=generator)
    points = torch.stack([chosen % VIEW_WIDTH, chosen // VIEW_WIDTH], 2).float()
    points = points + draws.uniform(-0.5, 0.5, 2 * NUM_POINTS).reshape(count, NUM_POINTS, 2)
    anywhere = draws.uniform(0.0, 1.0, 2 * (NUM_POINTS // 3)).reshape(count, -1, 2)
    view = size.new_tensor([VIEW_WIDTH, VIEW_HEIGHT])
    points = torch.cat([_EDGE + anywhere * (view - 2 * _EDGE), points[:, anywhere.shape[1] :]], 1)
    clean = draws.flags(0.3)[:, 0, 0] * 1.0
    strengths = draws.uniform(0.0, 1.0, 2)[..., 0, 0]
    strengths = torch.cat([strengths[:, :1] * (1 - clean), 0.3 + 0.7 * strengths[:, 1:]], 1)
    no, yes = torch.zeros_like(rows, dtype=torch.bool), torch.ones_like(rows, dtype=torch.bool)
    return _Looks(rows, rows, here, there, moved_by(here, points), points, strengths, yes, no)


def _told(
    library: Library, rows: Int[Tensor, " b"], pixels: Float[Tensor, "b m 2"]
) -> Float[Tensor, "b m"]:
    """Return the highest score of the teacher within two pixels."""
    scores = functional.max_pool2d(library.scores[rows].float(), 5, 1, 2)
    place = (2 * pixels + 1) / pixels.new_tensor([WIDTH, HEIGHT]) - 1
    return functional.grid_sample(scores, place[:, :, None].clamp(-2, 2), align_corners=False)[
        :, 0, :, 0
    ]


def _interior(pictures: Tensor) -> Tensor:
    inner = torch.zeros_like(pictures[:1])
    inner[..., _EDGE:-_EDGE, _EDGE:-_EDGE] = 1.0
    return inner
