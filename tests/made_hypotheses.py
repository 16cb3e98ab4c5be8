"""Make hypotheses by hand for tests of the belief."""

from __future__ import annotations

import numpy as np

from tiny_world import CAMERA
from topoloc.features.feature_types import SURF, FeatureConfig
from topoloc.features.features import Features, Matches
from topoloc.geometry.absolute_pose import AbsolutePose
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.belief import Hypothesis
from topoloc.localization.config import LocalizerConfig
from topoloc.localization.feature_map import FeatureMap
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.pose_fit import LocalMap, PoseFit
from topoloc.localization.provenance import Evidence
from topoloc.localization.query import Query
from topoloc.localization.result import CandidateNode
from topoloc.localization.search import Search
from topoloc.retrieval.coarse import NodeScore

WEIGHTS = load_fitted_weights("surf")
CANDIDATES = [CandidateNode(3, 0.5)]
EXACT = 1e-8 * np.eye(6)


def made_fit(
    x: float,
    points_world: np.ndarray | None = None,
    features: Features | None = None,
    node_id: int = 1,
) -> PoseFit:
    """Return a pose `x` metres along the world's x axis with these points. Row k of the
    features is point k."""
    points_world = np.zeros((0, 3)) if points_world is None else points_world
    features = made_features(len(points_world)) if features is None else features
    count, rows = len(points_world), np.arange(len(points_world), dtype=np.int32)
    one = np.full(count, 0.05)
    local_map = LocalMap(
        np.zeros((count, 64), np.float32),
        points_world,
        np.zeros((count, 3, 3)),
        one,
        np.full(count, node_id),
        one,
        np.zeros((count, 3)),
    )
    pose = AbsolutePose(
        Rigid3(np.eye(3), np.array([-x, 0.0, 0.0])), np.ones(count, bool), np.eye(6)
    )
    return PoseFit(
        features, CAMERA, CAMERA, local_map, Matches(rows, rows, np.zeros(count, np.float32)), pose
    )


def made_features(count: int) -> Features:
    one = np.ones(count, np.float32)
    return Features(
        np.zeros((count, 2), np.float32), one, one, one, np.zeros((count, 64), np.float32)
    )


def made_hypothesis(
    log_odds: float,
    x: float = 0.0,
    even_share: float = 0.1,
    doubt: float = 0.2,
    walls: bool = False,
    fit: PoseFit | None = None,
) -> Hypothesis:
    """Return a hypothesis `x` metres along the world's x axis, of virtual views or of nodes. Its
    odds are as given, whatever the evidence."""
    evidence = Evidence(
        150,
        5,
        20,
        200,
        30,
        spread=0.1,
        doubt=doubt,
        even_share=even_share,
        num_distinct=5 if walls else None,
    )
    return Hypothesis(
        "walls" if walls else "retrieval", fit or made_fit(x), evidence, EXACT, 0.5, log_odds
    )


def believed(hypotheses: list[Hypothesis], config: LocalizerConfig | None = None) -> Search:
    """Return a search that found these hypotheses in this order. Its map is not open, because the
    belief does not read it."""
    query = Query(np.zeros((CAMERA.height, CAMERA.width), np.uint8), CAMERA, 1.0, FeatureConfig())
    resolved = (config or LocalizerConfig()).for_feature_type(SURF)
    not_open = object.__new__(FeatureMap)
    not_open.node_ids, not_open.kind = list(range(10)), SURF
    search = Search(
        query, not_open, resolved, WEIGHTS, correlated_error_share=0.0, ranked=[NodeScore(3, 0.5)]
    )
    for hypothesis in hypotheses:
        search.belief = search.belief.with_hypothesis(hypothesis, resolved.evidence, WEIGHTS.rivals)
    return search
