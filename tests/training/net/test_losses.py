"""Test the losses: minimal for the teacher's descriptors, with negatives only from
different points."""

from __future__ import annotations

import torch
from torch.nn import functional

from topoloc_training.net.losses import likeness, peaks, placed, sampled, told_apart


def units(seed: int, count: int = 20) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return functional.normalize(torch.randn(2, count, 16, generator=generator), dim=2)


def test_descriptors_are_sampled_as_in_the_contract():
    """The map's values are their own position, (x, y, 1), before normalization."""
    stride, width, height = 4, 10, 8
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    maps = torch.stack([x, y, torch.ones_like(x)]).float()[None]
    pixels = torch.tensor([[[13.0, 9.5], [20.3, 17.1]]])
    found = sampled(maps, pixels, stride)
    expected = (pixels + 0.5) / stride - 0.5
    torch.testing.assert_close(found[..., :2] / found[..., 2:], expected)


def test_likeness_is_nothing_only_for_the_teachers_own():
    ours, valid = units(0), torch.ones(2, 20, dtype=torch.bool)
    assert likeness(ours, ours, valid) < 1e-6
    assert likeness(ours, units(1), valid) > 0.7
    valid[:, 3] = False
    wrong = ours.clone()
    wrong[:, 3] = -ours[:, 3]
    assert likeness(ours, wrong, valid) < 1e-6


def test_points_are_separated_from_rivals_but_not_from_neighbours():
    ours, valid = units(0), torch.ones(2, 20, dtype=torch.bool)
    near = torch.zeros(2, 20, 20, dtype=torch.bool)
    clean = told_apart(ours, ours, valid, near)
    assert clean < told_apart(ours, ours.roll(1, dims=1), valid, near) - 1
    twin = ours.clone()
    twin[:, 5] = ours[:, 4]
    assert told_apart(twin, twin, valid, near) > clean + 0.05
    near[:, 4, 5] = near[:, 5, 4] = True
    assert told_apart(twin, twin, valid, near) < clean + 0.01


def test_scores_are_drawn_to_the_teachers_peaks_inside_the_picture():
    target = torch.zeros(1, 1, 8, 8)
    target[0, 0, 4, 4] = 1
    inside = torch.ones(1, 1, 8, 8, dtype=torch.bool)
    right, missed = torch.full_like(target, -6), torch.full_like(target, -6)
    right[0, 0, 4, 4] = 6
    assert peaks(right, target, inside) < 0.01 < peaks(missed, target, inside)
    inside[0, 0, 4, 4] = False
    assert peaks(missed, target, inside) < 0.01


def test_a_key_point_is_required_in_its_own_pixel():
    target = torch.zeros(1, 1, 16, 16)
    target[0, 0, 4, 4], target[0, 0, 12, 3] = 0.9, 0.03
    inside = torch.ones(1, 1, 16, 16, dtype=torch.bool)
    right, beside = torch.zeros_like(target), torch.zeros_like(target)
    right[0, 0, 4, 4] = beside[0, 0, 4, 5] = 12
    assert placed(right, target, inside) < 0.01 < 4 < placed(beside, target, inside)
    beside[0, 0, 4, 4] = 24
    beside[0, 0, 8:, 5] = 12
    assert placed(beside, target, inside) < 0.01, (
        "where the teacher sees no key point, no place is asked for"
    )
