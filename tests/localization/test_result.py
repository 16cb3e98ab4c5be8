"""Test the JSON of a query's result key by key against the documented interface."""

from __future__ import annotations

import json

import numpy as np

from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.result import Alternative, CandidateNode, Localization, NotLocalized

POSE = Rigid3(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([1.0, -2.0, 0.5]))
CANDIDATES = [CandidateNode(17, 0.812345), CandidateNode(3, 0.4)]
TIMES_MS = {"features": 30.12345, "total": 60.0}


def test_a_localization_as_json():
    line = Localization(
        POSE, np.diag(np.arange(1.0, 7.0)), 0.98, 17, CANDIDATES, 212, 158, TIMES_MS
    ).to_json("a.png")
    assert set(line) == {
        *(
            "query",
            "localized",
            "world_from_cam",
            "covariance",
            "position_sigma_m",
            "rotation_sigma_deg",
            "probability",
            "node",
        ),
        *(
            "candidates",
            "num_matches",
            "num_inliers",
            "times_ms",
            "map",
            "version",
            "t_ns",
            "camera",
            "features",
        ),
    }
    assert line["query"] == "a.png"
    assert line["localized"] is True
    assert (line["node"], line["num_matches"], line["num_inliers"], line["probability"]) == (
        17,
        212,
        158,
        0.98,
    )
    assert line["candidates"] == [[17, 0.8123], [3, 0.4]]
    assert line["times_ms"] == {"features": 30.123, "total": 60.0}
    assert line == json.loads(json.dumps(line, allow_nan=False))


def test_the_pose_survives_json_to_the_last_digit():
    line = json.loads(json.dumps(Localization(POSE, np.eye(6), 1.0, 0, [], 1, 1).to_json("a.png")))
    pose = line["world_from_cam"]
    assert pose["translation"] == [1.0, -2.0, 0.5]
    again = Rigid3.from_quat_wxyz(np.array(pose["quat_wxyz"]), np.array(pose["translation"]))
    np.testing.assert_allclose(again.matrix(), POSE.matrix(), atol=1e-15)
    np.testing.assert_array_equal(line["covariance"], np.eye(6))


def test_a_refusal_as_json_never_holds_a_pose():
    line = NotLocalized("too_few_matches", CANDIDATES, 3, 0, TIMES_MS).to_json("wall.jpg")
    assert set(line) == {
        *(
            "query",
            "localized",
            "reason",
            "detail",
            "alternatives",
            "candidates",
            "num_matches",
            "num_inliers",
            "times_ms",
        ),
        *("map", "version", "t_ns", "camera", "features"),
    }
    assert line["localized"] is False
    assert line["reason"] == "too_few_matches"
    assert json.loads(json.dumps(line)) == line


def test_empty_detail_and_alternatives_are_written():
    assert (
        NotLocalized("unreadable", detail="a.png: the file is empty").to_json("a.png")["detail"]
        == "a.png: the file is empty"
    )
    line = NotLocalized("unreadable").to_json("a.png")
    assert (line["detail"], line["alternatives"], line["camera"], line["t_ns"]) == (
        "",
        [],
        None,
        None,
    )


def test_the_cameras_own_covariance_is_that_of_a_perturbation_on_its_side():
    rng = np.random.default_rng(0)
    roots = np.diag([0.01, 0.02, 0.03, 1e-3, 2e-3, 3e-3])
    samples = rng.normal(size=(20_000, 6)) @ roots
    left = np.array([(POSE @ Rigid3.exp(xi) @ POSE.inverse()).log() for xi in samples])
    result = Localization(POSE, np.cov(left.T), 0.98, 17, CANDIDATES, 212, 158)
    deviations = np.sqrt(np.diag(result.camera_covariance))
    np.testing.assert_allclose(deviations, np.diag(roots), rtol=0.03)
    positions = np.array([(POSE @ Rigid3.exp(xi)).translation for xi in samples])
    np.testing.assert_allclose(result.position_covariance, np.cov(positions.T), atol=2e-5)


def test_an_uncalibrated_probability_is_marked():
    result = Localization(POSE, np.eye(6), 0.9, 0, [], 1, 1, calibrated=False)
    assert result.to_json("a.png")["calibrated"] is False


def test_an_ambiguity_has_alternatives_but_no_pose():
    alternatives = (Alternative(POSE, 0.5, 3), Alternative(POSE.inverse(), 0.4, 8))
    line = NotLocalized(
        "ambiguous",
        CANDIDATES,
        96,
        61,
        TIMES_MS,
        "as much like node 8 as like node 3",
        alternatives,
    ).to_json("a.png")
    assert line == json.loads(json.dumps(line, allow_nan=False))
    assert "world_from_cam" not in line
    assert [(one["node"], one["probability"]) for one in line["alternatives"]] == [
        (3, 0.5),
        (8, 0.4),
    ]
    assert (
        line["alternatives"][0]["world_from_cam"]
        == Localization(POSE, np.eye(6), 1.0, 3, [], 1, 1).to_json("")["world_from_cam"]
    )
    assert "covariance" not in line["alternatives"][0]
