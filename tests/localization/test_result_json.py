"""Test results read back from JSON: they equal the written ones, and any other JSON raises
one error type."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from jsonschema import Draft202012Validator

from built_room import built_room, unseen_views
from schemas import SCHEMA, check_result
from tiny_world import CAMERA, render, room
from topoloc.errors import ResultError
from topoloc.geometry.calibration_check import CalibrationMismatch
from topoloc.geometry.geodesy import CAM_FROM_BODY, GeoPoint, Georeference
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.localizer import Localizer
from topoloc.localization.provenance import Evidence, Provenance
from topoloc.localization.result import (
    Alternative,
    CandidateNode,
    Localization,
    NotLocalized,
    result_from_json,
)
from topoloc.tracking.tracker import Tracker

POSE = Rigid3(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([1.0, -2.0, 0.5]))
PLACE = Georeference(
    GeoPoint(48.2, 16.37, 170.0),
    Rigid3(exp_so3(np.array([0.0, 0.0, 0.7])), np.array([3.0, 4.0, 0.0])),
    "origin",
)
PROVENANCE = Provenance("0123456789abcdef", 3, "surf", 1_700_000_000_123_456_789, CAMERA)
LOCALIZED = Localization(
    POSE,
    np.diag(np.arange(1.0, 7.0)) * 1e-5,
    0.98,
    17,
    [CandidateNode(17, 0.8)],
    212,
    158,
    {"total": 60.0},
    None,
    512.5,
    1.0,
    False,
    PROVENANCE,
)
REFUSED = NotLocalized(
    *(
        "ambiguous",
        [CandidateNode(3, 0.7)],
        96,
        61,
        {"total": 88.1},
        "as much like node 8",
        (Alternative(POSE, 0.5, 3),),
        PROVENANCE,
    )
)


SUSPECTED = replace(
    LOCALIZED,
    evidence=Evidence(60, 55, 140, 160, 3, 0.4, 0.3, 0.8, 12),
    noise_share=0.25,
    calibration_doubt=CalibrationMismatch(
        261.5,
        0.5,
        300.0,
        np.array([320.0, 200.5]),
        np.array([320.0, 190.0]),
        ["focal_length"],
        np.arange(6.0),
    ),
)


def rounded(value: Any) -> Any:
    """Round all numbers. The conversion of a quaternion to a matrix and back changes
    the last digits."""
    if isinstance(value, dict):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return round(value, 12) if isinstance(value, float) else value


def test_the_schema_is_valid():
    Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize(
    "result",
    [
        LOCALIZED,
        SUSPECTED,
        replace(SUSPECTED, evidence=Evidence(60, 55, 140, 160, 3, 0.4, 0.3, 0.8)),
        replace(LOCALIZED, geopose=PLACE.geopose(POSE)),
        REFUSED,
        replace(REFUSED, alternatives=(Alternative(POSE, 0.5, 3, PLACE.geopose(POSE)),)),
        NotLocalized("unreadable"),
    ],
)
def test_written_results_are_read_again(result: Localization | NotLocalized):
    text = json.dumps(result.to_json("a.png"), allow_nan=False)
    check_result(json.loads(text))
    again = result_from_json(text)
    assert type(again) is type(result)
    assert again.provenance == result.provenance
    assert rounded(again.to_json()) == rounded(json.loads(text))
    assert again.to_json("b.png")["query"] == "b.png"


def test_calibration_faults_are_read_again():
    again = Localization.from_json(SUSPECTED.to_json("a.png"))
    assert again.evidence == SUSPECTED.evidence
    assert again.noise_share == 0.25
    assert again.calibration_doubt is not None
    assert str(again.calibration_doubt) == str(SUSPECTED.calibration_doubt)
    np.testing.assert_array_equal(again.calibration_doubt.shift, np.arange(6.0))


@pytest.mark.parametrize(
    "broken",
    [
        {"evidence": 3},
        {"evidence": {"num_matches": 1}},
        {"noise_share": 2.0},
        {"calibration_doubt": []},
        {"calibration_doubt": {"focal_length_px": -1}},
        {"calibration_doubt": SUSPECTED.to_json("a")["calibration_doubt"] | {"shift": [1.0]}},
        {"calibration_doubt": SUSPECTED.to_json("a")["calibration_doubt"] | {"of": "focal_length"}},
    ],
)
def test_invalid_evidence_is_refused(broken: dict[str, Any]):
    with pytest.raises(ResultError, match="no result"):
        Localization.from_json(SUSPECTED.to_json("a") | broken)


def test_real_results_fit_the_schema(tiny_recording: Path):
    topomap = replace(built_room(tiny_recording), georeference=PLACE)
    localizer = Localizer(topomap)
    picture, pose = unseen_views()[0]
    found = localizer.localize(picture, CAMERA, t_ns=5)
    assert isinstance(found, Localization)
    line = found.to_json("a.png")
    check_result(line)
    assert line["map"] == localizer.context.map_id != ""
    assert (line["version"], line["t_ns"], line["features"]) == (1, 5, "surf")
    assert line["camera"] == CAMERA.to_json()
    assert 0.0 < line["position_sigma_m"] < 0.1
    elsewhere = localizer.localize(render(room(1), pose)[0], CAMERA)
    assert isinstance(elsewhere, NotLocalized)
    check_result(elsewhere.to_json("b.png"))
    rough = localizer.localize(picture, None)
    assert isinstance(rough, Localization)
    assert rough.provenance.camera is not None
    assert rough.provenance.camera.fx == rough.focal_length_px
    check_result(rough.to_json("c.png"))


def test_streams_fit_the_schema_and_have_times(tiny_recording: Path):
    tracker = Tracker(Localizer(replace(built_room(tiny_recording), georeference=PLACE)))
    views = unseen_views(step=0.5)[:4]
    lines = [
        tracker.process(picture, CAMERA, 100_000_000 * number).to_json(f"{number}")
        for number, (picture, _) in enumerate(views)
    ]
    assert "tracked" in {line["state"] for line in lines}
    for number, line in enumerate(lines):
        check_result(line)
        assert line["t_ns"] == 100_000_000 * number
        assert line["localized"] == ("geopose" in line)
        assert line["camera"] == CAMERA.to_json()
    check_result(tracker.process_missing(10**9, NotLocalized("unreadable")).to_json("none"))


def test_a_geopose_gives_back_the_pose():
    geopose = PLACE.geopose(POSE)
    enu_from_ecef = PLACE.origin.ecef_from_enu().inverse()
    np.testing.assert_allclose(
        PLACE.enu_from_world.inverse().apply(enu_from_ecef.apply(geopose.position.ecef())),
        POSE.translation,
        atol=1e-8,
    )
    enu_from_body = Rigid3.from_quat_wxyz(geopose.quat_wxyz, np.zeros(3)).rotation
    # a few metres from the origin, north and up are the same to a millionth
    np.testing.assert_allclose(
        enu_from_body, PLACE.enu_from_world.rotation @ POSE.rotation @ CAM_FROM_BODY, atol=3e-6
    )


@pytest.mark.parametrize(
    "broken",
    [
        "",
        "[" * 100_000,
        "null",
        "[]",
        '{"localized": true}',
        b"\xff\xfe",
        {**LOCALIZED.to_json(""), "covariance": [[float("nan")] * 6] * 6},
        {**LOCALIZED.to_json(""), "covariance": [[1.0] * 6] * 5},
        {**LOCALIZED.to_json(""), "covariance": (-np.eye(6)).tolist()},
        {
            **LOCALIZED.to_json(""),
            "world_from_cam": {"translation": [0, 0, 0], "quat_wxyz": [0, 0, 0, 0]},
        },
        {
            **LOCALIZED.to_json(""),
            "world_from_cam": {"translation": [0, 0, 10**400], "quat_wxyz": [1, 0, 0, 0]},
        },
        {**LOCALIZED.to_json(""), "world_from_cam": json.dumps(POSE.to_json())},
        {**LOCALIZED.to_json(""), "probability": 1.5},
        {**LOCALIZED.to_json(""), "node": True},
        {**LOCALIZED.to_json(""), "camera": {"model": "PINHOLE"}},
        {**LOCALIZED.to_json(""), "camera": 3},
        {**LOCALIZED.to_json(""), "t_ns": 0.5},
        {
            **LOCALIZED.to_json(""),
            "geopose": {
                "position": {"lat": 100, "lon": 0, "h": 0},
                "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1},
            },
        },
        {**LOCALIZED.to_json(""), "geopose": [[[]]]},
        {**LOCALIZED.to_json(""), "candidates": [[1, 2, 3]]},
        {**LOCALIZED.to_json(""), "times_ms": []},
        {**REFUSED.to_json(""), "reason": "tired"},
        {**REFUSED.to_json(""), "reason": []},
        {**REFUSED.to_json(""), "alternatives": [3]},
    ],
)
def test_an_invalid_result_is_one_error(broken: Any):
    with pytest.raises(ResultError, match="no result"):
        result_from_json(broken)


def test_each_result_type_refuses_the_other():
    with pytest.raises(ResultError, match=r"NotLocalized\.from_json"):
        Localization.from_json(REFUSED.to_json(""))
    with pytest.raises(ResultError, match=r"[( ]Localization\.from_json"):
        NotLocalized.from_json(LOCALIZED.to_json(""))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=7) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)


@given(
    result=st.sampled_from([LOCALIZED, REFUSED]),
    key=st.sampled_from(sorted({*LOCALIZED.to_json(""), *REFUSED.to_json("")})),
    value=JSON,
)
def test_any_value_under_any_key_is_read_or_refused(
    result: Localization | NotLocalized, key: str, value: Any
):
    try:
        again = result_from_json({**result.to_json(""), key: value})
    except ResultError:
        return
    json.dumps(again.to_json(""), allow_nan=False)
