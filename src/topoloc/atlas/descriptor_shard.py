"""A shard of an atlas's places: those of many tiles by one kind of features, found by codes of 32
bytes, compared by themselves.

FAISS keeps of each place a product-quantised code (half a byte for two of its numbers) in the cell
of its nearest centre. A query looks into the nearest eighth of the cells (96 at least), and the
places that look nearest by their codes are compared by their vectors, half floats that stay on the
disk: only pages that are asked come into memory, and processes share them. One file holds it all,
with a checksum; it can be made anew at any time.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from jaxtyping import Bool, Float16, Float32, Int

from topoloc.errors import AtlasError
from topoloc.recordings.atomic import atomic_write

NUM_COMPARED, MAX_COMPARED = 1024, 16_384
"""Places that are compared by their vectors; where they are of too few tiles, eight times as many,
up to the second number."""
MAX_ROWS_COMPARED = 8_192
"""Of tiles that have no more places together than this, all are compared."""
_MIN_PROBES, _CELLS_PER_PROBE, _MAX_CELLS = 96, 8, 4096
_NUM_TRAINING_VECTORS, _CHUNK = 65_536, 65_536
_MAGIC, _ALIGNMENT = b"topoloc-places-1\n", 4096


@dataclass(frozen=True)
class ShardTile:
    """A tile in a shard: its id, the checksum of the file that its place vectors are from, and how
    many they are."""

    tile_id: str
    sha256: str
    num_rows: int


class DescriptorShard:
    """Place vectors of some tiles, those of a tile one after the other.

    Args:
        kind, vocabulary: the kind of features, and the version of the vocabulary that the vectors
            are by.
        vectors: unit vectors of all tiles, in their order.
        codes: FAISS's index over them; made where it is None.
    """

    def __init__(
        self,
        kind: str,
        vocabulary: str,
        tiles: Sequence[ShardTile],
        vectors: Float16[np.ndarray, "n d"],
        codes: Any = None,
    ) -> None:
        self.kind, self.vocabulary, self.tiles, self.vectors = (
            kind,
            vocabulary,
            list(tiles),
            vectors,
        )
        self.bounds: Int[np.ndarray, " _"] = np.cumsum([0, *(tile.num_rows for tile in tiles)])
        self._codes = _build_codes(vectors) if codes is None else codes
        self._num_probes = min(
            self._codes.nlist, max(_MIN_PROBES, round(self._codes.nlist / _CELLS_PER_PROBE))
        )
        self._chosen: tuple[bytes, Any] | None = None

    @property
    def name(self) -> str:
        """That of its file: made of what is in it."""
        contents = json.dumps([self.kind, self.vocabulary, [astuple(tile) for tile in self.tiles]])
        return f"{hashlib.sha256(contents.encode()).hexdigest()[:32]}.index"

    def rank(
        self, vector: Float32[np.ndarray, " d"], num_tiles: int, is_selected: Bool[np.ndarray, " t"]
    ) -> tuple[Int[np.ndarray, " k"], Float32[np.ndarray, " k"]]:
        """The tiles (numbers in `tiles`) with the most similar places, up to `num_tiles`, and the
        similarity of each one's best.

        Args:
            is_asked: of each tile whether it may be named.
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
        """The rows of about so many of the most similar places of these tiles, the nearest first,
        and their similarities; of more tiles than few, those that look so by their codes."""
        asked = np.flatnonzero(is_selected)
        num_rows = int((self.bounds[asked + 1] - self.bounds[asked]).sum())
        if num_rows <= MAX_ROWS_COMPARED:
            spans = [np.arange(self.bounds[tile], self.bounds[tile + 1]) for tile in asked]
            rows = np.concatenate(spans) if spans else np.zeros(0, np.int64)
        else:
            chosen = None if len(asked) == len(is_selected) else self._select_tile_rows(is_selected)
            parameters = faiss.SearchParametersIVF(nprobe=self._num_probes, sel=chosen)  # pyright: ignore[reportCallIssue]
            with _single_threaded():
                found = self._codes.search(vector[None], min(count, num_rows), params=parameters)[
                    1
                ][0]
            rows = found[found >= 0]
        similarities = self.vectors[rows].astype(np.float32) @ vector
        order = np.argsort(-similarities, kind="stable")
        return rows[order], similarities[order]

    def _select_tile_rows(self, is_selected: Bool[np.ndarray, " t"]) -> Any:
        """FAISS's filter for the places of these tiles; the last one is kept, for the next query
        mostly has the same."""
        key, known = is_selected.tobytes(), self._chosen
        if known is None or known[0] != key:
            bits = np.packbits(np.repeat(is_selected, np.diff(self.bounds)), bitorder="little")
            self._chosen = known = key, faiss.IDSelectorBitmap(bits)  # pyright: ignore[reportCallIssue]
        return known[1]

    def save(self, folder: Path) -> Path:
        """Write its file, at once or not at all. Raises OSError."""
        codes = faiss.serialize_index(self._codes)
        facts = {
            "kind": self.kind,
            "vocabulary": self.vocabulary,
            "tiles": [astuple(tile) for tile in self.tiles],
        }
        header = json.dumps(
            facts | {"shape": self.vectors.shape, "num_bytes_of_codes": len(codes)}
        ).encode()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / self.name
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            digest = hashlib.sha256()

            def write(data: Any) -> None:
                digest.update(data)
                file.write(data)

            file.write(_MAGIC + bytes(32))
            write(len(header).to_bytes(8, "little") + header)
            write(codes.tobytes())
            write(bytes(-file.tell() % _ALIGNMENT))
            for start in range(0, len(self.vectors), _CHUNK):
                write(np.ascontiguousarray(self.vectors[start : start + _CHUNK]).data)
            file.seek(len(_MAGIC))
            file.write(digest.digest())
        return path

    @staticmethod
    def open(path: Path) -> DescriptorShard:
        """A shard as it was saved; its vectors stay on the disk. Raises AtlasError: the file is
        missing, damaged or another."""
        try:
            return _opened(path)
        except (
            OSError,
            ValueError,
            TypeError,
            KeyError,
            RuntimeError,
            RecursionError,
            OverflowError,
        ) as error:
            raise AtlasError(
                f"{path} is missing or damaged: {' '.join(str(error).split())[:120]}"
            ) from None


def _opened(path: Path) -> DescriptorShard:
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it is no index of places")
        expected, digest = file.read(32), hashlib.sha256()
        while chunk := file.read(1 << 20):
            digest.update(chunk)
        if digest.digest() != expected:
            raise ValueError("its checksum is another")
        file.seek(len(_MAGIC) + 32)
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        codes = faiss.deserialize_index(
            np.frombuffer(file.read(header["num_bytes_of_codes"]), np.uint8)
        )
        start = file.tell() + -file.tell() % _ALIGNMENT
    num_rows, dimension = header["shape"]
    mapped = np.memmap(path, np.float16, "r", start, (num_rows, dimension))
    tiles = [ShardTile(*tile) for tile in header["tiles"]]
    if (
        codes.ntotal != num_rows
        or codes.d != dimension
        or sum(tile.num_rows for tile in tiles) != num_rows
    ):
        raise ValueError("its parts do not belong together")
    return DescriptorShard(header["kind"], header["vocabulary"], tiles, np.asarray(mapped), codes)


def _build_codes(vectors: Float16[np.ndarray, "n d"]) -> Any:
    """Cells about the k-means centres of some of the vectors, and all vectors as codes in them."""
    num_rows, dimension = vectors.shape
    num_cells = max(1, min(round(math.sqrt(num_rows)), _MAX_CELLS))
    num_parts = dimension // 2 if dimension % 2 == 0 else dimension
    index = faiss.IndexIVFPQFastScan(
        faiss.IndexFlatIP(dimension),
        dimension,
        num_cells,
        num_parts,
        4,
        faiss.METRIC_INNER_PRODUCT,
        32,
        True,
    )
    index.cp.niter, index.cp.seed, index.cp.min_points_per_centroid = 8, 1, 1
    index.pq.cp.min_points_per_centroid = 1
    sample = np.sort(np.random.default_rng(1).permutation(num_rows)[:_NUM_TRAINING_VECTORS])
    with _single_threaded():
        index.train(vectors[sample].astype(np.float32))  # pyright: ignore[reportCallIssue]
        for start in range(0, num_rows, _CHUNK):
            index.add(vectors[start : start + _CHUNK].astype(np.float32))  # pyright: ignore[reportCallIssue]
    return index


@contextmanager
def _single_threaded() -> Iterator[None]:
    """FAISS by this thread alone: its threads wait for each other at full speed, ten times as long
    where others need the processors."""
    before = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        yield
    finally:
        faiss.omp_set_num_threads(before)
