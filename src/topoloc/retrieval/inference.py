"""Run a trained network on single images and on batches, in the fastest way for this processor.
Rank nodes by a network that computes global descriptors: cnn-nn and vlad-nn.

If the processor multiplies bfloat16 in hardware, bfloat16 is used. Otherwise single precision is
used, and a network for single images is frozen into TorchScript. Its fused calls save a third of a
small network's time (docs/journal/retrieval.md).
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, Int
from torch import Tensor, nn

from topoloc.compiled import num_threads
from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.retrieval.backbones import normalize_images
from topoloc.retrieval.coarse import CoarseModel, Image, NodeScore, model_array, read_setting
from topoloc.retrieval.descriptor_index import DescriptorIndex, Whitening, unpack_projection
from topoloc.retrieval.network_images import (
    ImageShape,
    NetworkInputConfig,
    RgbImages,
    prepare_network_images,
)

BATCH_SIZE = 16
_CHUNK = 64  # images that are prepared for the network together


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


def load_network_weights(network: nn.Module, arrays: Mapping[str, np.ndarray]) -> nn.Module:
    """Load the weights stored in a map into `network`. They are half floats under names that begin
    with ``network.``.

    Raises:
        KeyError, RuntimeError: the weights do not fit the network.
    """
    state = {
        name.removeprefix("network."): torch.from_numpy(value)
        for name, value in arrays.items()
        if name.startswith("network.")
    }
    is_real = {name: value.is_floating_point() for name, value in state.items()}
    network.load_state_dict({k: v.float() if is_real[k] else v for k, v in state.items()})
    return network


class NetworkDescriptorLocalizer:
    """Implement the coarse localizers `cnn-nn` and `vlad-nn`.

    Raises:
        MapError: the model's arrays are inconsistent.
    """

    def __init__(
        self, model: CoarseModel, network: nn.Module, input_config: NetworkInputConfig
    ) -> None:
        self._model, self._input_config = model, input_config
        try:
            self._shape = ImageShape(*read_setting(model, "picture_shape", tuple[int, int]))
            self._predict = Predictor(load_network_weights(network, model.arrays))
        except (KeyError, RuntimeError, ValueError) as error:
            raise MapError(
                f"the map's coarse localizer {model.name!r} is damaged:"
                f" {' '.join(str(error).split())[:200]}"
            ) from error
        mean = model_array(model, "mean", "f", (None,)).astype(np.float32, copy=False)
        projection = unpack_projection(model, len(mean))
        vectors = model_array(model, "vectors", "f", (None, len(projection))).astype(np.float32)
        self._whitening = Whitening(mean, projection)
        node_rows = model_array(model, "node_ids", "iu", (len(vectors),))
        self._index = DescriptorIndex(vectors, node_rows)

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Rank nodes as in `CoarseLocalizer.rank`. Scores are cosines. The local features are not
        used."""
        return self._index.rank_nodes(self.vectors([image])[0], num_candidates)

    def rank_batch(self, images: Sequence[Image], num_candidates: int) -> list[list[NodeScore]]:
        """Rank nodes for many images, which pass through the network together."""
        return [self._index.rank_nodes(vector, num_candidates) for vector in self.vectors(images)]

    def extend_with_images(
        self, images: Sequence[Image], node_ids: Int[np.ndarray, " n"]
    ) -> CoarseModel:
        """Return the model extended by the descriptors of these images (see `ExtendableLocalizer`).
        The whitening is unchanged."""
        known = self._model.arrays
        parts = [self.vectors(images[k : k + _CHUNK]) for k in range(0, len(images), _CHUNK)]
        dtype = known["vectors"].dtype
        vectors = np.concatenate([known["vectors"], *(part.astype(dtype) for part in parts)])
        all_node_ids = np.concatenate([known["node_ids"], node_ids.astype(known["node_ids"].dtype)])
        return replace(self._model, arrays={**known, "vectors": vectors, "node_ids": all_node_ids})

    def vectors(self, images: Sequence[Image]) -> Float32[np.ndarray, "n d"]:
        """Return the unit vectors of the images.

        Raises:
            MapError: the whitening does not fit the network.
        """
        raw = self._predict(prepare_network_images(images, self._shape, self._input_config))
        if raw.shape[1] != len(self._whitening.mean):
            raise MapError(
                f"the map's coarse localizer {self._model.name!r} is damaged: its whitening is not"
                " that of its network"
            )
        return self._whitening.apply(raw)
