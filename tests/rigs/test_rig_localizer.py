"""Check poses of rigs: equal to a single camera's, better with several, and what contradicts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from made_rigs import NAMES, instant, lab_map
from topoloc import (
    Localizer,
    QueryError,
    Rig,
    Rigid3,
    RigLocalization,
    RigLocalizer,
    RigNotLocalized,
    open_sequence,
)
from topoloc.demo.recordings import SHIPPED

FIRST = (0, 8, 16, 22)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Localizer:
    return Localizer(lab_map(tmp_path_factory.mktemp("lab")))


def _moved(rig: Rig, name: str, xi: list[float]) -> Rig:
    moved = rig.cameras[name].rig_from_cam @ Rigid3.exp(np.array(xi))
    return Rig(dict(rig.cameras) | {name: replace(rig.cameras[name], rig_from_cam=moved)})


def test_a_rig_of_one_answers_as_its_camera(lab: Localizer):
    for first in (0, 22):
        rig, images, _ = instant(first)
        mounted = rig.cameras["b"]
        alone = lab.localize(images["b"], mounted.camera)
        result = RigLocalizer(lab, Rig({"b": mounted})).localize({"b": images["b"]})
        assert isinstance(result, RigLocalization)
        assert alone.localized is True
        world_from_cam = result.world_from_rig @ mounted.rig_from_cam
        assert np.allclose(world_from_cam.matrix(), alone.world_from_cam.matrix(), atol=1e-12)
        assert result.probability == pytest.approx(alone.probability, abs=1e-12)
        of_cam = mounted.rig_from_cam.inverse().transform_covariance(result.covariance)
        assert np.allclose(of_cam, alone.camera_covariance, rtol=1e-6, atol=1e-15)


def test_all_cameras_make_the_pose_and_it_is_nearer_than_that_of_one(lab: Localizer):
    single, together = list[float](), list[float]()
    for first in FIRST:
        rig, images, truth = instant(first)
        result = RigLocalizer(lab, rig).localize(images)
        assert isinstance(result, RigLocalization)
        assert sorted(result.used) == list(NAMES)
        assert not result.left_out
        difference = (result.world_from_rig.inverse() @ truth).log()
        assert difference @ np.linalg.solve(result.covariance, difference) < 22.5  # 99.9 %
        together.append(float(np.linalg.norm(difference[:3])))
        for name, one in result.cameras.items():
            assert one.localized is True
            pose = one.world_from_cam @ rig.cameras[name].rig_from_cam.inverse()
            single.append(float(np.linalg.norm(pose.translation - truth.translation)))
    assert np.sqrt(np.mean(np.square(together))) < 0.9 * np.sqrt(np.mean(np.square(single)))


@pytest.mark.parametrize(
    "xi", [[0, 0, 0, 0, np.deg2rad(5.0), 0], [0.3, 0, 0, 0, 0, 0]], ids=["5 deg", "30 cm"]
)
@pytest.mark.parametrize("name", NAMES)
def test_a_wrongly_mounted_camera_is_left_out(lab: Localizer, name: str, xi: list[float]):
    rig, images, truth = instant(8)
    result = RigLocalizer(lab, _moved(rig, name, xi)).localize(images)
    assert isinstance(result, RigLocalization)
    assert list(result.left_out) == [name]
    assert "mounted otherwise" in result.left_out[name]
    assert name not in result.used
    assert np.linalg.norm(result.world_from_rig.translation - truth.translation) < 0.05


def test_swapped_images_are_named_and_put_right(lab: Localizer):
    rig, images, truth = instant(16)
    swapped = images | {"a": images["c"], "c": images["a"]}
    result = RigLocalizer(lab, rig).localize(swapped)
    assert isinstance(result, RigLocalization)
    assert result.left_out == {
        "a": "its image is that of c: swapped",
        "c": "its image is that of a: swapped",
    }
    assert np.linalg.norm(result.world_from_rig.translation - truth.translation) < 0.05


def test_a_dead_camera_is_named_and_a_missing_one_is_not_needed(lab: Localizer):
    rig, images, truth = instant(0)
    dead = images | {"b": np.zeros_like(images["b"])}
    result = RigLocalizer(lab, rig).localize(dead)
    assert isinstance(result, RigLocalization)
    assert result.left_out == {"b": "its image is uniform"}
    assert sorted(result.used) == ["a", "c"]
    del dead["b"]
    again = RigLocalizer(lab, rig).localize(dead)
    assert isinstance(again, RigLocalization)
    assert not again.left_out
    assert np.linalg.norm(again.world_from_rig.translation - truth.translation) < 0.05


def test_two_cameras_that_contradict_each_other_give_no_pose(lab: Localizer):
    rig, images, _ = instant(8)
    two = {name: images[name] for name in ("a", "b")}
    wrong = _moved(rig, "b", [0.3, 0, 0, 0, 0, 0])
    result = RigLocalizer(lab, wrong).localize(two)
    assert isinstance(result, RigNotLocalized)
    assert result.reason == "ambiguous"
    assert result.detail == "the cameras show different places: a; b"


def test_images_of_another_place_are_refused(lab: Localizer):
    rig, _, _ = instant(0)
    street = open_sequence(SHIPPED / "street")
    images = {name: street[k].image for k, name in enumerate(NAMES)}
    unknown = Rig({name: replace(one, camera=None) for name, one in rig.cameras.items()})
    result = RigLocalizer(lab, unknown).localize(images)
    assert isinstance(result, RigNotLocalized)
    line = result.to_json("x")
    assert line["localized"] is False
    assert set(line["cameras"]) == set(NAMES)


def test_bad_images_are_one_line(lab: Localizer):
    rig, images, _ = instant(0)
    localizer = RigLocalizer(lab, rig)
    with pytest.raises(
        QueryError, match="no camera of the rig is named d; its cameras are a, b, c"
    ):
        localizer.localize({"d": images["a"]})
    with pytest.raises(QueryError, match="no image; its cameras are"):
        localizer.localize({})
    with pytest.raises(QueryError, match="b: the image"):
        localizer.localize({"b": images["b"][::2]})
