"""Several tiles heard together: who answers, when nobody does, and how probable each pose is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from topoloc.atlas.manifest import StoredFile, Tile
from topoloc.atlas.tile_results import TileResult, merge_tile_results
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.evidence import Evidence
from topoloc.localization.provenance import Provenance
from topoloc.localization.result import Localization, NotLocalized
from topoloc.retrieval.coarse import NodeScore

STRONG = Evidence(200, 150, 400, 500, 20, 0.9, 0.05, 0.7)
FAIR = Evidence(100, 30, 80, 400, 20, 0.5, 0.15, 0.15)
WEAK = Evidence(60, 8, 20, 400, 15, 0.2, 0.8, 0.02)


def _tile(name: str, world: str | None = None) -> Tile:
    stored = StoredFile(f"tiles/{name}.topo", "ab" * 32, 10)
    box = np.zeros((2, 3))
    return Tile(name, stored, stored, {}, "0" * 16, 1, ("surf",), 4, (), 300.0, box, world or name)


def _pose(evidence: Evidence, x: float = 0.0, probability: float = 0.95) -> Localization:
    pose = Rigid3(np.eye(3), np.array([x, 0.0, 0.0]))
    return Localization(
        pose,
        np.eye(6) * 1e-6,
        probability,
        3,
        [NodeScore(3, 0.5)],
        9,
        8,
        evidence=evidence,
        provenance=Provenance(features="surf"),
    )


def _heard(
    tile: Tile, result: Localization | NotLocalized, is_exhaustive: bool = True, **more: Any
) -> TileResult:
    return TileResult(
        tile, result, (result,) if isinstance(result, Localization) else (), is_exhaustive, **more
    )


def test_the_only_tile_that_vouches_answers():
    result = merge_tile_results(
        [_heard(_tile("a"), NotLocalized("not_in_map")), _heard(_tile("b"), _pose(STRONG))]
    )
    assert isinstance(result, Localization)
    assert result.provenance.tile == "b"
    assert result.probability == pytest.approx(0.95)


def test_a_pose_with_far_more_for_it_leads_and_pays_for_its_rival():
    rivals = [_heard(_tile("a"), _pose(WEAK)), _heard(_tile("b"), _pose(STRONG))]
    for tile_results in (rivals, rivals[::-1]):
        result = merge_tile_results(tile_results)
        assert isinstance(result, Localization)
        assert result.provenance.tile == "b"
        assert 0.5 < result.probability < 0.95


@pytest.mark.parametrize("second_is_full", [True, False])
def test_two_poses_with_as_much_for_them_are_both_named(second_is_full: bool):
    result = merge_tile_results(
        [
            _heard(_tile("a"), _pose(FAIR)),
            _heard(_tile("b"), _pose(FAIR, x=3.0), is_exhaustive=second_is_full),
        ]
    )
    assert isinstance(result, NotLocalized)
    assert result.reason == "ambiguous"
    assert {one.tile for one in result.alternatives} == {"a", "b"}
    assert sum(one.probability for one in result.alternatives) <= 1.0
    assert "as much like tile" in result.detail


def test_the_same_pose_in_two_tiles_of_one_world_is_one():
    a, b = _tile("a", "house"), _tile("b", "house")
    assert isinstance(
        merge_tile_results([_heard(a, _pose(FAIR)), _heard(b, _pose(FAIR, x=0.01))]), Localization
    )
    assert isinstance(
        merge_tile_results([_heard(a, _pose(FAIR)), _heard(b, _pose(FAIR, x=5.0))]), NotLocalized
    )


def test_tiles_that_lie_in_the_atlas_are_compared_there():
    shift = Rigid3(np.eye(3), np.array([10.0, 0.0, 0.0]))
    a, b = (
        replace(_tile(name), atlas_from_world=pose)
        for name, pose in (("a", Rigid3.identity()), ("b", shift))
    )
    agreed = merge_tile_results([_heard(a, _pose(FAIR, x=12.0)), _heard(b, _pose(FAIR, x=2.0))])
    assert isinstance(agreed, Localization)
    assert agreed.provenance.atlas_from_cam is not None
    assert np.allclose(agreed.provenance.atlas_from_cam.translation, [12.0, 0.0, 0.0])
    assert isinstance(
        merge_tile_results([_heard(a, _pose(FAIR, x=2.0)), _heard(b, _pose(FAIR, x=2.0))]),
        NotLocalized,
    )


def test_a_refusal_is_that_of_the_tile_that_knows_most():
    few, more = NotLocalized("too_few_matches"), NotLocalized("not_in_map", num_inliers=9)
    tile_results = [
        _heard(_tile("a"), few),
        _heard(_tile("b"), more),
        _heard(_tile("c"), replace(more, num_inliers=99), is_exhaustive=False),
    ]
    result = merge_tile_results(tile_results)
    assert isinstance(result, NotLocalized)
    assert (result.reason, result.provenance.tile) == ("not_in_map", "b")
