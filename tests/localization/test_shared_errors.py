"""rho, the share of error that map points have in common, on maps whose nodes are in their places and on one whose nodes are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from built_room import built_room
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.shared_errors import SharedErrorsConfig, inflation
from topoloc.mapping.topomap import TopoMetricMap

CONFIG = SharedErrorsConfig(min_nodes=3)


def _disturbed(topomap: TopoMetricMap, metres: float, radians: float) -> TopoMetricMap:
    """The same map, its nodes moved at random."""
    rng = np.random.default_rng(0)
    nodes = []
    for node in topomap.nodes:
        error = Rigid3(exp_so3(rng.normal(0.0, radians, 3)), rng.normal(0.0, metres, 3))
        nodes.append(replace(node, summary=replace(node.summary, world_from_cam=node.summary.world_from_cam @ error)))
    return replace(topomap, nodes=nodes, summaries=[node.summary for node in nodes])


def _rho(topomap: TopoMetricMap) -> float:
    return Localizer(topomap, LocalizerConfig(shared_errors=CONFIG)).shared_errors


def test_nodes_out_of_place_share_errors_and_nodes_in_place_do_not(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    exact = _rho(topomap)
    assert exact < 0.03
    assert _rho(_disturbed(topomap, 0.02, 0.005)) > 10.0 * max(exact, CONFIG.least)


def test_a_map_of_one_node_is_taken_to_be_of_middling_quality(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    single = replace(topomap, nodes=topomap.nodes[:1], summaries=topomap.summaries[:1], edges=[])
    assert _rho(single) == CONFIG.unknown


def test_without_shared_errors_the_covariance_stays_as_it_is():
    assert inflation(500, 0.0) == 1.0
    assert inflation(100, 0.1) == pytest.approx(11.0)
