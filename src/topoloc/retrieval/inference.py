"""Running a trained network on single pictures and on batches, in the way that this machine's
processor does fastest.

What that is was measured (docs/journal/retrieval.md): bfloat16 where the processor multiplies it in hardware,
else single precision with the network frozen into TorchScript, whose fused calls save a third of a
small network's time.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor, nn

from topoloc.compiled import num_threads
from topoloc.retrieval.backbones import normalize_images
from topoloc.retrieval.network_images import RgbImages

BATCH_SIZE = 16


def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 in hardware (AVX512-BF16, AMX); elsewhere it is
    emulated, many times slower."""
    cpu = torch.cpu
    checks = ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    return any(bool(getattr(cpu, name)()) for name in checks if hasattr(cpu, name))


class Predictor:
    """A network ready to answer: pictures in, rows of numbers out.

    Args:
        network: takes normalised images (n, 3, h, w), gives (n, d).
    """

    def __init__(self, network: nn.Module) -> None:
        self._dtype = torch.bfloat16 if has_bfloat16() else torch.float32
        self._network = to_channels_last(network.eval().requires_grad_(False).to(self._dtype))
        self._frozen: dict[tuple[int, ...], torch.jit.ScriptModule] = {}
        self._freeze_lock = threading.Lock()

    def __call__(self, rgb_images: RgbImages) -> Float32[np.ndarray, "n d"]:
        """One row of outputs for each picture, whatever their number."""
        rows = []
        with torch.inference_mode():
            for start in range(0, len(rgb_images), BATCH_SIZE):
                images = normalize_images(
                    torch.from_numpy(rgb_images[start : start + BATCH_SIZE])
                ).to(self._dtype)
                outputs = (
                    self._predict_single(images) if len(images) == 1 else self._network(images)
                )
                rows.append(outputs.float().numpy())
        return np.concatenate(rows)

    def _predict_single(self, image: Tensor) -> Tensor:
        """One picture through the frozen network, which is made at the first call: in small
        networks calls cost as much as arithmetic."""
        shape = tuple(image.shape)
        # By default one: the last digits follow from the number, and on a busy machine several wait
        # for one another many times as long.
        with threads(num_threads(1)):
            with self._freeze_lock:
                if shape not in self._frozen:
                    self._frozen[shape] = _freeze(self._network, image)
            return self._frozen[shape](image)


class _ThreadLimit:
    """`with threads(number)`: this many threads for PyTorch's operations; afterwards as many as
    before.

    PyTorch has one number for the process and one for each thread of Python. Several of these may
    be in here at once: what each leaves is the process's number from before the first came, not the
    one that another thread has set meanwhile.
    """

    def __init__(self) -> None:
        self._lock, self._thread_local = threading.Lock(), threading.local()
        self._num_users, self._process_threads = 0, 0

    @contextmanager
    def __call__(self, number: int) -> Iterator[None]:
        outer: int | None = getattr(self._thread_local, "number", None)
        with self._lock:
            # always asked: it makes a new thread take the process's number, which would else happen
            # later
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
    """The network for images of this shape, ready."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript calls itself outdated at every use
        frozen = torch.jit.freeze(torch.jit.trace(network, image))
    for _ in range(2):  # these compile
        frozen(image)
    return frozen


def to_channels_last(network: nn.Module) -> nn.Module:
    """The same network with its convolutions' weights laid out as they are fastest: channels
    last."""
    for value in network.state_dict(keep_vars=True).values():
        if value.ndim == 4:
            value.data = value.data.contiguous(memory_format=torch.channels_last)
    return network


def load_network_weights(network: nn.Module, arrays: Mapping[str, np.ndarray]) -> nn.Module:
    """Puts the weights that a map keeps, half floats under names that begin with ``network.``, into
    `network`.

    Raises:
        KeyError, RuntimeError: they do not fit.
    """
    state = {
        name.removeprefix("network."): torch.from_numpy(value)
        for name, value in arrays.items()
        if name.startswith("network.")
    }
    network.load_state_dict(
        {
            name: value.float() if value.is_floating_point() else value
            for name, value in state.items()
        }
    )
    return network
