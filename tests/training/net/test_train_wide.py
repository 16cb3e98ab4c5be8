"""Training on wide pairs: points lie where both views show them; the network begins as it was."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from topoloc.features.network_files import NetworkInfo
from topoloc_training.net import wide_pairs
from topoloc_training.net.batch_light import change_light
from topoloc_training.net.losses import sampled
from topoloc_training.net.network import TopolocNet
from topoloc_training.net.stored_depth import read_depth
from topoloc_training.net.train_wide import losses, train, unfold_norms
from topoloc_training.net.wide_pairs import Library, draw_batch, find_pairs, grid_pixels, project
from topoloc_training.networks.edgepoint2 import EdgePoint2
from topoloc_training.networks.export import export
from topoloc_worlds.wide_views import store_depth

WALL_M = 4.0


def pose(look_deg: float, right_m: float) -> np.ndarray:
    """Return world_from_cam of a camera that is turned to the right, before the wall z = 4 m."""
    angle = np.radians(look_deg)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    world_from_cam[0, 3] = right_m
    return world_from_cam


def wall_seen(world_from_cam: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and the place on the wall (x, y) of pixels."""
    rays = np.column_stack([(pixels - [319.5, 199.5]) / 380.0, np.ones(len(pixels))])
    turned = rays @ world_from_cam[:3, :3].T
    depth = WALL_M / np.maximum(turned[:, 2], 0.05)
    return depth, (turned * depth[:, None] + world_from_cam[:3, 3])[:, :2]


@pytest.fixture(scope="module")
def library() -> Library:
    """Two pictures of a wall whose grey values tell the place, and a photo of noise."""
    y, x = np.mgrid[:384, :640]
    pixels = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    grid = grid_pixels(torch.device("cpu")).double().numpy()
    poses, pictures, depths = [pose(0, 0), pose(25, -1.0)], [], []
    for world_from_cam in poses:
        at = wall_seen(world_from_cam, pixels)[1].reshape(384, 640, 2)
        pictures.append(128 + 60 * np.sin(0.9 * at[..., 0]) + 50 * np.sin(1.1 * at[..., 1]))
        depths.append(wall_seen(world_from_cam, grid)[0].reshape(96, 160))
    noise = np.random.default_rng(0).uniform(0, 255, (24, 40))
    pictures.append(cv2.resize(noise, (640, 384), interpolation=cv2.INTER_CUBIC).clip(0, 255))
    depths.append(np.zeros((96, 160)))
    generator = torch.Generator().manual_seed(0)
    descriptors = torch.randn(3, 64, 96, 160, generator=generator)
    return Library(
        torch.from_numpy(np.array(pictures).round().astype(np.uint8))[:, None],
        torch.rand(3, 1, 384, 640, generator=generator) ** 4,
        functional.normalize(descriptors, dim=1),
        torch.from_numpy(np.array(depths, np.float32))[:, None],
        torch.from_numpy(np.array([*poses, np.eye(4)], np.float32)),
        torch.tensor([0.5, 0.5, 1.0]),
    )


def test_depth_is_stored_to_half_a_thousandth(tmp_path: Path):
    depth = np.random.default_rng(0).uniform(0.2, 300, (400, 640)).astype(np.float32)
    depth[5, 9] = np.nan
    store_depth(tmp_path / "depth.png", depth)
    found = read_depth(tmp_path / "depth.png")
    assert found.shape == (100, 160)
    assert found[1, 2] == 0
    known = found > 0
    assert known.sum() == known.size - 1
    np.testing.assert_allclose(found[known], depth[1::4, 1::4][known], rtol=5e-4)


def test_points_are_projected_where_the_wall_is_and_hidden_ones_left_out(library: Library):
    at, visible = project(library, torch.tensor([0]), torch.tensor([1]))
    assert 1000 < visible.sum() < visible.numel()
    pixels = grid_pixels(torch.device("cpu")).double().numpy()
    seen = visible[0].numpy()
    here = wall_seen(pose(0, 0), pixels[seen])[1]
    there = wall_seen(pose(25, -1.0), at[0].double().numpy()[seen])[1]
    np.testing.assert_allclose(here, there, atol=1e-3)
    blocked = library.depth.clone()
    blocked[1, :, :, :120] = 0.5
    hidden = wide_pairs.Library(**{**vars(library), "depth": blocked})
    assert project(hidden, torch.tensor([0]), torch.tensor([1]))[1].sum() < 0.5 * visible.sum()


def test_both_views_of_a_sample_show_its_points(library: Library, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(wide_pairs, "change_light", lambda pictures, *_: pictures)
    pairs = find_pairs(library, torch.tensor([0, 0, -1]), torch.tensor([0, 1, 0]))
    assert pairs.rows.tolist() == [[0, 1]]
    assert pairs.angles_deg.item() == pytest.approx(25.0, abs=0.01)
    batch = draw_batch(library, pairs, 12, 6, torch.Generator().manual_seed(1))
    shown = sampled_grey(batch.views, batch.points)
    first, second = shown.chunk(2)
    both = batch.valid.chunk(2)[0] & batch.valid.chunk(2)[1]
    assert both.float().mean() > 0.4
    assert (first - second)[both].abs().quantile(0.98) < 0.02
    assert batch.inside[:12].all()
    assert not batch.inside[18:].any()  # scores of warped copies are not the teacher's
    assert not batch.near.diagonal(dim1=1, dim2=2).any()


def sampled_grey(views: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return the grey values at points, bilinearly."""
    size = torch.tensor([views.shape[3], views.shape[2]])
    grid = (2 * points + 1) / size - 1
    return functional.grid_sample(views, grid[:, :, None], align_corners=False)[:, 0, :, 0]


def test_light_changes_by_strength_and_the_seed_fixes_all():
    x = torch.linspace(0, 60, 320)
    pictures = (0.5 + 0.3 * torch.sin(x)).expand(6, 1, 256, 320)

    def changed(strength: float, seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return change_light(pictures, torch.full((6,), strength), generator)

    strong = changed(1.0, 2)
    assert torch.equal(strong, changed(1.0, 2))
    assert 0 <= strong.min() < strong.max() <= 1
    likeness = [
        torch.corrcoef(torch.stack([one.flatten(), pictures[0].flatten()]))[0, 1]
        for one in (*changed(0.0, 2), *strong)
    ]
    assert min(likeness[:6]) > 0.97
    assert min(likeness[6:]) < 0.9


def test_unfolded_norms_change_nothing_but_learn(library: Library):
    torch.manual_seed(0)
    network = TopolocNet().eval()
    pairs = find_pairs(library, torch.tensor([0, 0, -1]), torch.tensor([0, 1, 0]))
    batch = draw_batch(library, pairs, 4, 2, torch.Generator().manual_seed(1))
    for norm in (one for one in network.modules() if isinstance(one, torch.nn.BatchNorm2d)):
        assert norm.running_var is not None
        torch.nn.init.constant_(norm.running_var, 1 - norm.eps)
    before = network.maps(batch.views)
    unfold_norms(network, batch)
    for train_mode in (False, True):
        network.train(train_mode)
        for ours, theirs in zip(network.maps(batch.views), before, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)
    losses(network, batch).sum().backward()
    assert all(parameter.grad is not None for parameter in network.parameters())
    assert sampled(before[1], batch.points, 4).shape == (8, wide_pairs.NUM_POINTS, 64)


def test_a_folder_is_trained_on_and_exported(tmp_path: Path):
    torch.manual_seed(0)
    torch.save(EdgePoint2("e64").state_dict(), tmp_path / "E64.pth")
    network = TopolocNet().eval()
    for norm in (one for one in network.modules() if isinstance(one, torch.nn.BatchNorm2d)):
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        assert norm.running_mean is not None
        torch.nn.init.uniform_(norm.running_mean, -0.2, 0.2)
    export(network, tmp_path / "start.onnx", {"topoloc_network": "topoloc-net"})
    noise = np.random.default_rng(0).uniform(0, 255, (25, 40)).astype(np.uint8)
    grey = cv2.resize(noise, (640, 400), interpolation=cv2.INTER_CUBIC)
    records = []
    for k, right in enumerate((0.0, 0.3)):
        cv2.imwrite(str(tmp_path / f"{k}.webp"), grey)
        store_depth(tmp_path / f"{k}.png", np.full((400, 640), WALL_M, np.float32))
        records.append(
            {"file": f"{k}.webp", "depth": f"{k}.png", "place": "wall", "light": k, "share": 0.5}
            | {"world_from_cam": pose(0, right).tolist()}
        )
    (tmp_path / "views.json").write_text(json.dumps(records))
    settings = {"folder": tmp_path, "teacher": tmp_path / "E64.pth", "out": tmp_path / "out"}
    settings |= {"start": tmp_path / "start.onnx", "minutes": 0.02, "batch": 2, "seed": 1}
    settings |= {"pair_share": 0.5, "rate": 1e-3, "weights": (1, 1, 1, 4, 0.2)}
    train(argparse.Namespace(**settings, frozen_norms=False))
    assert NetworkInfo.of_file(tmp_path / "out" / "topoloc-net.onnx").name == "topoloc-net"
