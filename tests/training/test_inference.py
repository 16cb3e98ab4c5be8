"""Check that networks return equal results in several threads and restore PyTorch's
number of threads."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from topoloc_training import inference
from topoloc_training.cnn_nn import PooledFeatures
from topoloc_training.inference import Predictor, threads


def _predictor() -> Predictor:
    torch.manual_seed(0)
    return Predictor(PooledFeatures("squeezenet1_1", 11, 2, 3, 3.0))


def test_several_threads_get_the_bytes_of_one(monkeypatch: pytest.MonkeyPatch):
    frozen, freeze = [], inference._freeze
    monkeypatch.setattr(inference, "_freeze", lambda *args: frozen.append(1) or freeze(*args))
    pictures = np.random.default_rng(0).integers(0, 255, (6, 48, 64, 3), np.uint8)
    alone, before = _predictor(), torch.get_num_threads()
    expected = [alone(picture[None]).tobytes() for picture in pictures]
    shared = _predictor()
    with ThreadPoolExecutor(6) as pool:
        answers = list(
            pool.map(
                lambda picture: shared(picture[None]).tobytes(), np.concatenate([pictures] * 4)
            )
        )
    assert answers == expected * 4
    assert len(frozen) == 2, "once by each predictor"
    assert torch.get_num_threads() == before


def test_the_number_of_threads_is_restored_in_any_order():
    own = torch.get_num_threads()
    entered, left = threading.Event(), threading.Event()

    def longer() -> None:
        with threads(own + 2):
            entered.set()
            left.wait(10)

    with ThreadPoolExecutor(1) as pool:
        with threads(own + 1):
            other = pool.submit(longer)
            entered.wait(10)
            with threads(own + 3):
                assert torch.get_num_threads() == own + 3
            assert torch.get_num_threads() == own + 1
        left.set()
        other.result()
        assert pool.submit(torch.get_num_threads).result() == own
    assert torch.get_num_threads() == own
    assert _in_a_new_thread() == own


def _in_a_new_thread() -> int:
    seen: list[int] = []
    thread = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    return seen[0]
