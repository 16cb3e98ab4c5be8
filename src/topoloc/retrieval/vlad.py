"""surf-vlad: VLAD of the map's own local features (Jegou et al. 2010), no weights, no torch.

The vocabulary is learnt from the map's descriptors, each with its place in the picture behind it
(Koniusz et al. 2013, spatial coordinate coding): neighbouring nodes see the same things, but
elsewhere, and so do places that repeat their doors and lamps. Residuals are normalised one by one
(Delhumeau et al. 2013), each word's sum is normalised on its own (Arandjelovic & Zisserman 2013),
and the whole is whitened by the PCA of the mapping images where there are enough of them to learn
it from. Where the features come from a network that also says what it saw in each cell of the
picture, that has half of the say (`cell_grid.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float32, Int

from topoloc.bounds import AtLeast, Between, parse_settings
from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.retrieval.cell_grid import CellGrid
from topoloc.retrieval.coarse import CoarseModel, Image, NodeScore, model_array
from topoloc.retrieval.descriptor_index import DescriptorIndex, learn_visual_words, learn_whitening
from topoloc.retrieval.descriptor_kernels import add_residuals, multiply_rows

_BLOCK = 1024  # vectors whitened at a time
_MIN_GROUP_SIZE = 8  # images whose mean vector says something of them all
# of what sets groups apart; all of it costs more where every group covers the whole place
# (docs/journal/retrieval.md)
_SUPPRESSED_SHARE = 0.5


@dataclass(frozen=True)
class VladConfig:
    """Settings of surf-vlad."""

    num_words: Annotated[int, Between(1, 65_536)] = 64
    """Visual words of the vocabulary."""
    position_weight: Annotated[float | None, AtLeast(0)] = None
    """How far two descriptors (of length 1) are apart for lying at opposite borders of the picture;
    0 leaves their places out. Unset: what suits the kind of features."""
    dimension: Annotated[int, Between(1, 65_536)] = 128
    """Length of a place vector after PCA, at most."""
    max_training_descriptors: Annotated[int, AtLeast(1)] = 100_000
    """Descriptors that the vocabulary is learnt from, at most."""
    seed: Annotated[int, Between(0, 1_000_000_000)] = 0
    """Of the vocabulary."""


class SurfVlad:
    """The coarse localizer `surf-vlad`."""

    name = "surf-vlad"

    def __init__(
        self,
        words: Float32[np.ndarray, "k d"],
        mean: Float32[np.ndarray, " kd"],
        projection: Float32[np.ndarray, "p kd"],
        vectors: Float32[np.ndarray, "n p"],
        node_ids: Int[np.ndarray, " n"],
        config: VladConfig,
        grid: CellGrid | None = None,
    ) -> None:
        self._grid = grid
        self._words, self._mean, self._projection, self._vectors = words, mean, projection, vectors
        self._node_ids, self._config = node_ids, config
        self._index = DescriptorIndex(vectors, node_ids)

    @staticmethod
    def fit(
        words: Float32[np.ndarray, "k d"],
        vlads: Float32[np.ndarray, "n kd"] | Sequence[Float32[np.ndarray, " kd"]],
        node_ids: Int[np.ndarray, " n"],
        config: VladConfig,
        cells: Sequence[Float32[np.ndarray, "rows columns c"] | None] = (),
    ) -> SurfVlad:
        """From the vocabulary (`learn_words`), the `vlad` of each mapping image's
        `append_positions` features, the node it belongs to and its cells, where the kind of
        features has them."""
        whitening, known = (
            learn_whitening(vlads, config.dimension),
            [one for one in cells if one is not None],
        )
        grid = CellGrid.fit(np.stack(known)) if len(known) == len(vlads) else None
        starts = range(0, len(vlads), _BLOCK)
        vectors = np.concatenate(
            [whitening.apply(np.stack([*vlads[start : start + _BLOCK]])) for start in starts]
        )
        return SurfVlad(
            words, whitening.mean, whitening.projection, vectors, node_ids, config, grid
        )

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """See `CoarseLocalizer.rank`; of the picture itself only the size is looked at. Features
        without cells are ranked by VLAD alone."""
        height, width = image.shape[:2]
        vector = self._global_descriptor(features, width, height)
        if self._grid is None or features.cells is None:
            return self._index.rank_nodes(vector, num_candidates)
        images, similarities = self._index.nearest(vector)
        return self._index.rank_images(
            images,
            0.5 * (similarities + self._grid.compute_similarity(features.cells, images)),
            num_candidates,
        )

    def _global_descriptor(
        self, features: Features, width: int, height: int
    ) -> Float32[np.ndarray, " p"]:
        vector = np.empty(len(self._projection), np.float32)
        descriptors = append_positions(features, width, height, self._config)
        if descriptors.shape[1] != self._words.shape[1]:
            raise MapError(
                f"the map's coarse localizer {self.name!r} is damaged: its words are not those of"
                " the map's features"
            )
        multiply_rows(self._projection, vlad(descriptors, self._words) - self._mean, vector)
        vector /= max(float(np.linalg.norm(vector)), 1e-6)
        return vector

    def extend_with_features(
        self,
        images_with_features: Sequence[tuple[Features, int, int]],
        node_ids: Int[np.ndarray, " m"],
    ) -> SurfVlad:
        """With further mapping images, by the vocabulary and the whitening that are there.

        Args:
            pictures: of each its features, width and height (pixels); where the others have cells,
                these must, too.
            node_ids: the node that each belongs to.
        """
        vectors = np.stack(
            [self._global_descriptor(*image_features) for image_features in images_with_features]
        )
        cells = [
            features.cells for features, _, _ in images_with_features if features.cells is not None
        ]
        grid = (
            self._grid.with_cells(np.stack(cells))
            if self._grid is not None and len(cells) == len(images_with_features)
            else None
        )
        all_ids = np.concatenate([self._node_ids, node_ids.astype(self._node_ids.dtype)])
        return SurfVlad(
            self._words,
            self._mean,
            self._projection,
            np.concatenate([self._vectors, vectors]),
            all_ids,
            self._config,
            grid,
        )

    def suppress_group_differences(self, group_of_node: Int[np.ndarray, " nodes"]) -> SurfVlad:
        """The same with less of what sets groups of nodes apart on the whole, such as the light in
        which they were taken: all vectors are halved along the directions between the mean vectors
        of the groups' images.

        A picture would else be like all pictures of its light before it is like any of its place.
        Groups of fewer than eight images say nothing sure of theirs.

        Args:
            group_of_node: the group of each node that `node_ids` may name.
        """
        groups = group_of_node[self._node_ids]
        numbers, counts = np.unique(groups, return_counts=True)
        means = [
            self._vectors[groups == number].mean(axis=0)
            for number in numbers[counts >= _MIN_GROUP_SIZE]
        ]
        if len(means) < 2:
            return self
        _, lengths, axes = np.linalg.svd(np.stack(means[1:]) - means[0], full_matrices=False)
        axes = axes[lengths > 1e-4].astype(np.float32)
        projection = np.ascontiguousarray(
            self._projection - _SUPPRESSED_SHARE * axes.T @ (axes @ self._projection)
        )
        vectors = self._vectors - _SUPPRESSED_SHARE * (self._vectors @ axes.T) @ axes
        vectors = np.ascontiguousarray(
            vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)
        )
        return SurfVlad(
            self._words, self._mean, projection, vectors, self._node_ids, self._config, self._grid
        )

    def to_model(self) -> CoarseModel:
        """What the map file keeps: vectors as half floats, a quarter of a kilobyte to half of one
        an image."""
        arrays = {
            "words": self._words,
            "mean": self._mean,
            "projection": self._projection.astype(np.float16),
        }
        arrays |= {
            "vectors": self._vectors.astype(np.float16),
            "node_ids": self._node_ids.astype(np.int32),
        }
        return CoarseModel(
            self.name,
            asdict(self._config),
            arrays | (self._grid.to_arrays() if self._grid is not None else {}),
        )

    @staticmethod
    def from_model(model: CoarseModel) -> SurfVlad:
        """The inverse of `to_model`. Raises MapError where the arrays do not belong together, for
        kernels trust them, and ConfigError."""
        config = parse_settings(VladConfig, {"position_weight": 0.0, **model.settings}, "settings")
        words = model_array(model, "words", "f", (None, None)).astype(np.float32, copy=False)
        projection = model_array(model, "projection", "f", (None, words.size)).astype(np.float32)
        mean = model_array(model, "mean", "f", (words.size,)).astype(np.float32, copy=False)
        vectors = model_array(model, "vectors", "f", (None, len(projection))).astype(np.float32)
        node_ids = model_array(model, "node_ids", "iu", (len(vectors),))
        return SurfVlad(
            words,
            mean,
            projection,
            vectors,
            node_ids,
            config,
            CellGrid.from_model(model, len(vectors)),
        )


open_model = SurfVlad.from_model


def append_positions(
    features: Features, width: int, height: int, config: VladConfig
) -> Float32[np.ndarray, "n d"]:
    """Descriptors with their places in a picture of that size behind them; as they are where places
    do not count."""
    if not config.position_weight:
        return features.descriptors
    places = (features.points_img + 0.5) / np.array([width, height], np.float32) - 0.5
    return np.hstack([features.descriptors, config.position_weight * places]).astype(np.float32)


def vlad(
    descriptors: Float32[np.ndarray, "n d"], words: Float32[np.ndarray, "k d"]
) -> Float32[np.ndarray, " kd"]:
    """VLAD of descriptors over `words`; zero for an image without features."""
    sums = np.zeros(words.shape, np.float32)
    half_squares = 0.5 * np.sum(words**2, axis=1)
    add_residuals(
        np.ascontiguousarray(descriptors), np.ascontiguousarray(words), half_squares, sums
    )
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-6)
    flat = sums.reshape(-1)
    return flat / max(float(np.linalg.norm(flat)), 1e-6)


def learn_words(
    descriptors: Float32[np.ndarray, "n d"], config: VladConfig
) -> Float32[np.ndarray, "k d"]:
    """The visual words: k-means centres of the map's descriptors, fewer where there are few of
    them."""
    return learn_words_from_parts([len(descriptors)], lambda _: descriptors, config)


def learn_words_from_parts(
    num_rows: Sequence[int], part: Callable[[int], Float32[np.ndarray, "_ d"]], config: VladConfig
) -> Float32[np.ndarray, "k d"]:
    """As `learn_words` of many parts one after the other, of which one at a time is in memory.

    Args:
        num_rows: how many descriptors each part has.
        part: a part by its number.
    """
    ends = np.cumsum(num_rows)
    chosen, total = np.arange(ends[-1]), int(ends[-1])
    if total > config.max_training_descriptors:
        chosen = np.sort(
            np.random.default_rng(config.seed).choice(
                total, config.max_training_descriptors, replace=False
            )
        )
    of_parts = np.split(chosen, np.searchsorted(chosen, ends[:-1]))
    rows = [
        part(k)[rows - (ends[k] - num_rows[k])]
        for k, rows in enumerate(of_parts)
        if len(rows) or k == 0
    ]
    return learn_visual_words(np.concatenate(rows), config.num_words, config.seed)
