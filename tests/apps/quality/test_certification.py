"""Test bounds of the rate of wrong poses, and certificates in map files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from msgspec import structs
from scipy.stats import binom

from built_room import unseen_views, write_pictures
from hand_made import answer
from topoloc.apps.quality.certificate_texts import describe_group
from topoloc.apps.quality.certification import certify, find_nodes_in_view
from topoloc.apps.quality.certified_answers import (
    CertifiedAnswers,
    WorstAnswers,
    derive_certificate,
    max_share,
    pieces_by_look,
    pieces_by_pose,
)
from topoloc.errors import MapError, TrajectoryError
from topoloc.geometry.rigid import Rigid3
from topoloc.lifelong.prune import prune
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.edit import edit_map, undo_edit
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence


@given(num=st.integers(1, 400), share=st.floats(0, 1), confidence=st.sampled_from([0.9, 0.95]))
def test_at_the_bound_few_wrong_poses_are_improbable(num: int, share: float, confidence: float):
    num_wrong = int(share * (num - 1))
    bound = max_share(num_wrong, num, confidence)
    assert binom.cdf(num_wrong, num, bound) == pytest.approx(1.0 - confidence, abs=1e-6)


def test_the_bound_without_an_error_is_the_known_one():
    assert max_share(0, 598, 0.95) == pytest.approx(0.005, rel=1e-3)
    assert max_share(3, 3, 0.95) == 1.0


@given(
    worst=st.lists(st.one_of(st.just(-1.0), st.floats(0.5, 1.0)), min_size=1, max_size=300),
    limit=st.floats(0.001, 0.5),
)
def test_the_threshold_is_the_least_that_keeps_the_limit(worst: list[float], limit: float):
    pieces = WorstAnswers(np.array(worst))
    found = pieces.find_threshold(0.5, limit, 0.95)
    limit = max(limit, max_share(0, len(worst), 0.95))
    if found is None:
        assert max_share(pieces.num_wrong(1.0), len(worst), 0.95) > limit
        return
    assert max_share(pieces.num_wrong(found), len(worst), 0.95) <= limit
    below = np.nextafter(found, 0.0)
    assert found == 0.5 or max_share(pieces.num_wrong(below), len(worst), 0.95) > limit


def test_the_certificate_holds_on_new_results():
    """In 1,000 maps the error rate falls with p. At most 5 % of the certificates may fail."""
    random, num_broken = np.random.default_rng(5), 0
    for _ in range(1000):
        p = random.uniform(0.5, 1.0, 500)
        wrong = random.uniform(size=500) < 0.2 * (1.0 - p)
        threshold = WorstAnswers(np.where(wrong, p, -1.0)).find_threshold(0.5, 0.02, 0.95)
        assert threshold is not None
        num_broken += 0.2 * (1.0 - threshold) ** 2 > 0.02  # the true share of wrong pieces
    assert num_broken <= 65


def _walk_with_wrong_answers_by_night() -> CertifiedAnswers:
    """Return 300 right answers by day with p = 0.99, and 20 by night, of which 4 are wrong, with p
    = 0.6. Each is independent."""
    answers = []
    for number in range(320):
        is_dark, is_wrong = number >= 300, number >= 316
        one = answer(str(number), 0.0, error_m=3.0 if is_wrong else 0.01, error_deg=0.0)
        assert isinstance(one.result, Localization)
        result = replace(one.result, probability=0.6 if is_dark else 0.99, times_ms={"total": 1.0})
        light, angle = (3.0 if is_dark else 1.1), 5.0
        answers.append(replace(one, result=result, light_ratio=light, angle_deg=angle))
    return CertifiedAnswers("walk", "walk", True, answers, list(range(320)))


@pytest.mark.parametrize("is_applied", [False, True])
def test_answers_are_counted_as_the_map_gives_them(is_applied: bool):
    walk = _walk_with_wrong_answers_by_night()
    found = derive_certificate([walk], LocalizerConfig(), 0.02, is_applied)
    of_walk = found.conditions[0]
    num_given, num_wrong = (300, 0) if is_applied else (320, 4)
    assert (of_walk.num_localized, of_walk.num_wrong) == (num_given, num_wrong)
    assert found.max_wrong_share == pytest.approx(max_share(num_wrong, 320, 0.95))
    assert found.threshold_wrong_share == pytest.approx(max_share(0, 320, 0.95))
    assert sum(one.num_poses for one in found.quarters if one.by == "light") == num_given
    assert ("at a probability of at least 0.6" in found.promise()) == is_applied
    state = "0.6, applied; it refuses" if is_applied else "0.6, not applied (topoloc certify"
    assert found.describe_threshold().startswith(state)
    assert "5.1 % of the right answers" in found.describe_threshold()


def test_a_group_does_not_hide_behind_the_others():
    walk = _walk_with_wrong_answers_by_night()
    groups = derive_certificate([walk], LocalizerConfig(), 0.02, False, ["light", "angle"]).groups
    by_name = {describe_group(one)[0]: one for one in groups}
    _, promise_by_night = describe_group(by_name["light 2 or more"])
    day, dusk, night = (
        by_name[f"light {name}"] for name in ("1 to 1.25", "1.25 to 2", "2 or more")
    )
    assert (day.num_images, day.max_wrong_share) == (300, max_share(0, 300, 0.95))
    assert (dusk.num_images, dusk.max_wrong_share) == (0, None)
    assert (night.num_images, night.num_wrong) == (20, 4)
    assert night.max_wrong_share == max_share(4, 20, 0.95)
    assert night.threshold_wrong_share == max_share(0, 20, 0.95)
    assert "at most 40 % wrong (n = 20)" in promise_by_night
    assert "a threshold of 0.6, not applied, makes it 14 %" in promise_by_night
    assert by_name["angle 0 to 10 deg"].num_wrong == 4


def test_a_walk_that_comes_back_gives_no_new_pieces():
    there = [Rigid3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])) for x in np.arange(0.0, 6.0, 0.1)]
    numbers = pieces_by_pose([*there, *there[::-1]], d_thresh=0.2, lambda_rot=1.0)
    assert len(set(numbers.tolist())) == 6


def test_similar_images_are_one_piece():
    random = np.random.default_rng(1)
    looks = random.normal(size=(3, 1024))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    assert pieces_by_look(looks[[0, 1, 0, 2, 1]]).tolist() == [0, 1, 0, 2, 1]


@pytest.fixture
def lab_map(room_map: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(room_map, tmp_path / "lab.topo"))


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return write_pictures(tmp_path / "walk", unseen_views())


def test_the_certificate_is_stored_shown_and_outdated_by_an_edit(lab_map: Path, walk: Path):
    before = lab_map.read_bytes()
    found = certify(lab_map, [open_sequence(walk)])
    with TopoMetricMap.load(lab_map) as topomap:
        assert topomap.certificate == found.certificate
        facts = topomap.describe(lab_map)["certificate"]
    assert facts["is_outdated"] is False
    of_walk = found.certificate.conditions[0]
    assert (of_walk.kind, of_walk.num_images) == ("walk", len(unseen_views()))
    assert of_walk.num_localized >= of_walk.num_images - 1
    assert of_walk.num_wrong == 0
    assert of_walk.num_pieces < of_walk.num_images
    assert found.certificate.max_wrong_share is not None
    assert found.certificate.max_wrong_share >= max_share(0, of_walk.num_pieces, 0.95)
    prune(lab_map, max_mb=lab_map.stat().st_size / 1e6 * 0.9)
    with TopoMetricMap.load(lab_map) as topomap:
        assert topomap.describe(lab_map)["certificate"]["is_outdated"] is True
    undo_edit(lab_map)
    undo_edit(lab_map)
    assert lab_map.read_bytes() == before


def test_an_applied_threshold_refuses_answers_below_it(lab_map: Path, walk: Path):
    views = open_sequence(walk)
    certify(lab_map, [views], is_applied=True)
    with edit_map(lab_map) as edit:
        certificate = edit.topomap.certificate
        assert certificate is not None
        assert certificate.is_applied
        high = structs.replace(certificate, min_probability=1.0)
        edit.commit(replace(edit.topomap, certificate=high), "certify")
    frame = views[0]
    refused = Localizer(lab_map).localize(frame.image, frame.camera)
    assert isinstance(refused, NotLocalized)
    assert refused.detail.endswith("below the map's certified threshold 1")
    undo_edit(lab_map)
    assert Localizer(lab_map).localize(frame.image, frame.camera).localized


def test_a_walk_of_another_place_is_refused_and_nothing_is_stored(
    lab_map: Path, walk: Path, tmp_path: Path
):
    before = lab_map.read_bytes()
    noise = np.random.default_rng(0).integers(0, 255, (len(unseen_views()), 240, 320), np.uint8)
    views = [
        (image[: view[0].shape[0], : view[0].shape[1]].copy(), *view[1:])
        for image, view in zip(noise, unseen_views(), strict=True)
    ]
    elsewhere = write_pictures(tmp_path / "elsewhere", views)
    with pytest.raises(TrajectoryError, match=r"none of .* images is localized.*--out-of-map"):
        certify(lab_map, [open_sequence(elsewhere)])
    assert lab_map.read_bytes() == before


def test_a_map_that_is_edited_meanwhile_gets_no_certificate(lab_map: Path, walk: Path):
    def edit(stage: str, done: int, total: int) -> None:
        if done == 1 and stage == "walk":
            prune(lab_map, max_mb=lab_map.stat().st_size / 1e6 * 0.95)

    with pytest.raises(MapError, match="was edited meanwhile: certify it again"):
        certify(lab_map, [open_sequence(walk)], progress=edit)
    with TopoMetricMap.load(lab_map) as topomap:
        assert topomap.certificate is None


def test_nodes_that_show_the_same_are_found(lab_map: Path):
    with TopoMetricMap.load(lab_map) as topomap:
        node = topomap.nodes[0]
        ahead = find_nodes_in_view(topomap, node.summary.world_from_cam, node.camera)
        assert node.summary.node_id in ahead
        back = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
        behind = find_nodes_in_view(topomap, node.summary.world_from_cam @ back, node.camera)
        assert node.summary.node_id not in behind
