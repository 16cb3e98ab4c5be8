"""Train `topoloc-net`: `python -m topoloc_training.net.train --teacher edgepoint2-e64.onnx
--pictures FOLDER... --out FOLDER`.

Resumable: started again with the same folder it goes on from its last state. One line of JSON a
hundred steps goes to `log.jsonl`.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from topoloc.recordings.open import open_sequence
from topoloc_training.net.losses import likeness, peaks, placed, sampled, told_apart
from topoloc_training.net.network import KIND, STRIDE, TopolocNet, follow
from topoloc_training.net.pairs import Pair, find_pairs
from topoloc_training.net.side_pairs import find_side_pairs
from topoloc_training.net.teacher import HEIGHT, learn
from topoloc_training.net.views import Sample, Shares, draw_sample
from topoloc_training.networks.export import export
from topoloc_training.networks.exported import freeze_norms, load_exported

_LOG_EVERY = 100
_SAVE_EVERY = 250
_WEIGHTS = (1.0, 1.0, 0.5, 4.0, 0.2)
_KEPT_AVERAGE = 0.998


@dataclass(frozen=True)
class TrainNet:
    """Distil `topoloc-net` from a teacher on pictures and on day and night pairs of rendered
    places."""

    teacher: Path
    """ONNX file of a network of 64-number descriptors and stride 4, of the contract of
    `networks/export.py`."""
    pictures: list[str] = field(default_factory=list)
    """Folders of pictures; `FOLDER::2` takes every other one."""
    pairs: list[str] = field(default_factory=list)
    """Pairs of recordings of one rendered place, `DAY:OTHER`: the day's with stereo, both with
    truth."""
    walls: list[str] = field(default_factory=list)
    """The same, `OUT:BACK`, of a way that was walked both ways: its walls are learned as views to
    the sides show them."""
    out: Path = Path("net")
    """Folder of the state, of the log and of the network."""
    name: Literal["topoloc-net", "topoloc-net-sides"] = KIND
    """The network to train: for images, or for virtual views."""
    steps: int = 8000
    batch: int = 4
    """Samples a step; each gives two views."""
    rate: float = 2e-3
    """Learning rate, falling to nothing by a cosine."""
    pair_share: float = 0.3
    """Share of samples that come from pairs."""
    wall_share: float = 0.0
    """Share of samples that come from walls."""
    slants: float = 0.0
    """Share of the other samples that show a picture as if it hung on a wall, from both of its ends
    (`slants.py`)."""
    seed: int = 1
    start: Path | None = None
    """State of an earlier training to start from; missing weights start at random. With
    `--frozen-norms` it is the network's ONNX file."""
    frozen_norms: bool = False
    """Keep the batch norms fixed: an ONNX file has them folded into the layers before them."""
    threads: int = 1
    minutes: float = 1e9
    """Stop after this time (minutes). The state is kept."""


def train(config: TrainNet) -> None:
    """Train, or go on training, and export the averaged network."""
    torch.set_num_threads(config.threads)
    config.out.mkdir(parents=True, exist_ok=True)
    pairs = [
        pair for names in config.pairs for pair in _cached_pairs(names, config.out, find_pairs)
    ]
    walls = [
        pair
        for names in config.walls
        for pair in _cached_pairs(names, config.out, partial(_side_pairs, config.out / "sides"))
    ]
    folders = config.pictures + sorted(
        {path for names in config.pairs for path in _picture_folders(names)}
    )
    folders += [str(config.out / "sides")] if walls else []
    lessons = learn(folders, config.teacher, config.out / "lessons")
    rows = {os.path.realpath(path): i for i, path in enumerate(lessons.paths)}
    known, known_walls = (
        [(rows[os.path.realpath(p.day)], rows[os.path.realpath(p.other)], _cut(p)) for p in of]
        for of in (pairs, walls)
    )
    shares = Shares(config.pair_share if known else 0.0, config.wall_share, config.slants)
    torch.manual_seed(config.seed)
    network, average, optimizer, step = _begin(config)
    begun = step
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda taken: _rate(begun + taken, config.steps)
    )
    network.train()
    if config.frozen_norms:
        freeze_norms(network)
    end, sums, since = time.monotonic() + 60 * config.minutes, np.zeros(5), time.monotonic()
    while step < config.steps and time.monotonic() < end:
        # The generator follows from the step, so that a resumed run goes on as the first would
        # have.
        generator = np.random.default_rng([config.seed, step])
        parts = _step(
            network,
            [
                draw_sample(lessons, known, known_walls, shares, generator)
                for _ in range(config.batch)
            ],
        )
        loss = torch.stack(
            [weight * part for weight, part in zip(_WEIGHTS, parts, strict=True)]
        ).sum()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        step += 1
        follow(average, network, min(_KEPT_AVERAGE, step / (step + 20)))
        sums += [float(part.detach()) for part in parts]
        if step % _LOG_EVERY == 0:
            _log_means(config.out, step, float(schedule.get_last_lr()[0]), since, sums)
            sums, since = np.zeros(5), time.monotonic()
        if step % _SAVE_EVERY == 0:
            _save(config, network, average, optimizer, step)
    _save(config, network, average, optimizer, step)


def _log_means(out: Path, step: int, rate: float, since: float, sums: np.ndarray) -> None:
    """Log the mean losses of the last steps, and the seconds that they took."""
    names = ("cosine", "to_teacher", "across_light", "score", "place")
    line = {"step": step, "rate": rate, "seconds": round(time.monotonic() - since, 1)}
    means = {n: round(float(v) / _LOG_EVERY, 4) for n, v in zip(names, sums, strict=True)}
    _log(out, line | means)


def _step(network: TopolocNet, samples: list[Sample]) -> tuple[Tensor, ...]:
    """Return the losses: cosine to the teacher, contrast against the teacher, contrast across
    light, score, position of key points."""

    def both(name: str) -> Tensor:
        """First views of all samples, then second ones."""
        stacked = np.array([getattr(sample, name) for sample in samples])
        return torch.from_numpy(np.concatenate([stacked[:, 0], stacked[:, 1]]))

    logits, maps = network.maps(both("views").float()[:, None])
    points, valid = both("points"), both("valid")
    near = torch.from_numpy(np.array([sample.near for sample in samples]))
    taught = torch.from_numpy(np.array([sample.taught for sample in samples]))
    ours = sampled(maps, points, STRIDE)
    theirs = torch.cat([taught, taught])
    first, second = ours.chunk(2)
    seen_twice = valid.chunk(2)[0] & valid.chunk(2)[1]
    is_taught = torch.tensor([sample.is_taught for sample in samples])
    valid = valid & torch.cat([is_taught, is_taught])[:, None]
    target, inside = both("scores").float()[:, None], both("inside")[:, None]
    return (
        likeness(ours, theirs, valid),
        told_apart(ours, theirs, valid, torch.cat([near, near])),
        told_apart(first, second, seen_twice, near),
        peaks(logits, target, inside),
        placed(logits, target, inside),
    )


def _begin(config: TrainNet) -> tuple[TopolocNet, TopolocNet, torch.optim.Optimizer, int]:
    network = TopolocNet()
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=1e-4)
    if config.start is not None and config.start.suffix == ".onnx":
        load_exported(network, config.start)
    elif config.start is not None:
        _begin_with(network, torch.load(config.start, weights_only=True)["average"])
    average, step = copy.deepcopy(network), 0
    if (state := config.out / "state.pt").is_file():
        kept = torch.load(state, weights_only=True)
        network.load_state_dict(kept["network"])
        average.load_state_dict(kept["average"])
        optimizer.load_state_dict(kept["optimizer"])
        step = kept["step"]
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] = config.rate
    return network, average, optimizer, step


def _begin_with(network: nn.Module, earlier: dict[str, Tensor]) -> None:
    own = network.state_dict()
    network.load_state_dict(
        {n: value for n, value in earlier.items() if n in own and own[n].shape == value.shape},
        strict=False,
    )


def _rate(step: int, steps: int) -> float:
    """Share of the full rate: up within a hundred steps, then down by a cosine."""
    return (
        min(1.0, (step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * min(1.0, step / steps))) + 1e-3
    )


def _save(
    config: TrainNet,
    network: nn.Module,
    average: TopolocNet,
    optimizer: torch.optim.Optimizer,
    step: int,
) -> None:
    part = config.out / "state.part"
    state = {
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "step": step,
    }
    torch.save(state, part)
    part.replace(config.out / "state.pt")
    origin = {
        "topoloc_network": config.name,
        "licence": "Apache-2.0",
        "source": f"trained by topoloc_training.net.train, {step} steps",
    }
    export(copy.deepcopy(average).eval(), config.out / f"{config.name}.onnx", origin)


def _log(out: Path, line: dict[str, int | float]) -> None:
    with (out / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def _picture_folders(names: str) -> tuple[str, str]:
    day, _, other = names.partition(":")
    return f"{day}/image_2", f"{other}/images"


def _cached_pairs(names: str, out: Path, find: Callable[[str, str], list[Pair]]) -> list[Pair]:
    file = out / f"pairs-{names.replace('/', '_').replace(':', '-')}.npz"
    if not file.is_file():
        day, _, other = names.partition(":")
        pairs = find(day, other)
        arrays = {
            f"{i}{part}": getattr(p, part)
            for i, p in enumerate(pairs)
            for part in ("day", "other", "day_px", "other_px")
        }
        np.savez(file, **arrays)
    with np.load(file) as kept:
        count = len(kept.files) // 4
        return [
            Pair(
                str(kept[f"{i}day"]),
                str(kept[f"{i}other"]),
                kept[f"{i}day_px"],
                kept[f"{i}other_px"],
            )
            for i in range(count)
        ]


def _side_pairs(pictures: Path, out: str, back: str) -> list[Pair]:
    return find_side_pairs(open_sequence(out), open_sequence(back), pictures)


def _cut(pair: Pair) -> Pair:
    """Remove points below the rows that the teacher saw."""
    kept = (pair.day_px[:, 1] < HEIGHT - 1) & (pair.other_px[:, 1] < HEIGHT - 1)
    return Pair(pair.day, pair.other, pair.day_px[kept], pair.other_px[kept])


def _main() -> None:
    train(tyro.cli(TrainNet, description=TrainNet.__doc__))


if __name__ == "__main__":
    _main()
