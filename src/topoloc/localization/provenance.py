"""Describe the source of a result: map, features, time and camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from topoloc.errors import CalibrationError, ResultError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization import checked_json as checked


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
            of_atlas["atlas_from_cam"] = checked.pose_to_json(self.atlas_from_cam)
        if self.joint_world is not None:
            of_atlas["joint_world"] = self.joint_world
        if self.joint_from_cam is not None:
            of_atlas["joint_from_cam"] = checked.pose_to_json(self.joint_from_cam)
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
        t_ns, camera, tile, pose = (
            data.get(key) for key in ("t_ns", "camera", "tile", "atlas_from_cam")
        )
        joint, joint_pose = data.get("joint_world"), data.get("joint_from_cam")
        if camera is not None and not isinstance(camera, dict):
            raise ResultError("no result: 'camera' is no object")
        try:
            return Provenance(
                checked.text(data.get("map", ""), "map"),
                checked.integer(data.get("version", 0), "version"),
                checked.text(data.get("features", ""), "features"),
                None if t_ns is None else checked.integer(t_ns, "t_ns", -(2**63)),
                None if camera is None else Camera.from_json(camera),
                None if tile is None else checked.text(tile, "tile"),
                None if pose is None else checked.pose_from_json(pose, "atlas_from_cam"),
                None if joint is None else checked.text(joint, "joint_world"),
                None
                if joint_pose is None
                else checked.pose_from_json(joint_pose, "joint_from_cam"),
            )
        except CalibrationError as error:
            raise ResultError(f"no result: {error}") from None


EMPTY_PROVENANCE = Provenance()
