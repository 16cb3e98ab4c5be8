"""Test rho, the correlated error share of map points, on maps with right node poses and one
with wrong ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import topoloc
from built_room import built_room
from topoloc.features.feature_types import find_feature_type
from topoloc.geometry.absolute_pose import AbsolutePoseConfig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.answer import shape_as_motion
from topoloc.localization.fitted_weights import load_fitted_weights
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts import correlated_errors
from topoloc.localization.map_facts.correlated_errors import (
    ErrorShareMeasurement,
    MeasuredPoses,
)
from topoloc.mapping.topomap import TopoMetricMap

WEIGHTS = load_fitted_weights("surf").shared_errors


def _disturbed(topomap: TopoMetricMap, metres: float, radians: float) -> TopoMetricMap:
    """Return the map with a random error in each node pose."""
    rng = np.random.default_rng(0)
    nodes = []
    for node in topomap.nodes:
        error = Rigid3(exp_so3(rng.normal(0.0, radians, 3)), rng.normal(0.0, metres, 3))
        nodes.append(
            replace(
                node,
                summary=replace(node.summary, world_from_cam=node.summary.world_from_cam @ error),
            )
        )
    return replace(
        topomap.with_first_layer(nodes=nodes), summaries=[node.summary for node in nodes]
    )


def _rho(topomap: TopoMetricMap) -> float:
    return Localizer(topomap).context.first.correlated_errors


def test_nodes_out_of_place_have_correlated_errors_and_nodes_in_place_do_not(
    tiny_recording: Path, monkeypatch: pytest.MonkeyPatch
):
    topomap = built_room(tiny_recording)  # first: other tests get the same map
    monkeypatch.setitem(correlated_errors._SETTINGS, "min_nodes", 3)
    exact = _rho(topomap)
    assert exact < 0.03
    assert _rho(_disturbed(topomap, 0.02, 0.005)) > 10.0 * max(exact, WEIGHTS.least)


def test_corrected_nodes_share_the_errors_of_the_poses_that_were_measured(
    tiny_recording: Path, monkeypatch: pytest.MonkeyPatch
):
    topomap = built_room(tiny_recording)
    monkeypatch.setitem(correlated_errors._SETTINGS, "min_nodes", 3)
    c = LocalizerConfig().for_feature_type(find_feature_type("surf"))
    share = ErrorShareMeasurement(topomap, "surf", c.guided, c.pose, WEIGHTS)
    given = {
        (one.session_id, one.name): one.world_from_cam
        for one in _disturbed(topomap, 0.02, 0.005).summaries
    }
    assert share.measure(given) > 10.0 * max(share.measure(), WEIGHTS.least)


@pytest.fixture
def measurings(monkeypatch: pytest.MonkeyPatch) -> list[TopoMetricMap]:
    """Return the list of maps that are measured from now on."""
    measured: list[TopoMetricMap] = []
    measure = ErrorShareMeasurement.measure

    def told(
        measurement: ErrorShareMeasurement, measured_poses: MeasuredPoses | None = None
    ) -> float:
        measured.append(measurement.topomap)
        return measure(measurement, measured_poses)

    monkeypatch.setattr(ErrorShareMeasurement, "measure", told)
    return measured


def test_a_map_stores_the_share_measured_at_its_build(
    room_map: Path, measurings: list[TopoMetricMap]
):
    loaded = TopoMetricMap.load(room_map)
    known = Localizer(loaded).context.first.correlated_errors
    assert not measurings
    unknown = loaded.with_first_layer(shared_errors=None)
    assert Localizer(unknown).context.first.correlated_errors == pytest.approx(
        known, rel=0.3
    )  # the file's points are rounded
    assert measurings == [unknown]


@pytest.mark.parametrize(
    "config",
    [
        LocalizerConfig(guided=GuidedConfig(radius_px=7.0)),
        LocalizerConfig(pose=AbsolutePoseConfig(max_reprojection_error_px=5.0)),
    ],
    ids=["guided", "pose"],
)
def test_with_other_settings_it_is_measured_anew(
    config: LocalizerConfig, room_map: Path, measurings: list[TopoMetricMap]
):
    loaded = TopoMetricMap.load(room_map)
    rho = Localizer(loaded, config).context.first.correlated_errors
    assert measurings == [loaded]
    assert (
        rho
        == Localizer(
            loaded.with_first_layer(shared_errors=None), config
        ).context.first.correlated_errors
    )


def test_settings_that_it_does_not_depend_on_may_change(
    room_map: Path, measurings: list[TopoMetricMap]
):
    loaded = TopoMetricMap.load(room_map)
    assert loaded.first_layer.shared_errors is not None
    assert (
        Localizer(loaded, LocalizerConfig(num_candidates=2)).context.first.correlated_errors
        == loaded.first_layer.shared_errors.rho
    )
    assert not measurings


def test_of_other_nodes_it_is_measured_anew(room_map: Path, measurings: list[TopoMetricMap]):
    moved = _disturbed(TopoMetricMap.load(room_map), 0.02, 0.005)
    assert moved.first_layer.shared_errors is not None
    assert Localizer(moved).context.first.correlated_errors > moved.first_layer.shared_errors.rho
    assert measurings == [moved]


def test_a_map_of_one_node_gets_a_medium_share(tiny_recording: Path):
    topomap = built_room(tiny_recording)
    single = replace(
        topomap.with_first_layer(nodes=topomap.nodes[:1]), summaries=topomap.summaries[:1], edges=[]
    )
    assert _rho(single) == WEIGHTS.unknown


def test_shared_errors_are_motions_and_keep_their_mean_square_in_sigmas_of_the_noise():
    root = np.random.default_rng(4).normal(size=(6, 6)) * [0.3, 0.2, 0.1, 0.02, 0.03, 0.01]
    noise, depth = root.T @ root, 2.5
    shared = shape_as_motion(50.0 * noise, noise, depth)
    np.testing.assert_allclose(shared, np.diag(np.diag(shared)))
    metres, radians = np.sqrt(np.diag(shared)).reshape(2, 3)
    np.testing.assert_allclose(metres, depth * radians)
    factor = 3.0  # of the worse nodes
    assert np.trace(np.linalg.solve(noise, shared)) == pytest.approx(factor * 6.0 * 50.0)


def test_the_first_query_computes_nothing_of_the_map(
    room_map: Path, tiny_recording: Path, monkeypatch: pytest.MonkeyPatch
):
    localizer, frame = (
        Localizer(TopoMetricMap.load(room_map)),
        topoloc.open_sequence(tiny_recording)[1],
    )
    assert localizer.context.first.map.focal == frame.camera.fx
    Localizer(TopoMetricMap.load(room_map)).localize(
        frame.image, frame.camera
    )  # Numba hashes its code, too

    def never(*args: object) -> None:
        raise AssertionError("a digest of the nodes, or what the map knows, at a query")

    monkeypatch.setattr("topoloc.mapping.nodes.hashlib.sha256", never)
    monkeypatch.setattr(ErrorShareMeasurement, "measure", never)
    assert localizer.localize(frame.image, frame.camera).localized
    localizer.context.first.map.moves(0)
    with pytest.raises(AssertionError, match="a digest of the nodes"):
        Localizer(TopoMetricMap.load(room_map))
