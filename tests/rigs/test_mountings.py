"""Check the mountings of cameras that the poses of their images show."""

from __future__ import annotations

import numpy as np
import pytest

from topoloc import Localization, Rigid3
from topoloc.node_ids import NodeId
from topoloc.rigs.mountings import find_mountings

RNG = np.random.default_rng(3)
SIGMAS = np.array([0.01] * 3 + [0.002] * 3)
TRUE = {
    "a": Rigid3.exp(np.array([0.0, 0.1, 0.2, 0.0, 0.0, 0.0])),
    "b": Rigid3.exp(np.array([0.3, 0.0, 0.0, 0.0, 1.5, 0.0])),
    "c": Rigid3.exp(np.array([0.0, 0.0, -0.2, 0.0, 3.0, 0.1])),
}


def _localize(name: str, world_from_rig: Rigid3, node_id: int) -> Localization:
    pose = world_from_rig @ TRUE[name] @ Rigid3.exp(SIGMAS * RNG.normal(size=6))
    covariance = pose.transform_covariance(np.diag(SIGMAS**2))
    return Localization(pose, covariance, 0.99, NodeId(node_id), [], 100, 80)


def _instants(
    num: int, names: str = "abc", same_node: bool = False
) -> list[dict[str, Localization]]:
    taken = list[dict[str, Localization]]()
    for k in range(num):
        world_from_rig = Rigid3.exp(np.array([float(k), 0.0, 0.0, 0.0, 0.1 * k, 0.0]))
        node_id = 0 if same_node else k
        taken.append({name: _localize(name, world_from_rig, node_id) for name in names})
    return taken


def test_mountings_are_found_within_their_sigmas():
    found = find_mountings(_instants(30), "a", TRUE["a"])
    assert found["a"].rig_from_cam is TRUE["a"]
    for name in ("b", "c"):
        one = found[name]
        xi = (one.rig_from_cam.inverse() @ TRUE[name]).log()
        assert xi @ np.linalg.solve(one.covariance, xi) < 22.5  # 99.9 %
        assert np.linalg.norm(xi[:3]) < 3.5 * one.position_sigma_m
        assert one.position_sigma_m == pytest.approx(0.01 * np.sqrt(6 / 30), rel=0.5)
        assert one.num_agreeing >= 28
        assert one.num_instants == 30


def test_wrong_poses_are_outvoted_and_a_third_camera_links():
    instants = [*_instants(12, "ab"), *_instants(12, "bc")]
    shifted = Rigid3.exp(np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for k in (0, 5, 14):
        pose = shifted @ instants[k]["b"].world_from_cam
        instants[k]["b"] = Localization(
            pose, instants[k]["b"].covariance, 0.99, NodeId(1), [], 100, 80
        )
    found = find_mountings(instants, "a", TRUE["a"])
    assert found["b"].num_agreeing == 10
    assert TRUE["c"].is_same(found["c"].rig_from_cam, 0.05, 0.01)
    assert found["c"].position_sigma_m > found["b"].position_sigma_m


def test_images_of_one_node_do_not_average_errors_of_the_map():
    apart = find_mountings(_instants(20, "ab"), "a", TRUE["a"])
    with_one_node = find_mountings(_instants(20, "ab", same_node=True), "a", TRUE["a"])
    assert "b" in apart
    assert "b" not in with_one_node


def test_a_camera_without_agreement_has_no_mounting():
    few = find_mountings([*_instants(2), *_instants(5, "b")], "a", TRUE["a"])
    assert list(few) == ["a"]
