"""Views of a picture on any device: crops, homographies and rolling shutters, and where points lie.

A homography (3, 3) gives the pixel of the picture for a pixel of the view.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from topoloc_training.net.batch_light import Draws

WIDTH, HEIGHT = 640, 384
VIEW_WIDTH, VIEW_HEIGHT = 320, 256


def crops_around(middle: Float[Tensor, "b 2"]) -> Float[Tensor, "b 3 3"]:
    """Return whole pixels of the source: only there are the teacher's scores exact."""
    view, size = middle.new_tensor([VIEW_WIDTH, VIEW_HEIGHT]), middle.new_tensor([WIDTH, HEIGHT])
    corner = torch.minimum((middle - view / 2).round().clamp(min=0), size - view)
    crops = torch.eye(3, device=middle.device).repeat(len(middle), 1, 1)
    crops[:, :2, 2] = corner
    return crops


def draw_homographies(draws: Draws) -> Float[Tensor, "b 3 3"]:
    """Return turns by 10 degrees, scales by a quarter, and bends, around the middle of a view."""
    normal = draws.normal(4)
    angle, scale = math.radians(9.6) * normal[:, 0], torch.exp(0.05 + 0.24 * normal[:, 1])
    turn = torch.zeros(draws.count, 3, 3, device=normal.device)
    turn[:, 0, 0] = turn[:, 1, 1] = scale * torch.cos(angle)
    turn[:, 1, 0] = scale * torch.sin(angle)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turn[:, 2, :2], turn[:, 2, 2] = 2.4e-4 * normal[:, 2:], 1.0
    middle = torch.eye(3, device=normal.device)
    middle[:2, 2] = normal.new_tensor([(VIEW_WIDTH - 1) / 2, (VIEW_HEIGHT - 1) / 2])
    return middle @ turn @ torch.linalg.inv(middle)


def nudged(places: Float[Tensor, "b 3 3"], draws: Draws, size: float) -> Float[Tensor, "b 3 3"]:
    """Return other looks at about the same: corners of a view move by up to a sixth of its size."""
    view = places.new_tensor([VIEW_WIDTH, VIEW_HEIGHT])
    corners = places.new_tensor([[0, 0], [1, 0], [1, 1], [0, 1]]) * view
    shift = draws.uniform(-size / 6, size / 6, 8).reshape(-1, 4, 2) * view
    x, y = corners.expand_as(shift).unbind(2)
    to_x, to_y = (corners + shift).unbind(2)
    one, no = torch.ones_like(x), torch.zeros_like(x)
    rows = [
        torch.stack([x, y, one, no, no, no, -to_x * x, -to_x * y], 2),
        torch.stack([no, no, no, x, y, one, -to_y * x, -to_y * y], 2),
    ]
    solved = torch.linalg.solve(torch.cat(rows, 1), torch.cat([to_x, to_y], 1))
    solved = torch.cat([solved, torch.ones_like(solved[:, :1])], 1)
    return places @ solved.reshape(-1, 3, 3)


def draw_rolls(draws: Draws) -> Float[Tensor, "b 1 1 4"]:
    """Return how a rolling shutter shifts the rows: a slope and a wave (pixels, waves, phase)."""
    normal, parts = draws.normal(1, 1, 1), draws.uniform(0.0, 1.0, 3)[..., 0, 0]
    slope, wave = 6.0 * normal[:, 0, 0, 0], 3.0 * parts[:, 0]
    rolls = torch.stack([slope, wave, 0.5 + parts[:, 1], 6.3 * parts[:, 2]], 1)
    return (rolls * draws.flags(0.25)[:, 0, 0])[:, None, None]


def shift_of_rows(rolls: Tensor, y: Float[Tensor, "b m"]) -> Float[Tensor, "b m"]:
    """Return the shift of the rows to the right, pixels."""
    slope, wave, number, phase = rolls[:, 0, 0].unbind(1)
    down = y / VIEW_HEIGHT
    return slope[:, None] * (down - 0.5) + wave[:, None] * torch.sin(
        6.3 * number[:, None] * down + phase[:, None]
    )


def source_grid(homographies: Float[Tensor, "b 3 3"], rolls: Tensor) -> Float[Tensor, "b h w 2"]:
    """Return where each pixel of a view lies in the source, as `grid_sample` counts."""
    device = homographies.device
    y = torch.arange(VIEW_HEIGHT, device=device, dtype=torch.float32)
    x = torch.arange(VIEW_WIDTH, device=device, dtype=torch.float32)
    shift = shift_of_rows(rolls, y.expand(len(rolls), -1))
    across = x + shift[..., None]
    pixels = torch.stack([across, y[None, :, None].expand_as(across)], 3)
    source = moved_by(homographies, pixels.flatten(1, 2)).reshape(pixels.shape)
    return (2 * source + 1) / source.new_tensor([WIDTH, HEIGHT]) - 1


def moved_by(homographies: Float[Tensor, "b 3 3"], points: Float[Tensor, "b m 2"]) -> Tensor:
    moved = points @ homographies[:, :, :2].mT + homographies[:, None, :, 2]
    return moved[..., :2] / moved[..., 2:]


def from_source(homographies: Float[Tensor, "b 3 3"], points: Float[Tensor, "b m 2"]) -> Tensor:
    return moved_by(torch.linalg.inv(homographies), points)


def is_within(points: Float[Tensor, "b m 2"], width: int, height: int, edge: int) -> Tensor:
    high = points.new_tensor([width - 1 - edge, height - 1 - edge])
    return ((points >= edge) & (points <= high)).all(-1)
