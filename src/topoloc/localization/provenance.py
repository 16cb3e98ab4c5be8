"""Describe the source of a result: its evidence, map, features, time and camera."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from msgspec import Struct
from msgspec.structs import asdict

from topoloc.errors import CalibrationError, MapError, ResultError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import Count, Finite, Nanoseconds, OneLine, decode_json


@dataclass(frozen=True)
class Evidence:
    """Hold the evidence for a pose.

    Attributes:
        num_matches: number of unguided matches.
        num_inliers: number of unguided matches that agree with the pose.
        num_found: number of visible map points found at their predicted pixels.
        num_visible: number of map points in view.
        num_by_chance: number of points that would be found if the pose were wrong.
        spread: share of the image's cells with a found point.
        doubt: normalized uncertainty, the standard deviation in the worst direction over the
            tolerance. It is 1 if the two are equal.
        even_share: spatially uniform inlier ratio, the found share of the visible points, averaged
            over all parts of the view (`compute_uniform_inlier_ratio`).
        num_distinct: number of found points that match here better than anywhere else in the map.
            Virtual views only.
        num_lesser_side: number of found points of the side view that has fewer. Virtual views only.
    """

    num_matches: Count
    num_inliers: Count
    num_found: Count
    num_visible: Count
    num_by_chance: Count
    spread: Finite
    doubt: Finite
    even_share: Finite
    num_distinct: Count | None = None
    num_lesser_side: Count | None = None

    @property
    def is_of_nodes(self) -> bool:
        """Return whether the pose was found by the map's nodes, not by virtual views."""
        return self.num_distinct is None

    @property
    def precision_probability(self) -> float:
        """Return the probability that a pose at the right place is within the tolerance.

        It is 1 for a pose of the nodes, whose log-odds include the precision already. A single wall
        may leave a pose imprecise although the place is certain.
        """
        return 1.0 if self.is_of_nodes else probability_within_tolerance(self.doubt)


def probability_within_tolerance(doubt: float) -> float:
    """Return the probability that a normal error is within the tolerance.

    `doubt` is the standard deviation divided by the tolerance.
    """
    return math.erf(1.0 / (math.sqrt(2.0) * doubt))


@dataclass(frozen=True, repr=False)
class Provenance(OneLine):
    """Hold the source of a result. Unknown values are None or empty.

    Attributes:
        map_id: id of the map.
        map_version: number of the map's last edit.
        features: feature type that found the pose.
        t_ns: capture time of the image, nanoseconds.
        camera: camera model of the image.
        tile: name of the map in the queried atlas. None if no atlas was queried.
        atlas_from_cam: camera pose in the atlas's world, None if unknown.
        joint_world: name of the world that the tile shares with joined tiles.
        joint_from_cam: camera pose in the joint world.
        has_scale: whether lengths are metres. False: units of the map, whose scale is unknown.
        query: name of the image, if the result was read. It is not compared.
    """

    map_id: str = ""
    map_version: int = 0
    features: str = ""
    t_ns: int | None = None
    camera: Camera | None = None
    tile: str | None = None
    atlas_from_cam: Rigid3 | None = None
    joint_world: str | None = None
    joint_from_cam: Rigid3 | None = None
    has_scale: bool = True
    query: str = field(default="", compare=False)

    def require_scale(self, use: str) -> None:
        """Raise MapError if lengths of the result are not metres, which `use` needs."""
        if not self.has_scale:
            raise MapError(
                f"map {self.map_id} has no scale, but {use} needs metres: set it by `topoloc scale"
                " MAP --distance IMAGE_A,IMAGE_B=3.2m`, or --tag METRES"
            )

    def to_json(self) -> dict[str, Any]:
        """Return the provenance as keys of a result's JSON, without the image's name."""
        camera = None if self.camera is None else self.camera.to_json()
        of_atlas: dict[str, Any] = {} if self.tile is None else {"tile": self.tile}
        if self.atlas_from_cam is not None:
            of_atlas["atlas_from_cam"] = self.atlas_from_cam.to_json()
        if self.joint_world is not None:
            of_atlas["joint_world"] = self.joint_world
        if self.joint_from_cam is not None:
            of_atlas["joint_from_cam"] = self.joint_from_cam.to_json()
        of_atlas |= {} if self.has_scale else {"scale": "none"}
        return of_atlas | {
            "map": self.map_id,
            "version": self.map_version,
            "t_ns": self.t_ns,
            "camera": camera,
            "features": self.features,
        }

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> Provenance:
        """Parse the provenance in a result's JSON. Missing keys give the defaults.

        Raises:
            ResultError: a value is invalid.
        """
        read = asdict(decode_json(data, _ProvenanceJson, ResultError, "no result"))
        read["has_scale"] = read.pop("scale") is None
        if read["camera"] is not None:
            with ResultError.at("no result", CalibrationError):
                read["camera"] = Camera.from_json(read["camera"])
        return Provenance(**read)


class _ProvenanceJson(Struct, frozen=True, rename={"map_id": "map", "map_version": "version"}):
    map_id: str = ""
    map_version: Count = 0
    features: str = ""
    t_ns: Nanoseconds | None = None
    camera: dict[str, Any] | None = None
    tile: str | None = None
    atlas_from_cam: Rigid3 | None = None
    joint_world: str | None = None
    joint_from_cam: Rigid3 | None = None
    query: str = ""
    scale: Literal["none"] | None = None


EMPTY_PROVENANCE = Provenance()
