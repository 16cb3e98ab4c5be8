"""Messages of the OSCP GeoPose Protocol, versions 1 and 2
(github.com/OpenArCloud/oscp-geopose-protocol).

Clients leave out much of what the protocol asks for, so that here only what is used is wanted.
Version 1 has one flat list of readings, and a camera's parameters in its sensor; version 2 lists by
kind, and parameters in the reading.
"""

from __future__ import annotations

import base64
import binascii
import math
import re
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from topoloc import AtlasError, GeoPositionPrior, Georeference, Image, Localization
from topoloc.apps.service.request_errors import RequestError
from topoloc.plugin import EncodedImage

R = TypeVar("R", bound=BaseModel)
MEDIA_TYPE = "application/vnd.oscp+json"
_RAW_CHANNELS = {"RGBA32": 4, "GRAY8": 1}
_VERSION = re.compile(r"version=\"?([0-9]+(?:\.[0-9]+)?)")
EXAMPLE = {
    "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
    "timestamp": 1700000000000,
    "type": "geopose",
    "sensors": [{"id": "0", "type": "camera"}],
    "sensorReadings": {
        "cameraReadings": [
            {
                "timestamp": 1700000000000,
                "sensorId": "0",
                "imageFormat": "JPG",
                "size": [640, 400],
                "imageBytes": "/9j/4AAQSkZJRg...",
                "params": {"model": "PINHOLE", "modelParams": [380, 380, 320, 200]},
            }
        ]
    },
}
"""What a client sends, its picture left out."""
_KNOWN_VERSIONS = ("1", "1.0", "2", "2.0")


class CameraParam(BaseModel):
    """COLMAP's model name and parameters, in COLMAP's order and convention."""

    model: str | None = None
    modelParams: list[float] | None = None


class ImageOrientation(BaseModel):
    mirrored: bool = False
    rotation: float = 0.0


class CameraReading(BaseModel):
    """A picture, base64; `imageFormat` is RGBA32, GRAY8 or JPG."""

    imageBytes: str
    sensorId: str = ""
    imageFormat: str = "JPG"
    size: list[float] | None = None
    imageOrientation: ImageOrientation | None = None
    params: CameraParam | None = None


class GeolocationReading(BaseModel):
    """Where the device takes itself to be: degrees, and metres of which two thirds of all readings
    are closer to the truth."""

    latitude: float | None = None
    longitude: float | None = None
    accuracy: float | None = None


class SensorReadings(BaseModel):
    """Version 2."""

    cameraReadings: list[CameraReading] | None = None
    geolocationReadings: list[GeolocationReading] | None = None


class SensorReading(BaseModel):
    """Version 1."""

    sensorId: str = ""
    reading: dict[str, Any] | None = None


class Sensor(BaseModel):
    id: str
    type: str
    params: CameraParam | None = None


class GeoPoseRequest(BaseModel):
    id: str
    timestamp: float | str = Field(0.0, description="milliseconds since 1970")
    type: str = "geopose"
    sensors: list[Sensor] = []
    sensorReadings: SensorReadings | list[SensorReading]

    def camera_reading(self) -> CameraReading:
        """The first camera's reading. Raises RequestError."""
        readings = self.sensorReadings
        if isinstance(readings, SensorReadings):
            found = readings.cameraReadings or []
        else:
            found = [
                _flatten_reading(one, CameraReading)
                for one in readings
                if "imageBytes" in (one.reading or {})
            ]
        if not found:
            raise RequestError(400, "the request has no reading of a camera")
        params = {sensor.id: sensor.params for sensor in self.sensors}
        return found[0].model_copy(
            update={"params": found[0].params or params.get(found[0].sensorId)}
        )

    def near(self, slack_m: float) -> GeoPositionPrior | None:
        """Where the device takes itself to be, by the first reading that says how exactly, with
        three times that and `slack_m` metres around it. None where no reading says so, or one makes
        no sense: then nothing is known."""
        readings = self.sensorReadings
        if isinstance(readings, SensorReadings):
            found = readings.geolocationReadings or []
        else:
            found = [
                _flatten_reading(one, GeolocationReading)
                for one in readings
                if "latitude" in (one.reading or {})
            ]
        for one in found:
            if (
                one.latitude is None
                or one.longitude is None
                or not one.accuracy
                or one.accuracy < 0.0
            ):  # some send 0 for "unknown"
                continue
            with suppress(AtlasError):
                return GeoPositionPrior(one.latitude, one.longitude, 3.0 * one.accuracy + slack_m)
        return None


class Accuracy(BaseModel):
    """Standard deviations, the quadratic mean of the three components."""

    position: float = Field(description="metres", ge=0.0)
    orientation: float = Field(description="degrees", ge=0.0)


class Position(BaseModel):
    lat: float
    lon: float
    h: float


class Quaternion(BaseModel):
    x: float
    y: float
    z: float
    w: float


class GeoPoseOgc(BaseModel):
    """OGC GeoPose 1.0, Basic-Quaternion."""

    position: Position
    quaternion: Quaternion


class GeoPoseReply(BaseModel):
    id: str
    timestamp: float
    type: str = "geopose"
    accuracy: Accuracy
    geopose: GeoPoseOgc


class GeoPoseError(BaseModel):
    """Why there is no pose."""

    ERROR: str
    request_id: str
    reason: str | None = None


def check_version(accept: str) -> None:
    """Raises RequestError where an Accept header names a version of the protocol that is neither
    1.0 nor 2.0."""
    named = _VERSION.search(accept)
    if named and named.group(1) not in _KNOWN_VERSIONS:
        raise RequestError(
            400,
            f"version {named.group(1)} of the GeoPose Protocol is not spoken here; 1.0 and 2.0 are",
        )


def read_request(body: bytes) -> GeoPoseRequest:
    """Raises RequestError where it is none."""
    try:
        return GeoPoseRequest.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        raise RequestError(
            400, f"no GeoPose request: {'.'.join(map(str, first['loc']))}: {first['msg']}"
        ) from None


def read_image_bytes(reading: CameraReading) -> EncodedImage | Image:
    """The picture: a file's bytes, whatever the format is called (clients call JPEG files RGBA32),
    else bare pixels.

    Raises:
        RequestError: neither.
    """
    if reading.imageOrientation is not None and reading.imageOrientation.mirrored:
        raise RequestError(400, "a mirrored picture; it must be sent as the camera saw the world")
    if reading.imageFormat.upper() == "DEPTH":
        raise RequestError(400, "a picture of depth cannot be localized")
    try:
        data = base64.b64decode(
            reading.imageBytes.rpartition(",")[2], validate=True
        )  # some send a data: address
    except (binascii.Error, ValueError):
        raise RequestError(400, "imageBytes: not base64") from None
    if not data:
        raise RequestError(400, "imageBytes: empty")
    channels = _RAW_CHANNELS.get(reading.imageFormat.upper())
    width, height = read_image_size(reading) or (0, 0)
    if channels and width * height * channels == len(data):
        pixels = np.frombuffer(data, np.uint8).reshape(height, width, channels)
        return pixels[:, :, 0] if channels == 1 else np.ascontiguousarray(pixels[:, :, :3])
    return EncodedImage("imageBytes", data)


def read_image_size(reading: CameraReading) -> tuple[int, int] | None:
    """Width and height (pixels) as the reading tells them; None where it tells none."""
    size = reading.size or []
    if len(size) != 2 or not all(1.0 <= length <= 1e5 for length in size):
        return None
    return int(size[0]), int(size[1])


def camera_to_json(reading: CameraReading) -> dict[str, Any] | None:
    """The camera as `query_cameras.camera_from_json` takes it; None where the reading tells
    none."""
    params = reading.params
    if (
        params is None
        or not params.modelParams
        or (params.model or "UNKNOWN").upper().startswith("UNKNOWN")
    ):
        return None
    return {"model": (params.model or "").upper(), "params": params.modelParams}


def create_reply(
    request: GeoPoseRequest, result: Localization, georeference: Georeference, now_ms: float
) -> GeoPoseReply:
    """The reply; where the map's place on earth was fitted, what that fit left over counts, too."""
    assert result.geopose is not None, "a map that knows its place"
    position_sigma = math.hypot(result.position_sigma_m, georeference.rms_m or 0.0)
    mean = 1.0 / math.sqrt(3.0)
    return GeoPoseReply(
        id=request.id,
        timestamp=request.timestamp if isinstance(request.timestamp, float) else now_ms,
        accuracy=Accuracy(
            position=mean * position_sigma, orientation=mean * result.rotation_sigma_deg
        ),
        geopose=GeoPoseOgc.model_validate(result.geopose.to_json()),
    )


def _flatten_reading(one: SensorReading, kind: type[R]) -> R:
    try:
        return kind.model_validate({**(one.reading or {}), "sensorId": one.sensorId})
    except ValidationError as error:
        first = error.errors(include_input=False, include_url=False)[0]
        raise RequestError(
            400, f"no reading of this kind: {'.'.join(map(str, first['loc']))}: {first['msg']}"
        ) from None
