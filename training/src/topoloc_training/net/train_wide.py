"""Train `topoloc-net` further on wide rendered pairs and on photos, on a GPU if there is one:
`python -m topoloc_training.net.train_wide FOLDER --teacher E64.pth --start topoloc-net.onnx
--out OUT`.

FOLDER is made by `wide_views.py`. The rate falls with the time, so a run ends after --minutes. The
averaged network is kept every minute, and exported at the end.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from topoloc_training.net.losses import likeness, peaks, placed, sampled, told_apart
from topoloc_training.net.network import KIND, STRIDE, TopolocNet, follow
from topoloc_training.net.stored_depth import STEP as DEPTH_STEP, read_depth
from topoloc_training.net.wide_pairs import (
    HEIGHT,
    WIDTH,
    Batch,
    KnownPairs,
    Library,
    draw_batch,
    find_pairs,
)
from topoloc_training.networks.edgepoint2 import EdgePoint2
from topoloc_training.networks.export import export
from topoloc_training.networks.exported import freeze_norms, load_exported

_KEPT_AVERAGE = 0.999
_SAVE_S, _LOG_EVERY = 60.0, 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--teacher", type=Path, required=True)
    parser.add_argument("--start", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=7.0)
    parser.add_argument("--batch", type=int, default=48)
    parser.add_argument("--pair-share", type=float, default=0.4)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument(
        "--weights",
        type=float,
        nargs=5,
        default=(1.0, 1.0, 0.5, 4.0, 0.2),
        help="of the teacher's descriptors, points told apart by them, by our own, scores, place",
    )
    parser.add_argument("--frozen-norms", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    train(parser.parse_args())


def train(args: argparse.Namespace) -> None:
    """Train for so many minutes, and export the averaged network."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    args.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(args.seed)
    generator = torch.Generator(device).manual_seed(args.seed)
    library, pairs = read_library(args.folder, args.teacher, device)
    print(f"{len(library.pictures)} pictures, {len(pairs.rows)} pairs", flush=True)
    num_pairs = round(args.batch * args.pair_share)
    draw = partial(draw_batch, library, pairs, args.batch, num_pairs, generator)
    network = TopolocNet()
    load_exported(network, args.start)
    network.to(device).train()
    if args.frozen_norms:
        freeze_norms(network)
    else:
        unfold_norms(network, draw())
    average = copy.deepcopy(network)
    num_steps = run_steps(network, average, draw, args)
    origin = {"topoloc_network": KIND, "licence": "Apache-2.0"}
    origin["source"] = f"trained by topoloc_training.net.train_wide, {num_steps} steps"
    export(average.cpu().eval(), args.out / f"{KIND}.onnx", origin)


def run_steps(
    network: TopolocNet, average: TopolocNet, draw: Callable[[], Batch], args: argparse.Namespace
) -> int:
    """Train until the time is over, keep the average in `OUT/average.pt`, and return the steps."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=args.rate, weight_decay=1e-4)
    weights = next(network.parameters()).new_tensor(args.weights)
    begun = saved = time.monotonic()
    step, sums = 0, torch.zeros_like(weights)
    while (passed := (time.monotonic() - begun) / 60 / args.minutes) < 1:
        for group in optimizer.param_groups:
            warm = min(1.0, (step + 1) / 100)
            group["lr"] = args.rate * warm * (0.5 + 0.5 * math.cos(math.pi * passed)) + 1e-6
        parts = losses(network, draw())
        optimizer.zero_grad(set_to_none=True)
        (parts * weights).sum().backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        step += 1
        follow(average, network, min(_KEPT_AVERAGE, step / (step + 10)))
        sums += parts.detach()
        if step % _LOG_EVERY == 0:
            line = {"step": step, "seconds": round(time.monotonic() - begun, 1)}
            line |= {"losses": [round(x, 4) for x in (sums / _LOG_EVERY).tolist()]}
            with (args.out / "log.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            sums.zero_()
        if time.monotonic() - saved > _SAVE_S:
            saved = time.monotonic()
            torch.save(average.state_dict(), args.out / "average.pt")
    return step


def losses(network: TopolocNet, batch: Batch) -> Float[Tensor, "5"]:
    """Return the five parts: the teacher's descriptors, points told apart by them and by our own,
    scores, places."""
    logits, maps = network.maps(batch.views)
    ours, theirs = sampled(maps, batch.points, STRIDE), batch.taught.repeat(2, 1, 1)
    first, second = ours.chunk(2)
    seen_twice = batch.valid.chunk(2)[0] & batch.valid.chunk(2)[1]
    parts = (
        likeness(ours, theirs, batch.valid & batch.is_like[:, None]),
        told_apart(ours, theirs, batch.valid, batch.near.repeat(2, 1, 1)),
        told_apart(first, second, seen_twice, batch.near),
        peaks(logits, batch.scores, batch.inside),
        placed(logits, batch.scores, batch.inside),
    )
    return torch.stack(parts)


def unfold_norms(network: TopolocNet, batch: Batch) -> None:
    """Give each batch norm, which an export had folded, the statistics of a batch, so that it can
    learn again. The network computes the same as before."""
    hooks = []

    def calibrate(norm: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        assert isinstance(norm, nn.BatchNorm2d)
        assert norm.running_mean is not None
        assert norm.running_var is not None
        mean, variance = inputs[0].mean((0, 2, 3)), inputs[0].var((0, 2, 3)) + norm.eps
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance - norm.eps)
        norm.weight.copy_(variance.sqrt())
        norm.bias.add_(mean)

    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            hooks.append(module.register_forward_pre_hook(calibrate))
    with torch.no_grad():
        network.maps(batch.views)
    for hook in hooks:
        hook.remove()


def read_library(folder: Path, teacher: Path, device: torch.device) -> tuple[Library, KnownPairs]:
    """Return the pictures of `views.json` with the teacher's answers, and the pairs."""
    records = json.loads((folder / "views.json").read_text(encoding="utf-8"))
    pictures = torch.stack([_picture(folder / record["file"]) for record in records]).to(device)
    scores, descriptors = ask_teacher(pictures, teacher)
    depth = torch.zeros(len(records), 1, HEIGHT // DEPTH_STEP, WIDTH // DEPTH_STEP)
    for i, record in enumerate(records):
        if record["depth"]:
            rows = read_depth(folder / record["depth"])[: HEIGHT // DEPTH_STEP]
            depth[i, 0] = torch.from_numpy(rows)
    poses = [record["world_from_cam"] or np.eye(4).tolist() for record in records]
    shares = torch.tensor([float(record["share"]) for record in records])
    library = Library(
        pictures,
        scores,
        descriptors,
        depth.to(device),
        torch.tensor(poses, dtype=torch.float32, device=device),
        shares.to(device),
    )
    names = sorted({record["place"] for record in records if record["place"]})
    places = [names.index(record["place"]) if record["place"] else -1 for record in records]
    lights = [int(record["light"]) for record in records]
    pairs = find_pairs(
        library, torch.tensor(places, device=device), torch.tensor(lights, device=device)
    )
    return library, pairs


@torch.no_grad()
def ask_teacher(
    pictures: UInt8[Tensor, "n 1 h w"], teacher: Path
) -> tuple[Float[Tensor, "n 1 h w"], Float[Tensor, "n 64 h4 w4"]]:
    """Return the scores and the unit descriptors of EdgePoint2-E64, in half precision."""
    network = EdgePoint2("e64")
    network.load_state_dict(torch.load(teacher, map_location="cpu", weights_only=True))
    network.eval().to(pictures.device)
    scores, descriptors = [], []
    for some in pictures.split(8):
        score, descriptor = network(some.float() / 255)
        scores.append(score.half())
        descriptors.append(functional.normalize(descriptor, dim=1).half())
    return torch.cat(scores), torch.cat(descriptors)


def _picture(path: Path) -> Tensor:
    """Return the grey picture (1, 384, 640), its top rows, or mirrored below."""
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert picture is not None, path
    missing = max(0, HEIGHT - picture.shape[0])
    picture = cv2.copyMakeBorder(picture[:HEIGHT], 0, missing, 0, 0, cv2.BORDER_REFLECT_101)
    return torch.from_numpy(picture)[None]


if __name__ == "__main__":
    main()
