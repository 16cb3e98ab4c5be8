"""Convert between WGS-84 latitude, longitude and height, earth-centred coordinates, and a local
east-north-up frame.

Latitudes and longitudes are degrees. Heights are metres above the ellipsoid. ECEF is in metres,
with x to latitude 0, longitude 0 and z to the north pole. Formulas: Torge and Mueller, *Geodesy*,
4.1. The inverse is that of Bowring, *Transformation from spatial to geographical coordinates*,
1976, iterated to convergence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from topoloc.errors import GeoreferenceError
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import NonNegative, OneLine, decode_json, encode_json

SEMI_MAJOR = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
_SEMI_MINOR = SEMI_MAJOR * (1.0 - FLATTENING)
_ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
_MAX_HEIGHT = 1e8  # metres
# Axes of the camera's body (x forward, y left, z up) in the camera frame (x right, y down, z
# forward), as in the OSCP's reference server.
CAM_FROM_BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class GeoPoint:
    """Hold a place on WGS-84: degrees, and metres above the ellipsoid.

    Raises:
        GeoreferenceError: a value is not finite, latitude or longitude are out of range, or the
            height is far from the earth.
    """

    lat: float
    lon: float
    h: float

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.lat, self.lon, self.h))):
            raise GeoreferenceError(f"not a place on earth: {self.lat}, {self.lon}, {self.h}")
        if abs(self.lat) > 90.0 or abs(self.lon) > 360.0:
            raise GeoreferenceError(
                f"latitude {self.lat:g}, longitude {self.lon:g}: -90 to 90 and -180 to 180 degrees,"
                " in this order"
            )
        if abs(self.h) > _MAX_HEIGHT:
            raise GeoreferenceError(f"a height of {self.h:g} m above the ellipsoid")

    def ecef(self) -> Float[np.ndarray, "3"]:
        """Return the earth-centred, earth-fixed coordinates, metres."""
        lat, lon = math.radians(self.lat), math.radians(self.lon)
        normal = SEMI_MAJOR / math.sqrt(1.0 - _ECCENTRICITY_SQUARED * math.sin(lat) ** 2)
        across = (normal + self.h) * math.cos(lat)
        z = (normal * (1.0 - _ECCENTRICITY_SQUARED) + self.h) * math.sin(lat)
        return np.array([across * math.cos(lon), across * math.sin(lon), z])

    @staticmethod
    def from_ecef(ecef: Float[np.ndarray, "3"]) -> GeoPoint:
        """Return the place of a point in ECEF (metres). Raises GeoreferenceError if it is farther
        than `_MAX_HEIGHT` from the ellipsoid."""
        x, y, z = (float(value) for value in ecef)
        across = math.hypot(x, y)
        beta = math.atan2(SEMI_MAJOR * z, _SEMI_MINOR * across)
        lat, second_squared = 0.0, _ECCENTRICITY_SQUARED / (1.0 - _ECCENTRICITY_SQUARED)
        for _ in range(5):
            up = z + second_squared * _SEMI_MINOR * math.sin(beta) ** 3
            lat = math.atan2(up, across - _ECCENTRICITY_SQUARED * SEMI_MAJOR * math.cos(beta) ** 3)
            beta = math.atan2((1.0 - FLATTENING) * math.sin(lat), math.cos(lat))
        shape = 1.0 - _ECCENTRICITY_SQUARED * math.sin(lat) ** 2
        normal = SEMI_MAJOR / math.sqrt(shape)
        height = across * math.cos(lat) + z * math.sin(lat) - normal * shape
        return GeoPoint(math.degrees(lat), math.degrees(math.atan2(y, x)), height)

    def ecef_from_enu(self) -> Rigid3:
        """Return the transform from the east-north-up frame at this place to earth-centred
        coordinates."""
        lat, lon = math.radians(self.lat), math.radians(self.lon)
        east = [-math.sin(lon), math.cos(lon), 0.0]
        north = [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)]
        up = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
        return Rigid3(np.array([east, north, up]).T, self.ecef())


@dataclass(frozen=True)
class UnitQuaternion:
    """Hold a unit quaternion. Raises ValueError if its length is not 1 within 0.001."""

    x: float
    y: float
    z: float
    w: float

    def __post_init__(self) -> None:
        if not abs(math.hypot(self.x, self.y, self.z, self.w) - 1.0) < 1e-3:  # true for NaN
            raise ValueError("a quaternion that is not of unit length")


@dataclass(frozen=True, repr=False)
class GeoPose(OneLine):
    """Hold an OGC GeoPose 1.0, Basic-Quaternion: the camera's place, and its orientation relative
    to east-north-up at that place.

    The orientation is that of a body: x forward, y left, z up.
    """

    position: GeoPoint
    quaternion: UnitQuaternion

    @property
    def quat_wxyz(self) -> Float[np.ndarray, "4"]:
        """Return the orientation as an array (w, x, y, z)."""
        q = self.quaternion
        return np.array([q.w, q.x, q.y, q.z])

    def to_json(self) -> dict[str, dict[str, float]]:
        """Return the strict form, with exactly the members of the standard."""
        return encode_json(self)

    @staticmethod
    def from_json(data: Any) -> GeoPose:
        """Read the form of `to_json`. Raises GeoreferenceError if the data have another form."""
        return decode_json(data, GeoPose, GeoreferenceError, "no GeoPose")


@dataclass(frozen=True, eq=False, repr=False)
class Georeference(OneLine):
    """Hold the place of a map's world frame on earth: `enu_from_world` transforms to the
    east-north-up frame at `origin`.

    `source` names the source of the georeference. `rms_m` is the root mean square residual of the
    fit (metres), or None if nothing was fitted.
    """

    origin: GeoPoint
    enu_from_world: Rigid3
    source: str
    rms_m: NonNegative | None = None

    def __str__(self) -> str:
        o, fitted = self.origin, "" if self.rms_m is None else f", rms {self.rms_m:.2f} m"
        return f"{o.lat:.7f}, {o.lon:.7f}, {o.h:.2f} m (from {self.source}{fitted})"

    def to_json(self) -> dict[str, object]:
        """Return the form stored in the map file."""
        return encode_json(self)

    @staticmethod
    def from_json(data: Any) -> Georeference:
        """Read the form of `to_json`. Raises GeoreferenceError if the data have another form."""
        return decode_json(data, Georeference, GeoreferenceError, "no georeference")

    def geopoint(self, point_world: Float[np.ndarray, "3"]) -> GeoPoint:
        """Return latitude, longitude and height of a point in the world frame (metres). Raises
        GeoreferenceError if it is far from the earth."""
        ecef_from_world = self.origin.ecef_from_enu() @ self.enu_from_world
        return GeoPoint.from_ecef(ecef_from_world.apply(point_world))

    def geopose(self, world_from_cam: Rigid3) -> GeoPose:
        """Return the GeoPose of a camera. East, north and up are those of its own place, which
        differ from the origin's by 0.01 degrees per kilometre."""
        ecef_from_cam = self.origin.ecef_from_enu() @ self.enu_from_world @ world_from_cam
        position = GeoPoint.from_ecef(ecef_from_cam.translation)
        enu_from_body = position.ecef_from_enu().rotation.T @ ecef_from_cam.rotation @ CAM_FROM_BODY
        w, x, y, z = Rigid3(enu_from_body, np.zeros(3)).quat_wxyz().tolist()
        return GeoPose(position, UnitQuaternion(x, y, z, w))

    def heading_deg(self, direction_world: Float[np.ndarray, "3"]) -> float:
        """Return the heading of a direction in degrees clockwise from true north, 0 to 360."""
        east, north, _ = self.enu_from_world.rotation @ direction_world
        return math.degrees(math.atan2(east, north)) % 360.0
