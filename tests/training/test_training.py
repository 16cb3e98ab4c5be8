"""Test the validation split and the schedule."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, strategies as st

from topoloc_training.classifier_config import TrainingConfig
from topoloc_training.training import Task, fit, hold_out


@given(
    st.lists(st.integers(0, 8), min_size=1, max_size=80), st.floats(0.0, 0.9), st.integers(0, 100)
)
def test_no_node_loses_more_than_half_of_its_images(nodes: list[int], share: float, seed: int):
    node_ids = np.array(nodes)
    held_out = hold_out(node_ids, share, seed)
    assert held_out.sum() <= round(share * len(nodes))
    for node in np.unique(node_ids):
        assert held_out[node_ids == node].sum() <= np.sum(node_ids == node) // 2


def test_it_stops_when_there_is_no_more_gain_and_keeps_the_best():
    network = torch.nn.Linear(1, 1)
    scores = iter([3.0, 1.0, 2.0, 2.0, 2.0, 0.5])
    weights = []

    def score() -> float:
        weights.append(network.weight.item())
        return next(scores)

    def loss(rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return (network(torch.ones(len(rows), 1)) - 5.0).square().mean()

    config = TrainingConfig(max_epochs=6, patience=3, learning_rate=0.05)
    done = fit(
        Task(network, loss, score, np.arange(8), np.ones(8), [], "line"),
        config,
        lambda stage, done, total: None,
    )
    assert (done.best_epoch, done.stopped_by, done.scores) == (
        2,
        "patience",
        [3.0, 1.0, 2.0, 2.0, 2.0],
    )
    assert network.weight.item() == weights[1]
    assert done.losses[-1] < done.losses[0]
