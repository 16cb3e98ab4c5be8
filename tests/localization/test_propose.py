"""First poses from what nodes saw: found where the ratio test leaves too little, and no answer where the picture is of elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from topoloc.localization.attempt import Attempt
from topoloc.localization.standpoints import StandpointsConfig, strongest_and_distinct

from built_room import built_room, unseen_views
from tiny_world import CAMERA
from topoloc.features.features import Features, Matches
from topoloc.geometry.absolute_pose import AbsolutePose
from topoloc.geometry.alignment import translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.local_map import LocalMap
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization
from topoloc.map.topomap import TopoMetricMap

LIGHTS = (0.055, 0.05, 0.045)


@pytest.fixture(scope="module")
def room(tiny_recording: Path) -> TopoMetricMap:
    return built_room(tiny_recording)


def _dark(picture: np.ndarray, light: float, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 5.0, picture.shape)
    return np.clip(light * picture + noise, 0, 255).astype(np.uint8)


def test_dark_pictures_are_localized_that_are_not_without(room: TopoMetricMap):
    views = [(_dark(picture, light, k), truth) for light in LIGHTS for k, (picture, truth) in enumerate(unseen_views())]
    num_right = {}
    for num_nodes in (0, StandpointsConfig().num_nodes):
        localizer = Localizer(room, LocalizerConfig(standpoints=StandpointsConfig(num_nodes=num_nodes)))
        found = [(localizer.localize(picture, CAMERA), truth) for picture, truth in views]
        errors = [translation_error(r.world_from_cam, truth) for r, truth in found if isinstance(r, Localization)]
        assert max(errors, default=0.0) < 0.25
        num_right[num_nodes] = len(errors)
    assert num_right[StandpointsConfig().num_nodes] > num_right[0]


def _attempt(world_from_cam: Rigid3 | None, num_inliers: int) -> Attempt:
    features = Features.empty(64)
    rows = np.zeros(num_inliers, np.int32)
    empty, one = np.zeros((0, 3)), np.zeros(0)
    local_map = LocalMap(features.descriptors, empty, np.zeros((0, 3, 3)), one, np.zeros(0, int), one, empty)
    pose = None
    if world_from_cam is not None:
        pose = AbsolutePose(world_from_cam.inverse(), np.ones(num_inliers, bool), np.eye(6), np.zeros(num_inliers))
    return Attempt(features, CAMERA, CAMERA, local_map, Matches(rows, rows, np.zeros(num_inliers, np.float32)), pose)


def test_poses_close_to_one_another_are_looked_into_once_and_the_strongest_first():
    def at(x: float) -> Rigid3:
        return Rigid3(np.eye(3), np.array([x, 0.0, 0.0]))

    attempts = [_attempt(at(0.0), 20), _attempt(at(0.1), 30), _attempt(None, 0), _attempt(at(0.5), 40), _attempt(at(0.6), 10)]
    kept = strongest_and_distinct(attempts, lambda_rot=1.0, max_distance=0.25, max_poses=6)
    assert [attempts.index(attempt) for attempt in kept] == [3, 1]
    assert strongest_and_distinct(attempts, 1.0, 0.25, max_poses=1) == [attempts[3]]


def test_pictures_of_elsewhere_stay_unanswered_and_those_of_here_are_answered(room: TopoMetricMap):
    """With every query treated as one that is not clear."""
    config = LocalizerConfig()
    localizer = Localizer(room, replace(config, verification=replace(config.verification, clear_log_odds=1e9)))
    here = [(localizer.localize(picture, CAMERA), truth) for picture, truth in unseen_views()]
    assert all(isinstance(result, Localization) and translation_error(result.world_from_cam, truth) < 0.05 for result, truth in here)
    assert not any(isinstance(localizer.localize(picture, CAMERA), Localization) for picture, _ in unseen_views(seed=7))
