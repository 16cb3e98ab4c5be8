"""Test the merge of several tiles' results: the reported pose, refusals and probabilities."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from made_hypotheses import WEIGHTS, believed, made_hypothesis
from topoloc.atlas.atlas import Atlas
from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.manifest import Manifest, PlacesFile, StoredFile, Tile
from topoloc.atlas.map_cache import MapCache
from topoloc.atlas.store import FolderStore
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.answer import Answer
from topoloc.localization.localizer import Localizer
from topoloc.localization.pose_fit import PointObservations
from topoloc.localization.provenance import Evidence, Provenance
from topoloc.localization.result import CandidateNode, Localization, NotLocalized
from topoloc.localization.tiles.atlas_tiles import AtlasTiles
from topoloc.localization.tiles.tiles import TileAnswer, merge_answers

STRONG = Evidence(200, 150, 400, 500, 20, 0.9, 0.05, 0.7)
FAIR = Evidence(100, 30, 80, 400, 20, 0.5, 0.15, 0.15)
NO_INLIERS = PointObservations(np.zeros((0, 2), np.float32), np.zeros((0, 3)), np.zeros((0, 3, 3)))
WEAK = Evidence(60, 8, 20, 400, 15, 0.2, 0.8, 0.02)


def _tile(name: str, world: str | None = None) -> Tile:
    stored = StoredFile(f"tiles/{name}.topo", "ab" * 32, 10)
    box = np.zeros((2, 3))
    return Tile(
        *(name, stored, PlacesFile(stored.name, stored.sha256, 10, {}), "0" * 16, 1, ("surf",), 4),
        *((), 300.0, box, world or name, None, None, None),
    )


def _pose(evidence: Evidence, x: float = 0.0, probability: float = 0.95) -> Localization:
    pose = Rigid3(np.eye(3), np.array([x, 0.0, 0.0]))
    return Localization(
        pose,
        np.eye(6) * 1e-6,
        probability,
        3,
        [CandidateNode(3, 0.5)],
        9,
        8,
        evidence=evidence,
        provenance=Provenance(features="surf"),
    )


Found = tuple[Tile, Localization | NotLocalized]


def _merge(*found: Found, coarse: int = -1) -> Localization | NotLocalized:
    """Merge the results of exhaustive searches. Tile number `coarse` was searched coarse only."""
    manifest = Manifest(tiles=tuple(tile for tile, _ in found))
    atlas = Atlas(FolderStore(Path("no-such-folder")), manifest)
    tiles = AtlasTiles(atlas, MapCache([], Localizer, 1), AtlasConfig(), lambda text: None)
    answers = [
        TileAnswer(tile.tile_id, _answer(result), number != coarse)
        for number, (tile, result) in enumerate(found)
    ]
    return merge_answers(tiles, answers)[0]


def _answer(result: Localization | NotLocalized) -> Answer:
    """Return the answer of a map with this result."""
    search = believed([])
    if isinstance(result, NotLocalized):
        return Answer(search, None, result, [])
    assert result.evidence is not None
    hypothesis = replace(
        made_hypothesis(WEIGHTS.log_odds(result.evidence)), evidence=result.evidence
    )
    return Answer(search, hypothesis, result, [(result, NO_INLIERS)], [hypothesis])


def test_the_only_tile_with_a_pose_localizes():
    result = _merge((_tile("a"), NotLocalized("not_in_map")), (_tile("b"), _pose(STRONG)))
    assert isinstance(result, Localization)
    assert result.provenance.tile == "b"
    assert result.probability == pytest.approx(0.95)


def test_a_pose_with_far_more_evidence_leads_with_a_lower_probability():
    rivals = [(_tile("a"), _pose(WEAK)), (_tile("b"), _pose(STRONG))]
    for found in (rivals, rivals[::-1]):
        result = _merge(*found)
        assert isinstance(result, Localization)
        assert result.provenance.tile == "b"
        assert 0.5 < result.probability < 0.95


@pytest.mark.parametrize("coarse", [-1, 1])
def test_two_poses_with_equal_evidence_are_both_named(coarse: int):
    result = _merge((_tile("a"), _pose(FAIR)), (_tile("b"), _pose(FAIR, x=3.0)), coarse=coarse)
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"
    assert {one.tile for one in result.alternatives} == {"a", "b"}
    assert sum(one.probability for one in result.alternatives) <= 1.0
    assert "as much like tile" in result.detail


def test_the_same_pose_in_two_tiles_of_one_world_is_one():
    a, b = _tile("a", "house"), _tile("b", "house")
    assert isinstance(_merge((a, _pose(FAIR)), (b, _pose(FAIR, x=0.01))), Localization)
    assert isinstance(_merge((a, _pose(FAIR)), (b, _pose(FAIR, x=5.0))), NotLocalized)


def test_tiles_that_lie_in_the_atlas_are_compared_there():
    shift = Rigid3(np.eye(3), np.array([10.0, 0.0, 0.0]))
    a, b = (
        structs.replace(_tile(name), atlas_from_world=pose)
        for name, pose in (("a", Rigid3.identity()), ("b", shift))
    )
    agreed = _merge((a, _pose(FAIR, x=12.0)), (b, _pose(FAIR, x=2.0)))
    assert isinstance(agreed, Localization)
    assert agreed.provenance.atlas_from_cam is not None
    assert np.allclose(agreed.provenance.atlas_from_cam.translation, [12.0, 0.0, 0.0])
    assert isinstance(_merge((a, _pose(FAIR, x=2.0)), (b, _pose(FAIR, x=2.0))), NotLocalized)


def test_a_refusal_is_that_of_the_tile_with_most_inliers():
    few, more = NotLocalized("too_few_matches"), NotLocalized("not_in_map", num_inliers=9)
    result = _merge(
        (_tile("a"), few),
        (_tile("b"), more),
        (_tile("c"), replace(more, num_inliers=99)),
        coarse=2,
    )
    assert isinstance(result, NotLocalized)
    assert (result.reason, result.provenance.tile) == ("not_in_map", "b")
