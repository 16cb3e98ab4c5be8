"""Check that results survive a round trip through JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from built_room import built_room, unseen_views, write_pictures
from topoloc.evaluation.metrics import EvaluatedQuery, summarize
from topoloc.evaluation.query_localization import localize_queries
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Alternative, Localization, NotLocalized
from topoloc.recordings.open import open_sequence
from topoloc_paper.stored_answers import answers_of, rows_of


def test_stored_answers_are_the_same_answers(tiny_recording: Path, tmp_path: Path):
    sequence = open_sequence(
        write_pictures(tmp_path / "views", [*unseen_views()[:3], *unseen_views(seed=1)[:1]])
    )
    answers = localize_queries(Localizer(built_room(tiny_recording)), sequence, label="views")
    assert {answer.result.localized for answer in answers} == {True, False}
    rows = json.loads(json.dumps(rows_of(answers)))
    again = answers_of(rows, "views", sequence)
    mine, theirs = summarize(again), summarize(answers)
    mine.pop("median_times_ms"), theirs.pop("median_times_ms")  # rounded when stored
    for row in (*mine.pop("recordings"), *theirs.pop("recordings")):
        assert row["name"] == "views"
    for key in [key for key in mine if key.startswith(("median_", "max_"))]:
        assert mine.pop(key) == pytest.approx(theirs.pop(key))
    assert mine == theirs
    for before, after in zip(answers, again, strict=True):
        assert after.read_image is not None
        assert np.array_equal(after.read_image(), sequence[int(before.query[-6:-4])].image)
        assert after.camera == before.camera
        if isinstance(before.result, Localization):
            assert isinstance(after.result, Localization)
            assert after.result.evidence == before.result.evidence
            assert np.allclose(after.result.covariance, before.result.covariance)


def test_the_alternatives_of_an_ambiguity_are_stored():
    poses = [Rigid3.identity(), Rigid3(np.eye(3), np.array([9.0, 0.0, 1.0]))]
    alternatives = tuple(Alternative(pose, 0.5 - 0.1 * k, k) for k, pose in enumerate(poses))
    answer = EvaluatedQuery(
        "a.png",
        NotLocalized("ambiguous", alternatives=alternatives),
        None,
        None,
        "walk",
        None,
        None,
        frozenset(),
    )
    (again,) = answers_of(json.loads(json.dumps(rows_of([answer]))), "walk")
    assert isinstance(again.result, NotLocalized)
    assert again.result.to_json("a.png") == answer.result.to_json("a.png")
    assert len(again.result.alternatives) == 2
