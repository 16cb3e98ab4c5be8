"""The training loop that cnn-fc and PoseNet share: cosine schedule, early stopping, checkpoints,
the same run every time.

Every epoch draws its numbers from the seed and its own number, so that a training that was
interrupted and resumed ends with the same bytes as one that was not.
"""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Generator, Tensor, nn

from topoloc.errors import TrainingError
from topoloc.recordings.atomic import atomic_write
from topoloc_training.classifier_config import TrainingConfig
from topoloc_training.inference import has_bfloat16, threads
from topoloc_training.training_set import Progress

BatchLoss = Callable[[Tensor, Generator], Tensor]
"""The mean loss of these rows of the training set, a scalar with gradient; randomness from the
generator."""


@dataclass(frozen=True)
class Training:
    """How a training went. `losses` are the mean of each epoch, `scores` (lower is better) those on
    the held-out images."""

    losses: list[float]
    scores: list[float]
    best_epoch: int
    stopped_by: str
    """``epochs``, ``patience``, or what went wrong."""


@dataclass(frozen=True, eq=False)
class Task:
    """Define the subject of a training.

    `pretrained` are the parameters that start with given weights. All others of `network` start at
    random. `draw_weights` is the sampling weight of each row. `score` evaluates the network on
    held-out images.
    """

    network: nn.Module
    loss: BatchLoss
    score: Callable[[], float]
    rows: Int[np.ndarray, " n"]
    draw_weights: np.ndarray
    pretrained: list[nn.Parameter]
    name: str


def fit(
    task: Task, config: TrainingConfig, progress: Progress, checkpoint: Path | None = None
) -> Training:
    """Train. The network ends with the weights of its best epoch. An existing checkpoint is
    resumed.

    A loss that is not finite ends the training with the best weights of earlier epochs.

    Raises:
        TrainingError: the loss was not finite before the first good epoch, or the checkpoint is of
            another training.
    """
    state = _State(task, config)
    if checkpoint is not None and checkpoint.exists():
        state.load(checkpoint)
    with deterministic(config):
        while not state.finished:
            fault = _train_epoch(task, config, state, progress)
            if fault:
                state.stopped_by = fault
                break
            state.judge(task.score())
            if checkpoint is not None:
                state.save(checkpoint)
    if state.best is None:
        raise TrainingError(
            f"{task.name}: {state.stopped_by or 'no epoch was trained'}; a lower learning rate may"
            " help"
        )
    task.network.load_state_dict(state.best)
    task.network.eval()
    return Training(state.losses, state.scores, state.best_epoch, state.stopped_by)


def hold_out(node_ids: Int[np.ndarray, " n"], share: float, seed: int) -> Bool[np.ndarray, " n"]:
    """Images to judge by: about `share` of all, from nodes that keep at least half of theirs."""
    rng = np.random.default_rng(seed)
    held_out = np.zeros(len(node_ids), bool)
    left = {
        int(node): int(count) // 2
        for node, count in zip(*np.unique(node_ids, return_counts=True), strict=True)
    }
    wanted = round(share * len(node_ids))
    for row in rng.permutation(len(node_ids)):
        if wanted > 0 and left[int(node_ids[row])] > 0:
            held_out[row] = True
            left[int(node_ids[row])] -= 1
            wanted -= 1
    return held_out


class _State:
    """All that changes while training."""

    def __init__(self, task: Task, config: TrainingConfig) -> None:
        self.task, self.config = task, config
        early = {id(parameter) for parameter in task.pretrained}
        fresh = [p for p in task.network.parameters() if p.requires_grad and id(p) not in early]
        groups: list[dict[str, Any]] = [{"params": fresh, "peak": config.learning_rate}]
        if task.pretrained:
            groups.append(
                {"params": task.pretrained, "peak": config.learning_rate * config.backbone_rate}
            )
        self.optimizer = torch.optim.AdamW(
            groups, lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.epoch, self.best_epoch, self.stopped_by = 0, 0, ""
        self.losses: list[float] = []
        self.scores: list[float] = []
        self.best: dict[str, Tensor] | None = None

    @property
    def finished(self) -> bool:
        if self.epoch >= self.config.max_epochs:
            self.stopped_by = "epochs"
        elif self.epoch - self.best_epoch >= self.config.patience:
            self.stopped_by = "patience"
        return bool(self.stopped_by)

    def judge(self, score: float) -> None:
        self.epoch += 1
        self.scores.append(score)
        if self.best is None or score < min(self.scores[:-1]):
            self.best, self.best_epoch = copy.deepcopy(self.task.network.state_dict()), self.epoch

    def set_rate(self, progress: float) -> None:
        """Cosine from the height to nothing, after a rise over the first twentieth."""
        share = min(progress / 0.05, 1.0) * 0.5 * (1.0 + math.cos(math.pi * progress))
        for group in self.optimizer.param_groups:
            group["lr"] = group["peak"] * share

    def save(self, path: Path) -> None:
        names = ("epoch", "best_epoch", "losses", "scores", "best")
        content = {name: getattr(self, name) for name in names} | {
            "fingerprint": self._fingerprint()
        }
        content |= {
            "network": self.task.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }
        try:
            with atomic_write(path) as part:
                torch.save(content, part)
        except (OSError, RuntimeError) as error:
            raise TrainingError(
                f"cannot write checkpoint {path}: {' '.join(str(error).split())[:200]}"
            ) from error

    def load(self, path: Path) -> None:
        try:
            content = torch.load(path, weights_only=True)
            fingerprint = content["fingerprint"]
        except Exception as error:  # whatever PyTorch makes of bytes that are no checkpoint
            raise TrainingError(
                f"checkpoint {path} is truncated, damaged or no checkpoint of a training"
            ) from error
        if fingerprint != self._fingerprint():
            raise TrainingError(
                f"checkpoint {path} is of another training: other images, network or settings"
            )
        for name in ("epoch", "best_epoch", "losses", "scores", "best"):
            setattr(self, name, content[name])
        self.task.network.load_state_dict(content["network"])
        self.optimizer.load_state_dict(content["optimizer"])

    def _fingerprint(self) -> str:
        shapes = [
            (name, tuple(value.shape)) for name, value in self.task.network.state_dict().items()
        ]
        drawn = (
            np.ascontiguousarray(self.task.draw_weights).tobytes()
            + np.ascontiguousarray(self.task.rows).tobytes()
        )
        return hashlib.sha256(repr((asdict(self.config), shapes)).encode() + drawn).hexdigest()


def _train_epoch(task: Task, config: TrainingConfig, state: _State, progress: Progress) -> str:
    """Train one epoch. Return a description of a failure, else an empty text."""
    seed = config.seed * 100_003 + state.epoch
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)  # dropout
    task.network.train()
    weights = torch.from_numpy(np.asarray(task.draw_weights, np.float64))
    order = torch.from_numpy(task.rows)[
        torch.multinomial(weights, len(task.rows), replacement=True, generator=generator)
    ]
    batches = order.split(config.batch_size)
    total = 0.0
    for done, rows in enumerate(batches):
        state.set_rate((state.epoch + done / len(batches)) / config.max_epochs)
        with torch.autocast("cpu", torch.bfloat16, enabled=has_bfloat16()):
            loss = task.loss(rows, generator)
        if not torch.isfinite(loss):
            return f"the loss was not finite in epoch {state.epoch + 1}"
        state.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(task.network.parameters(), 5.0)
        state.optimizer.step()
        total += loss.item() * len(rows)
        progress(
            f"{task.name}: images shown",
            state.epoch * len(order) + min((done + 1) * config.batch_size, len(order)),
            config.max_epochs * len(order),
        )
    state.losses.append(total / len(order))
    return ""


@contextmanager
def deterministic(config: TrainingConfig) -> Iterator[None]:
    """Make sums deterministic: equal in every run. The caller's settings are restored at the
    end."""
    deterministic, rng_state = torch.are_deterministic_algorithms_enabled(), torch.get_rng_state()
    try:
        torch.use_deterministic_algorithms(True)
        with threads(config.num_threads or torch.get_num_threads()):
            yield
    finally:
        torch.use_deterministic_algorithms(deterministic)
        torch.set_rng_state(rng_state)
