"""Messages of the HTTP discovery of SpatialDDS 1.6 (github.com/OpenArCloud/SpatialDDS-spec, 3.3.0
and 8.2.3): searches by region, and manifests of the places that a service localizes in.

A box is west, south, east, north in degrees. It crosses the date line if west is above east.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, Field, FiniteFloat, model_validator

SPATIALDDS = "1.6"
"""The version of the standard."""
Box = tuple[float, float, float, float]
_GEOHASH_DIGITS = "0123456789bcdefghjkmnpqrstuvwxyz"
_EARTH = {"uuid": "ae6f0a3e-7a3e-4b1e-9b1f-0e9f1b7c1a10", "fqn": "earth-fixed"}
_RESOURCE = re.compile(r"spatialdds://([^/?#]+)/maps/service/([A-Za-z0-9_-]+)(?:;[^?#]*)?")
_OUTSIDE_RESOURCE = re.compile(r"[^A-Za-z0-9-]")
SEARCH_EXAMPLE: dict[str, Any] = {
    "coverage": [{"type": "bbox", "crs": "EPSG:4979", "bbox": [4.69, 50.86, 4.71, 50.88]}],
    "kind": ["VPS"],
}

Kind = Literal[
    "VPS", "MAPPING", "RELOCAL", "SEMANTICS", "STORAGE", "CONTENT", "ANCHOR_REGISTRY", "OTHER"
]
_Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class Bounds(BaseModel):
    """Opposite corners: longitude, latitude, height."""

    min_xyz: _Corner
    max_xyz: _Corner


class CoverageElement(BaseModel):
    """A region: a box, the bounds of a volume, or everywhere."""

    type: Literal["bbox", "volume"] = "bbox"
    crs: Literal["EPSG:4979", "EPSG:4326"] | None = None
    bbox: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] | None = None
    has_bbox: bool = True
    aabb: Bounds | None = None
    has_aabb: bool = True
    everywhere: bool = Field(False, alias="global")
    frame_ref: dict[str, Any] = {}

    @model_validator(mode="after")
    def _check(self) -> CoverageElement:
        if not self.everywhere and self.box is None:
            raise ValueError("a region has bbox, aabb or global")
        _, south, _, north = self.box or (0.0, 0.0, 0.0, 0.0)
        if self.is_on_earth and not -90.0 <= south <= north <= 90.0:
            raise ValueError("a box is west, south, east, north in degrees")
        return self

    @property
    def is_on_earth(self) -> bool:
        """Whether its frame is the earth's."""
        return str(self.frame_ref.get("fqn", "earth-fixed")).split("/")[0] == "earth-fixed"

    @property
    def box(self) -> Box | None:
        """The region on the ground, None if it has none."""
        if self.bbox is not None and self.has_bbox:
            return self.bbox
        if self.aabb is None or not self.has_aabb:
            return None
        return (*self.aabb.min_xyz[:2], *self.aabb.max_xyz[:2])


class SearchRequest(BaseModel):
    """A search by regions, a geohash or both."""

    coverage: list[CoverageElement] = Field([], max_length=64)
    geohash: str | None = Field(None, pattern=f"^[{_GEOHASH_DIGITS}]{{3,7}}$")
    kind: list[Kind] = Field([], max_length=8)
    filter: dict[str, list[str]] = Field({}, description="topics of DDS that services must have")
    max_results: int = Field(100, ge=1)
    page_token: str = Field("", pattern="^[0-9]{0,9}$")

    @model_validator(mode="after")
    def _check(self) -> SearchRequest:
        if not self.coverage and self.geohash is None:
            raise ValueError("coverage or geohash is missing")
        return self

    def matches(self, box: Box) -> bool:
        """Whether a service for images of this box is wanted. It has no topics of DDS."""
        if any(self.filter.values()) or (self.kind and "VPS" not in self.kind):
            return False
        wanted = [one.box for one in self.coverage if one.box is not None and one.is_on_earth]
        wanted += [] if self.geohash is None else [geohash_box(self.geohash)]
        is_anywhere = any(one.everywhere for one in self.coverage)
        return is_anywhere or any(boxes_intersect(box, one) for one in wanted)


class SearchResponse(BaseModel):
    """Manifests of services, and the token of the next page, empty on the last one."""

    results: list[dict[str, Any]]
    next_page_token: str = ""


@dataclass(frozen=True)
class Announced:
    """A map or an atlas with a place on earth. `path` is that of its GeoPose Protocol; what is said
    holds for `ttl_s` seconds."""

    name: str
    version: int
    box: Box
    path: str
    stamp_s: int
    ttl_s: int = 60

    @property
    def resource(self) -> str:
        """Its identifier in an URI: other signs than letters, digits and - as _ and hexadecimal."""
        return _OUTSIDE_RESOURCE.sub(lambda sign: f"_{ord(sign[0]):x}_", self.name)

    def manifest(self, authority: str, base: str) -> dict[str, Any]:
        """Return its service manifest. The hint has the form of those of `Announce`, because the
        standard has no field for an address of HTTP, and no payload for images over DDS."""
        hint = {"key": "oscp.geopose_protocol", "value": base + self.path}
        flags = {"has_bbox": True, "bbox": list(self.box), "has_aabb": False, "global": False}
        return {
            "id": f"spatialdds://{authority}/maps/service/{self.resource}",
            "profile": f"spatial.manifest@{SPATIALDDS}",
            "rtype": "service",
            "service": {
                "service_id": self.name,
                "kind": "VPS",
                "name": f"topoloc: {self.name}",
                "version": str(self.version),
                "connection": {},
                "topics": [],
                "hints": [hint],
            },
            "coverage": {"frame_ref": _EARTH} | flags,
            "stamp": {"sec": self.stamp_s, "nanosec": 0},
            "ttl_sec": self.ttl_s,
        }


def parse_resource(uri: str) -> tuple[str, str] | None:
    """Return authority and identifier of a spatialdds URI of a service; None if it is none."""
    found = _RESOURCE.fullmatch(uri.partition("?")[0].partition("#")[0])
    return (found[1].lower(), found[2]) if found else None


def geohash_box(geohash: str) -> Box:
    """Return the cell of a geohash."""
    low, high = [-180.0, -90.0], [180.0, 90.0]
    bits = "".join(f"{_GEOHASH_DIGITS.index(digit):05b}" for digit in geohash)
    for number, bit in enumerate(bits):
        axis = number % 2
        middle = (low[axis] + high[axis]) / 2.0
        (low if bit == "1" else high)[axis] = middle
    return (low[0], low[1], high[0], high[1])


def boxes_intersect(a: Box, b: Box) -> bool:
    """Whether two boxes have a point in common."""
    if a[3] < b[1] or b[3] < a[1]:
        return False
    return any(s[0] <= t[1] and t[0] <= s[1] for s in _longitudes(a) for t in _longitudes(b))


def enclose(places: Sequence[tuple[float, float]], margin_m: float = 30.0) -> Box:
    """Return the box of places (latitude, longitude), which are less than half the earth apart, and
    of what lies within the margin."""
    first = places[0][1]
    turned = [(lon - first + 180.0) % 360.0 - 180.0 for _, lon in places]
    latitudes = [lat for lat, _ in places]
    margin = margin_m / 111_000.0
    across = margin / max(math.cos(math.radians(max(map(abs, latitudes)))), 0.01)
    west, east = (
        (first + one + 180.0) % 360.0 - 180.0
        for one in (min(turned) - across, max(turned) + across)
    )
    return west, max(min(latitudes) - margin, -90.0), east, min(max(latitudes) + margin, 90.0)


def _longitudes(box: Box) -> list[tuple[float, float]]:
    west, _, east, _ = box
    return [(west, east)] if west <= east else [(west, 180.0), (-180.0, east)]
