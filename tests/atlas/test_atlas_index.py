"""Check that the index ranks tiles by their most similar place, also across feature types."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from topoloc.atlas.atlas import Atlas
from topoloc.atlas.index import (
    AtlasIndex,
    compute_global_descriptors,
    load_global_descriptors,
    save_global_descriptors,
)
from topoloc.errors import AtlasError
from topoloc.mapping.topomap import TopoMetricMap


def _units(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.standard_normal((count, 16))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def test_tiles_are_ranked_by_their_most_similar_place():
    rng = np.random.default_rng(0)
    tiles = {name: {"surf": _units(rng, 5 + number)} for number, name in enumerate("abcd")}
    asked = _units(rng, 1)[0]
    ranked = AtlasIndex(list(tiles), list(tiles.values())).rank({"surf": asked}, 3)
    best = {name: float((vectors["surf"] @ asked).max()) for name, vectors in tiles.items()}
    assert [name for name, _ in ranked] == sorted(best, key=lambda name: -best[name])[:3]
    assert [likeness for _, likeness in ranked] == pytest.approx(
        [best[name] for name, _ in ranked], abs=1e-5
    )


def test_the_last_feature_type_ranks_and_tiles_without_it_keep_their_gap():
    along = np.eye(4, dtype=np.float32)

    def like(cosine, axis):
        return (cosine * along[0] + np.sqrt(1 - cosine**2) * along[axis])[None].astype(np.float32)

    vectors = [
        {"surf": like(0.5, 1), "net": like(0.9, 2)},
        {"surf": like(0.6, 1), "net": like(0.4, 2)},
        {"surf": like(0.4, 1)},
    ]
    index = AtlasIndex(["right", "wrong", "without"], vectors)
    by_surf = index.rank({"surf": along[0]}, 9)
    assert [name for name, _ in by_surf] == ["wrong", "right", "without"]
    ranked = index.rank({"surf": along[0], "net": along[0]}, 9)
    assert [name for name, _ in ranked] == ["right", "without", "wrong"]
    assert [likeness for _, likeness in ranked] == pytest.approx([0.9, 0.7, 0.4], abs=1e-6)


def test_vectors_of_a_map_are_kept_and_those_of_another_vocabulary_are_not_compared(
    room_map: Path, tmp_path: Path
):
    with TopoMetricMap.load(room_map) as topomap:
        vectors = compute_global_descriptors(topomap)
        assert len(vectors["surf"]) == len(topomap.summaries)
    assert np.allclose(np.linalg.norm(vectors["surf"], axis=1), 1.0, atol=1e-5)
    save_global_descriptors(tmp_path / "places", vectors)
    from topoloc.retrieval.shared_vocabulary import shared_vocabulary

    vocabulary = shared_vocabulary("surf")
    assert vocabulary is not None
    assert np.allclose(
        load_global_descriptors(tmp_path / "places", {"surf": vocabulary.version})["surf"],
        vectors["surf"],
        atol=1e-3,
    )
    with pytest.raises(AtlasError, match="another version"):
        load_global_descriptors(tmp_path / "places", {"surf": "0"})


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 and no more", b"\x93NUMPY", b"text"])
def test_damaged_vectors_are_refused(data: bytes, tmp_path: Path):
    (tmp_path / "places").write_bytes(data)
    with pytest.raises(AtlasError, match="damaged"):
        load_global_descriptors(tmp_path / "places", {})


def test_pictures_look_like_their_own_tile(atlas: Path):
    from built_room import unseen_views
    from tiny_world import CAMERA
    from topoloc.features.extraction import extract_features
    from topoloc.features.feature_types import FeatureConfig
    from topoloc.retrieval.shared_vocabulary import shared_vocabulary

    index, vocabulary = Atlas.open(str(atlas)).index, shared_vocabulary("surf")
    assert vocabulary is not None
    for seed, tile in ((0, "room"), (1, "other")):
        image, _ = unseen_views(seed)[1]
        global_descriptor = vocabulary.global_descriptor(
            extract_features(image, FeatureConfig()), CAMERA.width, CAMERA.height
        )
        (first, likeness), (_, second) = index.rank({"surf": global_descriptor}, 2)
        assert first == tile
        assert likeness > second + 0.1
