"""Test queries of frames with and without ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from built_room import built_room, unseen_views, write_pictures
from topoloc.errors import CalibrationError, TrajectoryError
from topoloc.evaluation.query_localization import localize_out_of_map, localize_queries
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.recordings.open import open_sequence


@pytest.fixture(scope="module")
def localizer(tiny_recording: Path) -> Localizer:
    return Localizer(built_room(tiny_recording))


@pytest.fixture
def views(tmp_path: Path) -> Path:
    return write_pictures(tmp_path / "views", unseen_views()[:3])


def test_every_frame_with_truth_is_queried_with_progress(localizer: Localizer, views: Path):
    (views / "truth.tum").write_text(
        "\n".join((views / "truth.tum").read_text().splitlines()[:2]) + "\n"
    )
    told = []
    answers = localize_queries(
        localizer, open_sequence(views), progress=lambda *step: told.append(step)
    )
    assert [a.query for a in answers] == ["view00.png", "view01.png"]
    assert told == [("views", 1, 2), ("views", 2, 2)]
    assert max(a.translation_m for a in answers) < 0.02
    assert all(a.recording == "views" for a in answers)
    assert answers[1].read_image is not None
    np.testing.assert_array_equal(answers[1].read_image(), unseen_views()[1][0])


def test_the_nearest_node_is_that_of_eq_1(localizer: Localizer, views: Path):
    (answer, *_) = localize_queries(localizer, open_sequence(views))
    centres = np.array([s.world_from_cam.translation for s in localizer.topomap.summaries])
    assert answer.world_from_cam is not None
    distances = np.linalg.norm(centres - answer.world_from_cam.translation, axis=1)
    assert answer.nearest_node_id in np.argsort(distances)[:2]  # rotation counts as well


def test_angle_and_light_are_those_to_the_nearest_mapped_frame(
    localizer: Localizer, tmp_path: Path
):
    dark = [(image // 2, pose) for image, pose in unseen_views()[:3]]
    sequence = open_sequence(write_pictures(tmp_path / "dark", dark))
    turned = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.radians(30.0)]))
    plain, aside = (localize_queries(localizer, sequence, t) for t in (None, turned))
    assert [one.light_ratio for one in plain] == pytest.approx([2.0] * 3, rel=0.05)
    assert max(one.angle_deg for one in plain) < 2.0
    assert [one.angle_deg for one in aside] == pytest.approx([30.0] * 3, abs=3.0)


def test_truth_of_another_world_is_brought_into_the_maps(localizer: Localizer, views: Path):
    there = Rigid3.exp(np.array([5.0, -2.0, 1.0, 0.3, -0.2, 1.0]))
    plain = localize_queries(localizer, open_sequence(views))
    moved = localize_queries(localizer, open_sequence(views), map_from_truth=there)
    for before, after in zip(plain, moved, strict=True):
        assert before.world_from_cam is not None
        assert after.world_from_cam is not None
        np.testing.assert_allclose(
            after.world_from_cam.matrix(), (there @ before.world_from_cam).matrix(), atol=1e-12
        )


def test_images_from_elsewhere_have_no_truth(localizer: Localizer, views: Path):
    told = []
    answers = localize_out_of_map(
        localizer, open_sequence(views), progress=lambda *step: told.append(step)
    )
    assert [a.world_from_cam for a in answers] == [None] * 3
    assert all(a.is_false_accept for a in answers)  # they are of the room after all
    assert told[-1] == ("views (out of map)", 3, 3)


def test_without_truth_or_calibration_nothing_is_queried(localizer: Localizer, views: Path):
    (views / "camera.json").unlink()
    with pytest.raises(CalibrationError, match=r"view00\.png: no calibration"):
        localize_queries(localizer, open_sequence(views))
    (views / "truth.tum").unlink()
    with pytest.raises(TrajectoryError, match="views: no frame has a known pose"):
        localize_queries(localizer, open_sequence(views))
