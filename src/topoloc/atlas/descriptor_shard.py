"""A shard of an atlas's index: the global descriptors of many tiles for one feature type.

A shard of more than 8,192 descriptors needs FAISS (extra `atlas`). It stores a product-quantised
code of each descriptor (4 bits for two components) in the cell of its nearest centre. A query
searches the nearest eighth of the cells, at least 96. The candidates nearest by code are then
compared by their full vectors. These are half floats in a memory-mapped file, so only used pages
are loaded and processes share them. One file holds the shard with a checksum. It can be rebuilt at
any time.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float16, Float32, Int

from topoloc.errors import AtlasError, MissingExtraError
from topoloc.recordings.atomic import atomic_write
from topoloc.retrieval.descriptor_index import single_faiss_thread

NUM_COMPARED, MAX_COMPARED = 1024, 16_384
"""Number of candidates compared by full vectors. If they belong to too few tiles, it grows by eight
times, up to the second number."""
MAX_ROWS_COMPARED = 8_192
"""Selected tiles with no more descriptors than this are compared exhaustively."""
_MIN_PROBES, _CELLS_PER_PROBE, _MAX_CELLS = 96, 8, 4096
_NUM_TRAINING_VECTORS, _CHUNK = 65_536, 65_536
_MAGIC, _ALIGNMENT = b"topoloc-places-1\n", 4096
_DAMAGE = (OSError, ValueError, TypeError, KeyError, RuntimeError, OverflowError)
"""Errors of a damaged file. RecursionError is a RuntimeError."""


@dataclass(frozen=True)
class ShardTile:
    """Describe a tile in a shard: its id, the checksum of its descriptor file, and its number of
    rows."""

    tile_id: str
    sha256: str
    num_rows: int


class DescriptorShard:
    """Hold the global descriptors of some tiles, tile after tile.

    Args:
        kind: the feature type.
        vocabulary: version of the vocabulary of the vectors.
        tiles: the tiles, in the order of their vectors.
        vectors: unit vectors of all tiles.
        codes: FAISS index of the vectors. None: it is built, if there are so many.
    """

    def __init__(
        self,
        kind: str,
        vocabulary: str,
        tiles: Sequence[ShardTile],
        vectors: Float16[np.ndarray, "n d"],
        codes: Any = None,
    ) -> None:
        self.kind, self.vocabulary = kind, vocabulary
        self.tiles, self.vectors = list(tiles), vectors
        self.bounds: Int[np.ndarray, " _"] = np.cumsum([0, *(tile.num_rows for tile in tiles)])
        is_large = len(vectors) > MAX_ROWS_COMPARED
        self._codes: Any = _build_codes(vectors) if codes is None and is_large else codes
        self._chosen: tuple[bytes, Any] | None = None

    @property
    def name(self) -> str:
        """Return the file name, a digest of the contents."""
        contents = json.dumps([self.kind, self.vocabulary, [astuple(tile) for tile in self.tiles]])
        return f"{hashlib.sha256(contents.encode()).hexdigest()[:32]}.index"

    def rank(
        self, vector: Float32[np.ndarray, " d"], num_tiles: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        """Rank the tiles by their most similar node.

        Args:
            num_tiles: maximum number of returned tiles.
            is_selected: mask of the tiles that may be returned.

        Returns:
            Indices into `tiles`, best first, and the similarity of each tile's best node.
        """
        num_asked, count = int(is_selected.sum()), max(NUM_COMPARED, 16 * num_tiles)
        while True:
            rows, similarities = self.nearest(vector, count, is_selected)
            tiles, first = np.unique(
                np.searchsorted(self.bounds, rows, "right") - 1, return_index=True
            )
            if len(tiles) >= min(num_tiles, num_asked) or count >= MAX_COMPARED:
                best = np.argsort(first)[:num_tiles]
                return tiles[best], similarities[first[best]]
            count *= 8

    def nearest(
        self, vector: Float32[np.ndarray, " d"], count: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        """Return the rows of about `count` most similar nodes of the selected tiles, and the
        similarities.

        The nearest comes first. If the tiles have few rows, all are compared. Otherwise the
        candidates come from the codes.
        """
        asked = np.flatnonzero(is_selected)
        num_rows = int((self.bounds[asked + 1] - self.bounds[asked]).sum())
        if num_rows <= MAX_ROWS_COMPARED:
            spans = [np.arange(self.bounds[tile], self.bounds[tile + 1]) for tile in asked]
            rows = np.concatenate(spans) if spans else np.zeros(0, np.int64)
        else:
            chosen = None if len(asked) == len(is_selected) else self._select_tile_rows(is_selected)
            num_cells = self._codes.nlist
            num_probes = min(num_cells, max(_MIN_PROBES, round(num_cells / _CELLS_PER_PROBE)))
            parameters = _faiss().SearchParametersIVF(nprobe=num_probes, sel=chosen)
            with single_faiss_thread():
                found = self._codes.search(vector[None], min(count, num_rows), params=parameters)
            rows = found[1][0][found[1][0] >= 0]
        similarities = self.vectors[rows].astype(np.float32) @ vector
        order = np.argsort(-similarities, kind="stable")
        return rows[order], similarities[order]

    def _select_tile_rows(self, is_selected: Bool[np.ndarray, " t"]) -> Any:
        """Return FAISS's filter for the rows of these tiles.

        The last filter is cached, because consecutive queries mostly select the same tiles.
        """
        key, known = is_selected.tobytes(), self._chosen
        if known is None or known[0] != key:
            bits = np.packbits(np.repeat(is_selected, np.diff(self.bounds)), bitorder="little")
            self._chosen = known = key, _faiss().IDSelectorBitmap(bits)
        return known[1]

    def save(self, folder: Path) -> Path:
        """Write the file atomically.

        Raises:
            OSError: it cannot be written.
        """
        has_codes = self._codes is not None
        codes = _faiss().serialize_index(self._codes).tobytes() if has_codes else b""
        facts = {
            "kind": self.kind,
            "vocabulary": self.vocabulary,
            "tiles": [astuple(tile) for tile in self.tiles],
            "shape": self.vectors.shape,
            "num_bytes_of_codes": len(codes),
        }
        header = json.dumps(facts).encode()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / self.name
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            digest = hashlib.sha256()

            def write(data: Any) -> None:
                digest.update(data)
                file.write(data)

            file.write(_MAGIC + bytes(32))
            write(len(header).to_bytes(8, "little") + header)
            write(codes)
            write(bytes(-file.tell() % _ALIGNMENT))
            for start in range(0, len(self.vectors), _CHUNK):
                write(np.ascontiguousarray(self.vectors[start : start + _CHUNK]).data)
            file.seek(len(_MAGIC))
            file.write(digest.digest())
        return path

    @staticmethod
    def open(path: Path) -> DescriptorShard:
        """Open a saved shard with memory-mapped vectors.

        Raises:
            AtlasError: the file is missing, damaged or no shard.
        """
        try:
            return _opened(path)
        except _DAMAGE as error:
            fault = " ".join(str(error).split())[:120]
            raise AtlasError(f"{path} is missing or damaged: {fault}") from None


def _opened(path: Path) -> DescriptorShard:
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it is no index of places")
        expected = file.read(32)
        if hashlib.file_digest(file, "sha256").digest() != expected:
            raise ValueError("its checksum is another")
        file.seek(len(_MAGIC) + 32)
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        data = np.frombuffer(file.read(header["num_bytes_of_codes"]), np.uint8)
        codes = _faiss().deserialize_index(data) if len(data) else None
        start = file.tell() + -file.tell() % _ALIGNMENT
    num_rows, dimension = header["shape"]
    mapped = np.memmap(path, np.float16, "r", start, (num_rows, dimension))
    tiles = [ShardTile(*tile) for tile in header["tiles"]]
    of_codes = (num_rows, dimension) if codes is None else (codes.ntotal, codes.d)
    is_small = num_rows <= MAX_ROWS_COMPARED
    if (*of_codes, sum(tile.num_rows for tile in tiles)) != (num_rows, dimension, num_rows) or (
        codes is None and not is_small
    ):
        raise ValueError("its parts do not belong together")
    return DescriptorShard(header["kind"], header["vocabulary"], tiles, np.asarray(mapped), codes)


def _build_codes(vectors: Float16[np.ndarray, "n d"]) -> Any:
    """Build the FAISS index: k-means cells of a sample, and the codes of all vectors."""
    faiss = _faiss()
    num_rows, dimension = vectors.shape
    num_cells = max(1, min(round(math.sqrt(num_rows)), _MAX_CELLS))
    num_parts = dimension // 2 if dimension % 2 == 0 else dimension
    cells, metric = faiss.IndexFlatIP(dimension), faiss.METRIC_INNER_PRODUCT
    index = faiss.IndexIVFPQFastScan(cells, dimension, num_cells, num_parts, 4, metric, 32, True)
    index.cp.niter, index.cp.seed, index.cp.min_points_per_centroid = 8, 1, 1
    index.pq.cp.min_points_per_centroid = 1
    sample = np.sort(np.random.default_rng(1).permutation(num_rows)[:_NUM_TRAINING_VECTORS])
    with single_faiss_thread():
        index.train(vectors[sample].astype(np.float32))
        for start in range(0, num_rows, _CHUNK):
            index.add(vectors[start : start + _CHUNK].astype(np.float32))
    return index


def _faiss() -> Any:  # its type stubs lack overloads
    """Return FAISS. Raises MissingExtraError."""
    need = f"an atlas of more than {MAX_ROWS_COMPARED} images needs FAISS"
    with MissingExtraError.on_import(need, "atlas"):
        import faiss

        return faiss
