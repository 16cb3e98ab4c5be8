"""Messages of the OSCP GeoPose Protocol, versions 1 and 2
(github.com/OpenArCloud/oscp-geopose-protocol).

Clients omit many required fields, so only the fields in use are required here. Version 1 has one
flat list of readings, and the camera parameters stand in the sensor. Version 2 has a list for each
kind of reading, and the parameters stand in the reading.
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

from topoloc import AtlasError, GeoPose, GeoPositionPrior, Georeference, Image, Localization
from topoloc.apps.service.request_errors import RequestError, invalid_request
from topoloc.plugin import EncodedImage

R = TypeVar("R", bound=BaseModel)
ROUTE = "/localize/geopose"
MEDIA_TYPE = "application/vnd.oscp+json"
_RAW_CHANNELS = {"RGBA32": 4, "GRAY8": 1}
_VERSION = re.compile(r"version=\"?([0-9]+(?:\.[0-9]+)?)")
_KNOWN_VERSIONS = ("1", "1.0", "2", "2.0")
_READING_EXAMPLE = {
    "timestamp": 1700000000000,
    "sensorId": "0",
    "imageFormat": "JPG",
    "size": [640, 400],
    "imageBytes": "/9j/4AAQSkZJRg...",
    "params": {"model": "PINHOLE", "modelParams": [380, 380, 320, 200]},
}
EXAMPLE = {
    "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
    "timestamp": 1700000000000,
    "type": "geopose",
    "sensors": [{"id": "0", "type": "camera"}],
    "sensorReadings": {"cameraReadings": [_READING_EXAMPLE]},
}
"""A request, its image cut off."""


class CameraParam(BaseModel):
    """Model name and parameters in COLMAP's order and convention."""

    model: str | None = None
    modelParams: list[float] | None = None


class ImageOrientation(BaseModel):
    """Orientation of an image relative to the camera."""

    mirrored: bool = False
    rotation: float = 0.0


class CameraReading(BaseModel):
    """An image, base64. `imageFormat` is RGBA32, GRAY8 or JPG."""

    imageBytes: str
    sensorId: str = ""
    imageFormat: str = "JPG"
    size: list[float] | None = None
    imageOrientation: ImageOrientation | None = None
    params: CameraParam | None = None


class GeolocationReading(BaseModel):
    """Position of the device by its own sensor: degrees. The accuracy in metres is the 68 %
    radius."""

    latitude: float | None = None
    longitude: float | None = None
    accuracy: float | None = None


class SensorReadings(BaseModel):
    """Readings in version 2."""

    cameraReadings: list[CameraReading] | None = None
    geolocationReadings: list[GeolocationReading] | None = None


class SensorReading(BaseModel):
    """A reading in version 1."""

    sensorId: str = ""
    reading: dict[str, Any] | None = None


class Sensor(BaseModel):
    """A sensor; version 1 stores the camera parameters here."""

    id: str
    type: str
    params: CameraParam | None = None


class GeoPoseRequest(BaseModel):
    """A request of either version."""

    id: str
    timestamp: float | str = Field(0.0, description="milliseconds since 1970")
    type: str = "geopose"
    sensors: list[Sensor] = []
    sensorReadings: SensorReadings | list[SensorReading]

    def camera_reading(self) -> CameraReading:
        """Return the reading of the first camera. Raises RequestError."""
        found = self._readings("cameraReadings", CameraReading, "imageBytes")
        if not found:
            raise RequestError(400, "the request has no reading of a camera")
        params = {sensor.id: sensor.params for sensor in self.sensors}
        its_params = found[0].params or params.get(found[0].sensorId)
        return found[0].model_copy(update={"params": its_params})

    def near(self, slack_m: float) -> GeoPositionPrior | None:
        """Return the position of the first valid reading with an accuracy.

        The radius is three times the accuracy and `slack_m` (metres). Without such a reading return
        None.
        """
        for one in self._readings("geolocationReadings", GeolocationReading, "latitude"):
            # some clients send the accuracy 0 for "unknown"
            if one.latitude is None or one.longitude is None or not one.accuracy:
                continue
            if one.accuracy > 0.0:
                with suppress(AtlasError):
                    radius_m = 3.0 * one.accuracy + slack_m
                    return GeoPositionPrior(one.latitude, one.longitude, radius_m)
        return None

    def _readings(self, name: str, kind: type[R], key: str) -> list[R]:
        """Return the readings of a kind: the list `name` of version 2, or those with `key`."""
        readings = self.sensorReadings
        if isinstance(readings, SensorReadings):
            return getattr(readings, name) or []
        found = [one for one in readings if key in (one.reading or {})]
        data = [(one.reading or {}) | {"sensorId": one.sensorId} for one in found]
        try:
            return [kind.model_validate(one) for one in data]
        except ValidationError as error:
            raise invalid_request("invalid reading", error) from None


class Accuracy(BaseModel):
    """Standard deviations: root mean square of the three components."""

    position: float = Field(description="metres", ge=0.0)
    orientation: float = Field(description="degrees", ge=0.0)


class Position(BaseModel):
    """WGS84: degrees, and metres above the ellipsoid."""

    lat: float
    lon: float
    h: float


class Quaternion(BaseModel):
    """Rotation of the camera body in east-north-up."""

    x: float
    y: float
    z: float
    w: float


class GeoPoseOgc(BaseModel):
    """OGC GeoPose 1.0, Basic-Quaternion."""

    position: Position
    quaternion: Quaternion


class GeoPoseReply(BaseModel):
    """The response with a pose."""

    id: str
    timestamp: float
    type: str = "geopose"
    accuracy: Accuracy
    geopose: GeoPoseOgc


class GeoPoseError(BaseModel):
    """The response without a pose."""

    ERROR: str
    request_id: str
    reason: str | None = None


def check_version(accept: str) -> None:
    """Raise RequestError if an Accept header names a version other than 1.0 and 2.0."""
    named = _VERSION.search(accept)
    if named and named[1] not in _KNOWN_VERSIONS:
        text = f"version {named[1]} of the GeoPose Protocol is not supported; use 1.0 or 2.0"
        raise RequestError(400, text)


def read_request(body: bytes) -> GeoPoseRequest:
    """Parse a request. Raises RequestError if it is invalid."""
    try:
        return GeoPoseRequest.model_validate_json(body)
    except ValidationError as error:
        raise invalid_request("no GeoPose request", error) from None


def read_image_bytes(reading: CameraReading) -> EncodedImage | Image:
    """Return the image: raw pixels if the size fits, else the bytes of an image file.

    Clients name JPEG files RGBA32 too, so the format is not trusted. Raises RequestError: the bytes
    are missing or not base64, or the image is mirrored or depth.
    """
    if reading.imageOrientation is not None and reading.imageOrientation.mirrored:
        raise RequestError(400, "the image is mirrored; send it as the camera captured it")
    if reading.imageFormat.upper() == "DEPTH":
        raise RequestError(400, "a depth image cannot be localized")
    text = reading.imageBytes.rpartition(",")[2]  # some clients send a data: URL
    try:
        data = base64.b64decode("".join(text.split()), validate=True)  # Android breaks lines
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
    """Return width and height (pixels) of a reading, None if they are missing or invalid."""
    size = reading.size or []
    if len(size) != 2 or not all(1.0 <= length <= 1e5 for length in size):
        return None
    return int(size[0]), int(size[1])


def camera_to_json(reading: CameraReading) -> dict[str, Any] | None:
    """Return the camera for `query_request.camera_from_json`, None if the reading has none."""
    params = reading.params or CameraParam()
    model = (params.model or "UNKNOWN").upper()
    if not params.modelParams or model.startswith("UNKNOWN"):
        return None
    return {"model": model, "params": params.modelParams}


def create_reply(
    request: GeoPoseRequest,
    result: Localization,
    geopose: GeoPose,
    georeference: Georeference,
    now_ms: float,
) -> GeoPoseReply:
    """Create the reply. Its accuracy includes the residuals of the map's georeference."""
    mean = 1.0 / math.sqrt(3.0)
    metres = mean * math.hypot(result.position_sigma_m, georeference.rms_m or 0.0)
    return GeoPoseReply(
        id=request.id,
        timestamp=request.timestamp if isinstance(request.timestamp, float) else now_ms,
        accuracy=Accuracy(position=metres, orientation=mean * result.rotation_sigma_deg),
        geopose=GeoPoseOgc.model_validate(geopose.to_json()),
    )
