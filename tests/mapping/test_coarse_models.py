"""Test the grouping of sessions by light, and that the coarse search ignores
differences of light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topoloc import TopoMetricMap
from topoloc.errors import TopolocError
from topoloc.features.features import Features
from topoloc.mapping.coarse_models import (
    compute_illumination_distance,
    find_node_illumination_groups,
    group_by_illumination,
    node_ids_to_rows,
    open_map_coarse_localizer,
)
from topoloc.mapping.storage.entries import Illumination, Session
from topoloc.node_ids import NodeId
from topoloc.retrieval.coarse import VladConfig, open_coarse_localizer
from topoloc.retrieval.vlad import SurfVlad

DAY = Illumination(0.5, 0.2, 0.02, 0.05, 1.0, 1.0)
CLOUDS = replace(DAY, level=0.45, contrast=0.18)
NIGHT = Illumination(0.15, 0.12, 0.5, 0.01, 1.3, 0.7)


def _session(session_id: int, light: Illumination | None, name: str | None = None) -> Session:
    return Session(session_id, f"walk {session_id}", light=light, light_name=name)


def test_sessions_of_one_light_go_together():
    assert compute_illumination_distance(DAY, DAY) == 0.0
    assert compute_illumination_distance(DAY, CLOUDS) < compute_illumination_distance(DAY, NIGHT)
    sessions = [_session(0, NIGHT), _session(1, DAY), _session(2, CLOUDS), _session(3, None)]
    assert group_by_illumination(sessions, {1: 40, 0: 9}) == {1: 0, 0: 1, 2: 0, 3: 0}


def test_names_of_light_decide_if_given():
    sessions = [
        _session(0, DAY, "noon"),
        _session(1, CLOUDS, "evening"),
        _session(2, NIGHT, "evening"),
        _session(3, CLOUDS),
    ]
    assert group_by_illumination(sessions, {0: 9}) == {0: 0, 1: 1, 2: 1, 3: 0}
    assert group_by_illumination([_session(0, None), _session(1, None, "night")], {0: 9}) == {
        0: 0,
        1: 1,
    }


def _model(
    rng: np.random.Generator, places: np.ndarray, shift: np.ndarray, covered: int
) -> SurfVlad:
    """Return places by day, some of them also by night. The vectors do not depend on the words."""
    vectors = np.concatenate([places, places[:covered] + shift]).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    p = vectors.shape[1]
    words = rng.normal(size=(1, p)).astype(np.float32)
    return SurfVlad(
        words,
        np.zeros(p, np.float32),
        np.eye(p, dtype=np.float32),
        vectors,
        np.arange(len(vectors)),
        VladConfig(),
    )


def _asked(model: SurfVlad, vector: np.ndarray, words: np.ndarray) -> list[int]:
    """Return the ranking for an image with this VLAD vector, made of one feature and one word."""
    features = Features(
        points_img=np.zeros((1, 2), np.float32),
        sizes_px=np.ones(1, np.float32),
        angles=np.zeros(1, np.float32),
        responses=np.ones(1, np.float32),
        descriptors=(words + vector).astype(np.float32),
    )
    return [score.row for score in model.rank(np.zeros((10, 10), np.uint8), features, 3)]


def test_a_night_session_of_half_the_path_does_not_attract_other_night_queries():
    rng = np.random.default_rng(0)
    places, shift = rng.normal(size=(30, 24)), np.eye(24)[0] * 9.0
    places[:, 0] = 0.0
    model = _model(rng, places, shift, covered=15)
    lights = np.r_[np.zeros(30, np.int64), np.ones(15, np.int64)]
    dark = places[20:] + shift + 0.3 * rng.normal(size=(10, 24))
    words = model.to_model().arrays["words"]
    before, after = (
        sum(_asked(one, view, words)[0] == 20 + k for k, view in enumerate(dark))
        for one in (model, model.suppress_group_differences(lights))
    )
    assert before == 0
    assert after >= 5
    assert model.suppress_group_differences(np.zeros(45, np.int64)) is model
    assert (
        model.suppress_group_differences(np.r_[np.zeros(38, np.int64), np.ones(7, np.int64)])
        is model
    ), "too few to say anything"


def test_a_map_of_one_light_is_queried_unchanged(room_map: Path):
    with TopoMetricMap.load(room_map) as topomap:
        (session,) = topomap.sessions
        assert (find_node_illumination_groups(topomap.summaries, topomap.sessions) == 0).all()
        node = topomap.nodes[0]
        blank = np.zeros((node.camera.height, node.camera.width), np.uint8)
        asked = [
            open_map_coarse_localizer(replace(topomap, sessions=sessions), "surf-vlad").rank(
                blank, node.features, 5
            )
            for sessions in (
                [session],
                [session, replace(session, session_id=1)],
                [session, replace(session, session_id=1, light=NIGHT)],
            )
        ]
    assert asked[0] == asked[1] == asked[2], "no node is of the other session"


@pytest.mark.parametrize("name", [None, "night"])
def test_the_name_of_a_light_is_kept(room_map: Path, tmp_path: Path, name: str | None):
    with TopoMetricMap.load(room_map) as topomap:
        replace(topomap, sessions=[replace(topomap.sessions[0], light_name=name)]).save(
            tmp_path / "named.topo"
        )
    with TopoMetricMap.load(tmp_path / "named.topo") as topomap:
        assert topomap.sessions[0].light_name == name


def test_vectors_without_rows_are_damage(room_map: Path):
    topomap = TopoMetricMap.load(room_map)
    name, model = next(iter(topomap.first_layer.coarse_models.items()))
    assert "vectors" in model.arrays, name
    damaged = replace(model, arrays={**model.arrays, "vectors": np.array(1.0, np.float32)})
    ids = [NodeId(int(one) + 1) for one in model.arrays["node_ids"]]
    with pytest.raises(TopolocError):
        open_coarse_localizer(node_ids_to_rows(damaged, ids))
