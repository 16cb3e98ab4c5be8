"""Compare images by the mean network output of each image cell (`Features.cells`), as a complement
to VLAD.

VLAD of key points is precise but depends on the image positions of features, so it fails away from
the mapped path. Cells are less precise but robust to darkness. Beside the mapped path, the same
objects appear in other columns. So two grids are compared at several column shifts, and the best
one counts.

Each cell is the mean of a network level there. The mean of that cell over the mapping images is
subtracted. The channels are whitened by PCA, and the cell is scaled to unit length.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int, Int8

from topoloc.errors import MapError
from topoloc.retrieval.coarse import CoarseModel, model_array
from topoloc.retrieval.descriptor_kernels import max_shifted_products

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
