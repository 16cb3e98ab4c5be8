"""Test the GeoPose Protocol: requests of its reference clients, and replies against its schema and
the native result."""

from __future__ import annotations

import base64
import json
import math
import shutil
from pathlib import Path
from typing import Any

import cv2
import httpx
import jsonschema
import numpy as np
import pytest
from running_service import running

from schemas import GEOPOSE, check_geopose, strict_object

ROUTE = "/localize/geopose"
ACCEPT = "application/vnd.oscp+json;version=2.0;"
_NUMBER = {"type": "number"}
# geoPoseRespSchema of gpp-access (lib/index.ts)
REPLY = strict_object(
    id={"type": "string"},
    timestamp=_NUMBER,
    type={"const": "geopose"},
    accuracy=strict_object(position=_NUMBER, orientation=_NUMBER),
    geopose=GEOPOSE,
)
PRIVACY = {
    "dataRetention": [],
    "dataAcceptableUse": [],
    "dataSanitizationApplied": [],
    "dataSanitizationRequested": [],
}


def _params(camera: str) -> dict[str, Any]:
    named = json.loads(camera)
    return {
        "model": "PINHOLE",
        "modelParams": [named["fx"], named["fy"], named["cx"] + 0.5, named["cy"] + 0.5],
    }


def _version_2(view: Path, camera: str, **changed: Any) -> dict[str, Any]:
    """Return a request as the protocol's python/demo_client.py writes it. It declares file
    bytes as RGBA32."""
    reading = {
        "timestamp": 1.7e12,
        "sensorId": "my_camera_sensor",
        "privacy": PRIVACY,
        "sequenceNumber": 1,
        "imageFormat": "RGBA32",
        "size": [320, 240],
        "imageBytes": base64.b64encode(view.read_bytes()).decode(),
        "imageOrientation": {"mirrored": False, "rotation": 0.0},
        "params": _params(camera) | {"minMaxDepth": [], "minMaxDisparity": []},
    }
    place = {
        "latitude": 50.87,
        "longitude": 4.7,
        "altitude": 30,
        "accuracy": 0,
        "altitudeAccuracy": 0,
        "heading": 0,
        "speed": 0,
    }
    where = {"timestamp": 1.7e12, "sensorId": "my_gps_sensor", "privacy": PRIVACY} | place
    return {
        "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
        "timestamp": 1700000000123.5,
        "type": "geopose",
        "sensors": [
            {"id": "my_camera_sensor", "type": "camera", "name": ""},
            {"id": "my_gps_sensor", "type": "geolocation"},
        ],
        "sensorReadings": {
            "cameraReadings": [reading | changed],
            "geolocationReadings": [where],
            "wiFiReadings": [],
        },
        "priorPoses": [],
    }


def _version_1(view: Path, camera: str) -> dict[str, Any]:
    """Return a request as demo_ac/oscp_demo_client.py writes it, with the camera
    parameters of version 1."""
    picture = {
        "sequenceNumber": 0,
        "imageFormat": "JPG",
        "imageOrientation": {"mirrored": False, "rotation": 0},
    }
    picture |= {"imageBytes": base64.b64encode(view.read_bytes()).decode()}
    return {
        "id": "17",
        "timestamp": 1700000000000,
        "type": "geopose",
        "sensors": [
            {"id": "0", "type": "camera", "params": _params(camera)},
            {"id": "1", "type": "geolocation"},
        ],
        "sensorReadings": [
            {
                "timestamp": 1700000000000,
                "sensorId": "1",
                "reading": {"latitude": 50.87, "longitude": 4.7, "altitude": 0},
            },
            {"timestamp": 1700000000000, "sensorId": "0", "reading": picture},
        ],
    }


def _ask(client: httpx.Client, request: Any, accept: str = ACCEPT) -> httpx.Response:
    return client.post(ROUTE, json=request, headers={"accept": accept})


@pytest.mark.parametrize("version", [1, 2])
def test_recorded_requests_get_the_pose_of_the_native_answer(
    client: httpx.Client, view: Path, camera: str, version: int
):
    request = _version_2(view, camera) if version == 2 else _version_1(view, camera)
    answer = _ask(client, request, f"application/vnd.oscp+json; version={version}.0;")
    assert answer.status_code == 200, answer.text
    reply = answer.json()
    jsonschema.validate(reply, REPLY)
    check_geopose(reply["geopose"])
    assert (reply["id"], reply["timestamp"]) == (request["id"], request["timestamp"])
    native = client.post(
        "/v1/maps/earth/localize", files={"image": view.open("rb")}, data={"camera": camera}
    ).json()
    for part in ("position", "quaternion"):
        assert reply["geopose"][part] == pytest.approx(native["geopose"][part], abs=1e-9)
    assert reply["accuracy"]["position"] == pytest.approx(
        native["position_sigma_m"] / math.sqrt(3.0)
    )
    assert reply["accuracy"]["orientation"] == pytest.approx(
        native["rotation_sigma_deg"] / math.sqrt(3.0)
    )


def test_base64_in_lines(client: httpx.Client, view: Path, camera: str):
    lines = base64.encodebytes(view.read_bytes()).decode()
    for text in (lines, lines.replace("\n", "\r\n"), f"data:image/jpeg;base64,{lines}"):
        request = _version_2(view, camera, imageBytes=text)
        assert _ask(client, request).status_code == 200


def test_bare_pixels(client: httpx.Client, view: Path, camera: str):
    grey = cv2.imread(str(view), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    for kind, pixels in (("GRAY8", grey), ("RGBA32", cv2.cvtColor(grey, cv2.COLOR_GRAY2RGBA))):
        bare = {"imageFormat": kind, "imageBytes": base64.b64encode(pixels.tobytes()).decode()}
        assert _ask(client, _version_2(view, camera, **bare)).status_code == 200


def test_other_versions_and_malformed_requests_are_a_400_with_a_reason(
    client: httpx.Client, view: Path, camera: str
):
    good = _version_2(view, camera)
    wrong = [
        _ask(client, good, "application/vnd.oscp+json;version=3.0;"),
        _ask(client, good, "application/vnd.oscp+json;version=2.1;"),
        _ask(client, good | {"sensorReadings": {}}),
        _ask(client, {"id": "1"}),
        _ask(client, []),
        client.post(ROUTE, content=b"{", headers={"accept": ACCEPT}),
        _ask(client, _version_2(view, camera, imageBytes="???")),
        _ask(client, _version_2(view, camera, imageBytes="")),
        _ask(client, _version_2(view, camera, imageBytes=base64.b64encode(b"no picture").decode())),
        _ask(client, _version_2(view, camera, imageOrientation={"mirrored": True, "rotation": 0})),
        _ask(
            client,
            _version_2(view, camera, params={"model": "PINHOLE", "modelParams": [0, 0, 0, 0]}),
        ),
        _ask(
            client,
            _version_2(view, camera, params={"model": "FOV", "modelParams": [1, 2, 3, 4, 5]}),
        ),
    ]
    for answer in wrong:
        assert answer.status_code == 400, answer.text
        assert answer.json()["ERROR"]


def test_a_map_that_cannot_be_opened_is_left_out(
    maps: Path, view: Path, camera: str, tmp_path: Path
):
    shutil.copy(maps / "earth.topo", tmp_path / "earth.topo")
    (tmp_path / "broken.topo").write_text("no map")
    with running(tmp_path) as service, service.client() as client:
        request = _version_2(view, camera)
        assert _ask(client, request).status_code == 200
        named = client.post(ROUTE, params={"map": "broken"}, json=request)
        assert named.status_code == 503
        assert "broken" in named.json()["ERROR"]


def test_not_localized_is_a_404_with_its_reason(
    client: httpx.Client, view: Path, camera: str, tmp_path: Path
):
    noise = cv2.GaussianBlur(
        np.random.default_rng(3).integers(0, 255, (240, 320), dtype=np.uint8), (0, 0), 2.0
    )
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    answer = _ask(client, _version_2(tmp_path / "noise.png", camera))
    assert answer.status_code == 404
    assert answer.json()["ERROR"].startswith("not localized")
    assert answer.json()["reason"] in (
        "too_few_matches",
        "too_few_inliers",
        "not_in_map",
        "ambiguous",
    )


def test_a_map_without_a_place_on_earth_is_a_409(client: httpx.Client, view: Path, camera: str):
    answer = client.post(
        ROUTE, params={"map": "room"}, json=_version_2(view, camera), headers={"accept": ACCEPT}
    )
    assert answer.status_code == 409
    assert "georeferenced" in answer.json()["ERROR"]
    assert client.get(ROUTE).json() == {"status": "running"}
