"""Describe the source of a result: map, features, time and camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from msgspec import Struct

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import PoseJson, Rigid3
from topoloc.json_data import Count, Nanoseconds


@dataclass(frozen=True)
class Provenance:
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

    def to_json(self) -> dict[str, Any]:
        """Return the provenance as keys of a result's JSON."""
        camera = None if self.camera is None else self.camera.to_json()
        of_atlas: dict[str, Any] = {} if self.tile is None else {"tile": self.tile}
        if self.atlas_from_cam is not None:
            of_atlas["atlas_from_cam"] = self.atlas_from_cam.to_json()
        if self.joint_world is not None:
            of_atlas["joint_world"] = self.joint_world
        if self.joint_from_cam is not None:
            of_atlas["joint_from_cam"] = self.joint_from_cam.to_json()
        return of_atlas | {
            "map": self.map_id,
            "version": self.map_version,
            "t_ns": self.t_ns,
            "camera": camera,
            "features": self.features,
        }


class ProvenanceJson(Struct, frozen=True, kw_only=True):
    """Hold the keys of a result's JSON that describe its source."""

    map: str = ""
    version: Count = 0
    features: str = ""
    t_ns: Nanoseconds | None = None
    camera: dict[str, Any] | None = None
    tile: str | None = None
    atlas_from_cam: PoseJson | None = None
    joint_world: str | None = None
    joint_from_cam: PoseJson | None = None

    def provenance(self) -> Provenance:
        """Return the provenance. Raises CalibrationError if the camera is not usable."""
        return Provenance(
            self.map,
            self.version,
            self.features,
            self.t_ns,
            None if self.camera is None else Camera.from_json(self.camera),
            self.tile,
            None if self.atlas_from_cam is None else self.atlas_from_cam.rigid(),
            self.joint_world,
            None if self.joint_from_cam is None else self.joint_from_cam.rigid(),
        )


EMPTY_PROVENANCE = Provenance()
