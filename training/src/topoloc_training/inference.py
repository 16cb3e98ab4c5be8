"""Run a trained network on single images and on batches, in the fastest way for this processor.

If the processor multiplies bfloat16 in hardware, bfloat16 is used. Otherwise single precision is
used, and a network for single images is frozen into TorchScript. Its fused calls save a third of a
small network's time (docs/journal/retrieval.md).
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from topoloc.compiled import num_threads
from topoloc_training.backbones import normalize_images
from topoloc_training.network_images import RgbImages

BATCH_SIZE = 16


def has_bfloat16() -> bool:
    """Return whether the processor multiplies bfloat16 in hardware (AVX512-BF16, AMX). Emulation is
    many times slower."""
    cpu = torch.cpu
    checks = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(bool(getattr(cpu, name)()) for name in checks if hasattr(cpu, name))


class Predictor:
    """Run a network: images in, rows of numbers out.

    Args:
        network: maps normalised images (n, 3, h, w) to (n, d).
    """

    def __init__(self, network: nn.Module) -> None:
        self._dtype = torch.bfloat16 if has_bfloat16() else torch.float32
        self._network = to_channels_last(network.eval().requires_grad_(False).to(self._dtype))
        self._frozen: dict[tuple[int, ...], torch.jit.ScriptModule] = {}
        self._freeze_lock = threading.Lock()

    def __call__(self, rgb_images: RgbImages) -> Float32[np.ndarray, "n d"]:
        """Return one row of outputs per image, for any number of images."""
        rows = []
        with torch.inference_mode():
            for start in range(0, len(rgb_images), BATCH_SIZE):
                batch = torch.from_numpy(rgb_images[start : start + BATCH_SIZE])
                images = normalize_images(batch).to(self._dtype)
                predict = self._predict_single if len(images) == 1 else self._network
                rows.append(predict(images).float().numpy())
        return np.concatenate(rows)

    def _predict_single(self, image: Tensor) -> Tensor:
        """Run the frozen network on one image. The first call freezes it. In small networks calls
        cost as much as arithmetic."""
        shape = tuple(image.shape)
        # The default is one thread: the last digits depend on the number, and on a busy machine
        # several threads wait for each other many times as long.
        with threads(num_threads(1)):
            with self._freeze_lock:
                if shape not in self._frozen:
                    self._frozen[shape] = _freeze(self._network, image)
            return self._frozen[shape](image)


class _ThreadLimit:
    """Limit the threads of PyTorch's operations within `with threads(number)`, and restore the
    number afterwards.

    PyTorch has one number for the process and one for each Python thread. Several Python threads
    may use the context at once. Each one restores the process's number from before the first
    entered, not a number that another thread has set meanwhile.
    """

    def __init__(self) -> None:
        self._lock, self._thread_local = threading.Lock(), threading.local()
        self._num_users, self._process_threads = 0, 0

    @contextmanager
    def __call__(self, number: int) -> Iterator[None]:
        outer: int | None = getattr(self._thread_local, "number", None)
        with self._lock:
            # always called: it makes a new thread take the process's number now and not later
            own = torch.get_num_threads()
            if self._num_users == 0:
                self._process_threads = own
            self._num_users += 1
            torch.set_num_threads(number)
        self._thread_local.number = number
        try:
            yield
        finally:
            self._thread_local.number = outer
            with self._lock:
                self._num_users -= 1
                torch.set_num_threads(self._process_threads if outer is None else outer)


threads = _ThreadLimit()


def _freeze(network: nn.Module, image: Tensor) -> torch.jit.ScriptModule:
    """Return the network frozen and compiled for images of this shape."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript warns at every use that it is deprecated
        frozen = torch.jit.freeze(torch.jit.trace(network, image))
    for _ in range(2):  # these compile
        frozen(image)
    return frozen


def to_channels_last(network: nn.Module) -> nn.Module:
    """Change the memory layout of the convolutions' weights to channels last, the fastest one. The
    network is changed in place and returned."""
    for value in network.state_dict(keep_vars=True).values():
        if value.ndim == 4:
            value.data = value.data.contiguous(memory_format=torch.channels_last)
    return network
