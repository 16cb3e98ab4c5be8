"""Rank nodes by VLAD of the map's own local features (Jegou et al. 2010), without weights or torch:
surf-vlad.

The vocabulary is learned from the map's descriptors, each with its image position appended (Koniusz
et al. 2013, spatial coordinate coding). Neighbouring nodes see the same objects at other positions,
and so do similar places with repeated doors and lamps.

Residuals are normalised one by one (Delhumeau et al. 2013). Each word's sum is normalised
separately (Arandjelovic & Zisserman 2013). The vector is whitened by the PCA of the mapping images.
If the features have image cells, the cells contribute half of the score.

VLAD of key points is precise but depends on the image positions of features, so it fails away from
the mapped path. Cells are less precise but robust to darkness. Beside the mapped path, the same
objects appear in other columns. So two grids are compared at several column shifts, and the best
one counts. Each cell is the mean of a network level there (`Features.cells`). The mean of that cell
over the mapping images is subtracted. The channels are whitened by PCA, and the cell is scaled to
unit length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict

import numpy as np
from jaxtyping import Float32, Int, Int8

from topoloc.bounds import drop_removed_settings, parse_settings
from topoloc.errors import MapError
from topoloc.features.features import Features
from topoloc.retrieval.coarse import CoarseModel, Image, NodeScore, VladConfig, model_array
from topoloc.retrieval.descriptor_index import (
    DescriptorIndex,
    add_residuals,
    learn_visual_words,
    learn_whitening,
    max_shifted_products,
    multiply_rows,
    pack_projection,
    unpack_projection,
)

DIMENSION = 32
"""Maximum length of a cell's vector after PCA."""
# This fraction of the mean variance is added to each axis: the weakest axes are noise.
_VARIANCE_REGULARIZATION = 0.1
_MAX_SHIFT = 1  # columns
_MAX_VALUE = 1e6  # far above the values of any network
_SCALE = np.float32(127.0)  # of a cell's components, which are stored as signed bytes


class CellGrid:
    """Hold the cells of all mapping images.

    Args:
        mean: (columns, rows, c) mean over the mapping images. Columns come first, so that a shifted
            grid is contiguous.
        projection: (d, c) projection of a cell's channels.
        vectors: (n, columns * rows * d) vectors of the mapping images, each cell with length 127.
    """

    def __init__(
        self,
        mean: Float32[np.ndarray, "columns rows c"],
        projection: Float32[np.ndarray, "d c"],
        vectors: Int8[np.ndarray, "n m"],
    ) -> None:
        self._mean, self._projection, self._stored = mean, projection, vectors
        self._vectors = vectors.astype(np.float32) / _SCALE

    @staticmethod
    def fit(cells: Float32[np.ndarray, "n rows columns c"], dimension: int = DIMENSION) -> CellGrid:
        """Create the grid from the cells of all mapping images."""
        by_column = np.ascontiguousarray(cells.transpose(0, 2, 1, 3))
        mean, channels = by_column.mean(axis=0), by_column.shape[3]
        centred = (by_column - mean).reshape(-1, channels)
        # One image, or all alike: without the common part nothing would remain.
        if float(np.abs(centred).max()) < 1e-6:
            mean, centred = np.zeros_like(mean), by_column.reshape(-1, channels)
        variances, axes = np.linalg.eigh(centred.T.astype(np.float64) @ centred / len(centred))
        variances, axes = variances[::-1][:dimension], axes[:, ::-1][:, :dimension]
        relative = np.maximum(variances, 0.0) / max(float(variances.mean()), 1e-12)
        regularized = np.sqrt(relative + _VARIANCE_REGULARIZATION)
        # rounded as in the map file, so that results do not change when the map is stored
        projection = (axes / regularized).T.astype(np.float16).astype(np.float32)
        parts = np.array_split(by_column, -(-len(cells) // 256))
        vectors = np.concatenate([_normalize_cells(part, mean, projection) for part in parts])
        return CellGrid(mean, projection, np.rint(_SCALE * vectors).astype(np.int8))

    def with_cells(self, cells: Float32[np.ndarray, "n rows columns c"]) -> CellGrid:
        """Return the grid with the cells of further mapping images. Mean and projection are
        unchanged."""
        by_column = np.ascontiguousarray(cells.transpose(0, 2, 1, 3))
        added = _normalize_cells(by_column, self._mean, self._projection)
        stored = np.concatenate([self._stored, np.rint(_SCALE * added).astype(np.int8)])
        return CellGrid(self._mean, self._projection, stored)

    def compute_similarity(
        self, cells: Float32[np.ndarray, "rows columns c"], images: Int[np.ndarray, " k"]
    ) -> Float32[np.ndarray, " k"]:
        """Return the mean cosine between the cells of a query image and those of each of these
        mapping images, at the best shift.

        Raises:
            MapError: the cells have another form than the map's.
        """
        columns, rows = self._mean.shape[:2]
        by_column = np.ascontiguousarray(cells.transpose(1, 0, 2)[None])
        if by_column.shape[1:] != self._mean.shape:
            raise MapError("the map's cells are not of the form that its features have")
        vector = _normalize_cells(by_column, self._mean, self._projection)[0]
        products, max_shift = np.empty(len(images), np.float32), min(_MAX_SHIFT, columns - 1)
        max_shifted_products(
            self._vectors, images, vector, len(vector) // columns, max_shift, products
        )
        return products / np.float32(rows)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays stored in the map file, with one byte per vector component."""
        return {
            "cell_mean": self._mean,
            "cell_projection": self._projection.astype(np.float16),
            "cell_vectors": self._stored,
        }

    @staticmethod
    def from_model(model: CoarseModel, num_images: int) -> CellGrid | None:
        """Create the grid from `to_arrays`. Return None if the model has no cells. Raises MapError
        if the arrays are inconsistent."""
        if "cell_vectors" not in model.arrays:
            return None
        mean = model_array(model, "cell_mean", "f", (None, None, None)).astype(np.float32)
        shape = None, mean.shape[2]
        projection = model_array(model, "cell_projection", "f", shape).astype(np.float32)
        if not max(float(np.abs(mean).max()), float(np.abs(projection).max())) < _MAX_VALUE:
            raise MapError(
                f"the map's coarse localizer {model.name!r} is damaged: cells beyond {_MAX_VALUE:g}"
            )
        length = mean.shape[0] * mean.shape[1] * len(projection)
        vectors = model_array(model, "cell_vectors", "i", (num_images, length))
        return CellGrid(mean, projection, vectors.astype(np.int8))


def _normalize_cells(
    cells: Float32[np.ndarray, "n columns rows c"],
    mean: Float32[np.ndarray, "columns rows c"],
    projection: Float32[np.ndarray, "d c"],
) -> Float32[np.ndarray, "n m"]:
    """Centre and project each cell and scale it to unit length. The cells of an image are
    concatenated column by column."""
    projected = (cells - mean) @ projection.T
    projected /= np.maximum(np.linalg.norm(projected, axis=3, keepdims=True), 1e-6)
    return np.ascontiguousarray(projected.reshape(len(cells), -1), np.float32)


_BLOCK = 1024  # vectors whitened at a time
_MIN_GROUP_SIZE = 8  # minimum number of images for a meaningful mean vector
# Fraction of the group differences that is removed. Removing all costs more if every group covers
# the whole place (docs/journal/retrieval.md).
_SUPPRESSED_SHARE = 0.5


class SurfVlad:
    """Implement the coarse localizer `surf-vlad`."""

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
        """Create the localizer from the mapping images.

        Args:
            words: vocabulary, from `learn_words`.
            vlads: `vlad` of each mapping image's `append_positions` features.
            node_ids: node of each mapping image.
            cells: cells of each mapping image, or None if the feature type has none.
        """
        whitening = learn_whitening(vlads, config.dimension)
        known = [cell for cell in cells if cell is not None]
        grid = CellGrid.fit(np.stack(known)) if len(known) == len(vlads) else None
        starts = range(0, len(vlads), _BLOCK)
        vectors = np.concatenate(
            [whitening.apply(np.stack([*vlads[start : start + _BLOCK]])) for start in starts]
        )
        mean, projection = whitening.mean, whitening.projection
        return SurfVlad(words, mean, projection, vectors, node_ids, config, grid)

    def rank(self, image: Image, features: Features, num_candidates: int) -> list[NodeScore]:
        """Rank nodes as in `CoarseLocalizer.rank`. Only the size of the image is used. Features
        without cells are ranked by VLAD alone."""
        height, width = image.shape[:2]
        vector = self._global_descriptor(features, width, height)
        if self._grid is None or features.cells is None:
            return self._index.rank_nodes(vector, num_candidates)
        images, similarities = self._index.nearest(vector)
        of_cells = self._grid.compute_similarity(features.cells, images)
        return self._index.rank_images(images, 0.5 * (similarities + of_cells), num_candidates)

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
        """Return the localizer extended by further mapping images. Vocabulary and whitening are
        unchanged. If any of these images has no cells, the result ranks by VLAD alone.

        Args:
            images_with_features: features, width and height (pixels) of each image.
            node_ids: node of each image.
        """
        vectors = np.stack([self._global_descriptor(*image) for image in images_with_features])
        cells = [
            features.cells for features, _, _ in images_with_features if features.cells is not None
        ]
        grid = (
            self._grid.with_cells(np.stack(cells))
            if self._grid is not None and len(cells) == len(images_with_features)
            else None
        )
        vectors = np.concatenate([self._vectors, vectors])
        node_ids = np.concatenate([self._node_ids, node_ids.astype(self._node_ids.dtype)])
        axes = self._mean, self._projection
        return SurfVlad(self._words, *axes, vectors, node_ids, self._config, grid)

    def suppress_group_differences(self, group_of_node: Int[np.ndarray, " nodes"]) -> SurfVlad:
        """Return a localizer with reduced differences between groups of nodes, such as the light of
        their recordings.

        All vectors are halved along the directions between the mean vectors of the groups' images.
        Otherwise a query would resemble all images in its light more than images of its place.
        Groups of fewer than eight images are ignored, because their mean is too uncertain.

        Args:
            group_of_node: the group of each node, by row.
        """
        groups = group_of_node[self._node_ids]
        numbers, counts = np.unique(groups, return_counts=True)
        large = numbers[counts >= _MIN_GROUP_SIZE]
        means = [self._vectors[groups == number].mean(axis=0) for number in large]
        if len(means) < 2:
            return self
        _, lengths, axes = np.linalg.svd(np.stack(means[1:]) - means[0], full_matrices=False)
        axes = axes[lengths > 1e-4].astype(np.float32)
        share = _SUPPRESSED_SHARE
        projection = np.ascontiguousarray(
            self._projection - share * axes.T @ (axes @ self._projection)
        )
        vectors = self._vectors - share * (self._vectors @ axes.T) @ axes
        lengths = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)
        vectors, own = np.ascontiguousarray(vectors / lengths), (self._node_ids, self._config)
        return SurfVlad(self._words, self._mean, projection, vectors, *own, self._grid)

    def to_model(self) -> CoarseModel:
        """Return the model stored in the map file. Vectors are half floats of a quarter to half a
        kilobyte per image, the projection is compressed bytes."""
        arrays = {
            "words": self._words,
            "mean": self._mean,
            **pack_projection(self._projection),
            "vectors": self._vectors.astype(np.float16),
            "node_ids": self._node_ids.astype(np.int32),
        }
        if self._grid is not None:
            arrays |= self._grid.to_arrays()
        return CoarseModel(self.name, asdict(self._config), arrays)

    @staticmethod
    def from_model(model: CoarseModel) -> SurfVlad:
        """Create the localizer from `to_model`. Raises MapError if the arrays are inconsistent,
        because the kernels do not check them, and ConfigError."""
        settings = drop_removed_settings(model.settings, "build.vlad")
        config = parse_settings(VladConfig, {"position_weight": 0.0, **settings}, "settings")
        words = model_array(model, "words", "f", (None, None)).astype(np.float32, copy=False)
        projection = unpack_projection(model, words.size)
        mean = model_array(model, "mean", "f", (words.size,)).astype(np.float32, copy=False)
        vectors = model_array(model, "vectors", "f", (None, len(projection))).astype(np.float32)
        node_ids = model_array(model, "node_ids", "iu", (len(vectors),))
        grid = CellGrid.from_model(model, len(vectors))
        return SurfVlad(words, mean, projection, vectors, node_ids, config, grid)


open_model = SurfVlad.from_model


def append_positions(
    features: Features, width: int, height: int, config: VladConfig
) -> Float32[np.ndarray, "n d"]:
    """Return descriptors with their positions in an image of that size appended. With a position
    weight of 0 descriptors are unchanged."""
    if not config.position_weight:
        return features.descriptors
    positions = (features.points_img + 0.5) / np.array([width, height], np.float32) - 0.5
    return np.hstack([features.descriptors, config.position_weight * positions]).astype(np.float32)


def vlad(
    descriptors: Float32[np.ndarray, "n d"], words: Float32[np.ndarray, "k d"]
) -> Float32[np.ndarray, " kd"]:
    """Return the VLAD of descriptors over `words`, zero for an image without features."""
    sums = np.zeros(words.shape, np.float32)
    half_squares = 0.5 * np.sum(words**2, axis=1)
    add_residuals(*map(np.ascontiguousarray, (descriptors, words)), half_squares, sums)
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-6)
    flat = sums.reshape(-1)
    return flat / max(float(np.linalg.norm(flat)), 1e-6)


def learn_words(
    descriptors: Float32[np.ndarray, "n d"], config: VladConfig
) -> Float32[np.ndarray, "k d"]:
    """Return the visual words: k-means centres of the map's descriptors, fewer if there are few
    descriptors."""
    return learn_words_from_parts([len(descriptors)], lambda _: descriptors, config)


def learn_words_from_parts(
    num_rows: Sequence[int],
    part: Callable[[int], Float32[np.ndarray, "_ d"]],
    config: VladConfig,
    max_descriptors: int = 100_000,
) -> Float32[np.ndarray, "k d"]:
    """Learn the words of `learn_words` from several parts, with one part in memory at a time.

    Args:
        num_rows: number of descriptors in each part.
        part: function that returns a part by its number.
        max_descriptors: maximum number of descriptors from which the words are learned.
    """
    ends = np.cumsum(num_rows)
    chosen, total = np.arange(ends[-1]), int(ends[-1])
    if total > max_descriptors:
        generator = np.random.default_rng(config.seed)
        chosen = np.sort(generator.choice(total, max_descriptors, replace=False))
    rows = [
        part(k)[rows - (ends[k] - num_rows[k])]
        for k, rows in enumerate(np.split(chosen, np.searchsorted(chosen, ends[:-1])))
        if len(rows) or k == 0
    ]
    return learn_visual_words(np.concatenate(rows), config.num_words, config.seed)
