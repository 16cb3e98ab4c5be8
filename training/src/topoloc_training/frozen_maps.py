"""Compute the outputs of the frozen layers for the mapping images once, which makes training
faster."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int
from torch import Generator, Tensor, nn

from topoloc_training.augmentation import augment
from topoloc_training.backbones import normalize_images
from topoloc_training.classifier_config import CnnFcConfig
from topoloc_training.inference import BATCH_SIZE
from topoloc_training.training_set import Progress

MAX_BYTES = 1_000_000_000
"""Of all maps that are kept."""
_MOST = 6e4  # half floats end at 65504


class FrozenMaps:
    """Hold feature maps of augmented copies of images, as half floats.

    Nothing is kept if no layer is frozen, or if one copy of each image would exceed `MAX_BYTES`.
    Images are then augmented at each use.

    Args:
        trunk: the frozen layers, from normalised images (n, 3, h, w) to maps (n, c, h', w').
        pictures: bytes (n, h, w, 3).
        rows: the images that will be used.
    """

    def __init__(
        self,
        trunk: nn.Sequential,
        pictures: Tensor,
        rows: Int[np.ndarray, " m"],
        config: CnnFcConfig,
        progress: Progress,
    ) -> None:
        self._trunk, self._pictures, self._config = trunk, pictures, config.augmentation
        one = plain_maps(trunk, pictures[:1])
        num_copies = (
            min(config.num_copies, MAX_BYTES // (one.nbytes * len(rows))) if len(trunk) else 0
        )
        self._maps = torch.empty((num_copies, len(rows), *one.shape[1:]), dtype=one.dtype)
        self._place = torch.zeros(len(pictures), dtype=torch.int64)
        self._place[torch.from_numpy(rows)] = torch.arange(len(rows))
        generator = torch.Generator().manual_seed(config.training.seed)
        for number, maps in enumerate(self._maps):
            for batch in torch.from_numpy(rows).split(BATCH_SIZE):
                maps[self._place[batch]] = _half(self._varied(batch, generator))
            progress("varied copies", number + 1, num_copies)

    def drawn(self, rows: Int[Tensor, " n"], generator: Generator) -> Tensor:
        """Maps (n, c, h', w') of one copy of each of these pictures."""
        if len(self._maps) == 0:
            return self._varied(rows, generator)
        copies = torch.randint(len(self._maps), (len(rows),), generator=generator)
        return self._maps[copies, self._place[rows]].float()

    def _varied(self, rows: Int[Tensor, " n"], generator: Generator) -> Tensor:
        self._trunk.eval()  # the training of the layers behind says otherwise
        with torch.no_grad():
            return self._trunk(augment(self._pictures[rows], self._config, generator)).float()


def plain_maps(trunk: nn.Sequential, pictures: Tensor) -> Tensor:
    """Return the outputs of the frozen layers for unchanged images, as half floats."""
    trunk.eval()
    with torch.no_grad():
        return torch.cat(
            [_half(trunk(normalize_images(batch))) for batch in pictures.split(BATCH_SIZE)]
        )


def _half(maps: Tensor) -> Tensor:
    return maps.clamp(-_MOST, _MOST).half()
