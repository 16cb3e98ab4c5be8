"""Map a corridor in one direction, and render images of the reverse direction, each once per test
run.

Its walls run along the world's +y, 2.2 m apart, with the textures of `tiny_world`, above a plain
floor. In reverse direction a camera sees the same walls at the opposite slant, and nothing else of
the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from made_once import once_a_run
from tiny_world import BASELINE, LEVEL_FROM_CAM, Panel, render, right_pose, smooth_texture
from topoloc.features.feature_types import default_learned_type
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame

WIDE = Camera.pinhole(480, 320, 240.0, 240.0, 239.5, 159.5)
"""45 degrees to either side, as a phone or a stereo camera of a robot sees them."""
NUM_PAIRS, STEP = 14, 0.3


@cache
def corridor(seed: int = 0) -> list[Panel]:
    """Return two walls, a floor and two ends. Another seed is another place of the same shape."""
    floor = np.full((2, 2), 90.0, np.float32)
    up_down, along = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    shapes = [
        (np.array([-1.1, 4.0, 0.0]), along, up_down, (8.0, 1.3)),
        (np.array([1.1, 4.0, 0.0]), -along, up_down, (8.0, 1.3)),
        (np.array([0.0, 4.0, -1.3]), np.array([1.0, 0.0, 0.0]), -along, (1.1, 8.0)),
        (np.array([0.0, 12.0, 0.0]), np.array([1.0, 0.0, 0.0]), up_down, (1.1, 1.3)),
        (np.array([0.0, -4.0, 0.0]), np.array([-1.0, 0.0, 0.0]), up_down, (1.1, 1.3)),
    ]
    return [
        Panel(
            centre,
            right,
            down,
            half,
            floor if number == 2 else smooth_texture(1000 + 100 * seed + number, half),
        )
        for number, (centre, right, down, half) in enumerate(shapes)
    ]


def ahead(y: float, x: float = 0.0, yaw: float = 0.0) -> Rigid3:
    """Return world_from_cam in the mapped direction, `y` metres along the corridor, rotated to the
    left by `yaw` radians."""
    return Rigid3(exp_so3(np.array([0.0, 0.0, yaw])) @ LEVEL_FROM_CAM, np.array([x, y, 0.0]))


def back(y: float, x: float = 0.0, yaw: float = 0.0) -> Rigid3:
    """Return world_from_cam in reverse direction."""
    return ahead(y, x, np.pi + yaw)


def _walking(number: int) -> Rigid3:
    return ahead(STEP * number, x=0.04 * np.sin(number), yaw=0.02 * np.cos(number))


@cache
def _seen_from(seed: int, number: int, side: int, camera: Camera) -> np.ndarray:
    """Return the image of the left (0) or right (1) camera of a pair. It is cached, because a build
    reads a recording several times."""
    pose = _walking(number)
    return render(
        corridor(seed), right_pose(pose) if side else pose, camera, noise_seed=2 * number + side
    )[0]


@dataclass(frozen=True, eq=False)
class WalkAhead:
    """Hold a recording of stereo pairs from one end of the corridor towards the other."""

    seed: int
    name: str = "walk"
    num_pairs: int = NUM_PAIRS
    camera: Camera = WIDE

    @property
    def names(self) -> list[str]:
        return [f"{number:03d}" for number in range(self.num_pairs)]

    @property
    def t_ns(self) -> list[int]:
        return [number * 100_000_000 for number in range(self.num_pairs)]

    @property
    def poses(self) -> list[Rigid3 | None]:
        return [_walking(number) for number in range(self.num_pairs)]

    def __len__(self) -> int:
        return self.num_pairs

    def __getitem__(self, index: int) -> StereoFrame:
        pose = _walking(index)
        left, right = (_seen_from(self.seed, index, side, self.camera).copy() for side in (0, 1))
        rig = StereoRig.rectified(self.camera, BASELINE)
        return StereoFrame(
            self.names[index],
            self.t_ns[index],
            left,
            self.camera,
            right=right,
            rig=rig,
            world_from_cam=pose,
        )


@once_a_run
def built_corridor() -> TopoMetricMap:
    """Return the map of the walk ahead, with virtual views, of SURF alone."""
    return build_map(WalkAhead(0), BuildConfig(other_kinds=()))


@once_a_run
def corridor_of_two_kinds() -> TopoMetricMap:
    """Return the same map of SURF and the shipped learned features, which also describe the
    virtual views."""
    return build_map(WalkAhead(0), BuildConfig(other_kinds=(default_learned_type(),)))


@cache
def seen_on_the_way_back(seed: int = 0) -> list[tuple[np.ndarray, Rigid3]]:
    """Return grey images of WIDE in reverse direction, with world_from_cam. Another seed is
    another corridor."""
    poses = [
        back(y, x=0.15 * np.sin(y), yaw=0.05 * np.cos(3.0 * y)) for y in np.arange(4.0, 7.1, 0.6)
    ]
    return [
        (render(corridor(seed), pose, WIDE, noise_seed=500 + k)[0], pose)
        for k, pose in enumerate(poses)
    ]


@cache
def seen_ahead() -> list[tuple[np.ndarray, Rigid3]]:
    """Return grey images of WIDE in the mapped direction, between the frames of the map."""
    poses = [ahead(y, x=0.1, yaw=-0.03) for y in (0.5, 2.0, 3.8)]
    return [
        (render(corridor(), pose, WIDE, noise_seed=700 + k)[0], pose)
        for k, pose in enumerate(poses)
    ]


def is_right(result: Localization | NotLocalized, truth: Rigid3) -> bool:
    """Return whether a result is a pose within 0.3 m and 5 degrees of the truth."""
    return isinstance(result, Localization) and is_pose(result.world_from_cam, truth)


def is_by_walls(result: Localization | NotLocalized) -> bool:
    """Return whether virtual views localized the image."""
    return (
        isinstance(result, Localization)
        and result.evidence is not None
        and result.evidence.num_distinct is not None
    )


def is_pose(world_from_cam: Rigid3, truth: Rigid3) -> bool:
    """Return whether a pose is within 0.3 m and 5 degrees of the truth."""
    return translation_error(world_from_cam, truth) < 0.3 and rotation_error(
        world_from_cam, truth
    ) < np.deg2rad(5.0)
