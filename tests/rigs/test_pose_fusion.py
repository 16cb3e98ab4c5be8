"""Check the choice and fusion of poses of several cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from topoloc import Rigid3
from topoloc.geometry.transform_consensus import diagonal_covariance
from topoloc.rigs.pose_fusion import PoseEstimate, fuse_poses, weigh_poses

HERE, THERE = Rigid3.identity(), Rigid3(np.eye(3), np.array([5.0, 0.0, 0.0]))
COVARIANCE = diagonal_covariance(0.01, 0.1)


def _estimate(
    camera: str, pose: Rigid3 = HERE, probability: float = 0.9, noise_share: float = 1.0
) -> PoseEstimate:
    return PoseEstimate(camera, pose, COVARIANCE, noise_share, probability, None)


def test_one_camera_keeps_its_probability_and_pose():
    [only] = weigh_poses([_estimate("a", THERE, 0.73)])
    assert only.probability == pytest.approx(0.73)
    pose, covariance = fuse_poses(only.estimates)
    assert np.allclose(pose.matrix(), THERE.matrix())
    assert np.allclose(covariance, COVARIANCE)


def test_cameras_that_agree_are_surer_and_others_say_which_place_an_ambiguous_image_shows():
    [only] = weigh_poses([_estimate("a"), _estimate("b")])
    assert only.probability == pytest.approx(0.81 / 0.82)
    ambiguous = [_estimate("a", HERE, 0.49), _estimate("a", THERE, 0.49)]
    best, second = weigh_poses([*ambiguous, _estimate("b", THERE, 0.8)])
    assert best.probability > 0.75 > 0.25 > second.probability
    assert sorted(one.camera for one in best.estimates) == ["a", "b"]
    assert all(one.world_from_rig is THERE for one in best.estimates)


def test_a_majority_outweighs_a_sure_camera_elsewhere():
    best, second = weigh_poses(
        [_estimate(name, HERE, 0.99) for name in "ab"] + [_estimate("c", THERE, 0.999)]
    )
    assert best.probability > 0.9
    assert [one.camera for one in second.estimates] == ["c"]


def test_poses_in_worlds_of_other_tiles_do_not_agree():
    assert len(weigh_poses([_estimate("a"), replace(_estimate("b"), tile="north")])) == 2


@pytest.mark.parametrize("noise_share", [1.0, 0.5, 0.05])
def test_the_covariance_is_that_of_the_errors(noise_share: float):
    """Cameras share an error of the map and have noise of their own."""
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(COVARIANCE)
    squares = list[float]()
    for _ in range(400):
        common = np.sqrt(1.0 - noise_share) * root @ rng.normal(size=6)
        own = [np.sqrt(noise_share) * root @ rng.normal(size=6) for _ in range(3)]
        found = [
            replace(_estimate(str(k), Rigid3.exp(common + one)), noise_share=noise_share)
            for k, one in enumerate(own)
        ]
        pose, covariance = fuse_poses(found)
        error = pose.log()
        squares.append(float(error @ np.linalg.solve(covariance, error)))
    inside = np.mean(np.array(squares) < 12.59)
    assert 0.93 < inside < 0.985


def test_poses_that_scatter_show_that_their_errors_are_not_common():
    """Both errors are said to be common, but the poses differ by 3 sigma."""
    apart = Rigid3(np.eye(3), np.array([0.03, 0.0, 0.0]))
    pose, covariance = fuse_poses(
        [_estimate("a", noise_share=0.01), _estimate("b", apart, noise_share=0.01)]
    )
    assert pose.translation[0] == pytest.approx(0.015)
    error = np.array([0.015, 0, 0, 0, 0, 0])
    assert error @ np.linalg.solve(covariance, error) < 6.0
    assert covariance[0, 0] > 0.5 * COVARIANCE[0, 0]


def test_a_pose_tried_for_a_refused_image_decides_between_two_cameras():
    against = [_estimate("a", HERE, 0.9), _estimate("b", THERE, 0.99)]
    likelier, other = weigh_poses(against)
    assert not likelier.outvotes(other)
    best, rival = weigh_poses(against, [_estimate("c", HERE, 0.1)])
    assert best.cameras == {"a", "c"}
    assert best.outvotes(rival)
    assert best.probability > 0.8
    # a pose that agrees with both decides nothing
    vague = replace(_estimate("c", HERE, 0.1), covariance=diagonal_covariance(5.0, 5.0))
    best, rival = weigh_poses(against, [vague])
    assert not best.outvotes(rival)
    assert not rival.outvotes(best)
    # nor does it make a pose of one camera likelier
    [alone] = weigh_poses([_estimate("a", HERE, 0.6)], [_estimate("c", HERE, 0.4)])
    assert alone.probability == pytest.approx(0.6)
