"""Render frames of the room in memory: the camera goes to any place, and tests can
damage frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

import tiny_world
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import DepthImage, StereoFrame

RIG = StereoRig.rectified(tiny_world.CAMERA, tiny_world.BASELINE)


@dataclass(frozen=True, eq=False)
class FrameList:
    """Hold a StereoSequence in memory."""

    frames: Sequence[StereoFrame]
    name: str = "room"

    @property
    def names(self) -> list[str]:
        return [frame.name for frame in self.frames]

    @property
    def t_ns(self) -> list[int]:
        return [frame.t_ns for frame in self.frames]

    @property
    def poses(self) -> list[Rigid3 | None]:
        return [frame.world_from_cam for frame in self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> StereoFrame:
        return self.frames[index]


@cache
def stereo_frame(place: float, seed: int = 0) -> StereoFrame:
    """Return the pair at this place of the path, with truth."""
    panels, pose = tiny_world.room(seed), tiny_world.path_pose(place)
    noise = round(1000 * place)
    left, right = (
        tiny_world.render(panels, p, noise_seed=noise + k)[0]
        for k, p in enumerate((pose, tiny_world.right_pose(pose)))
    )
    t_ns = round(place * 1e9 / tiny_world.RATE_HZ)
    return StereoFrame(
        f"{place:g}.png", t_ns, left, tiny_world.CAMERA, right, RIG, world_from_cam=pose
    )


@cache
def depth_frame(place: float) -> StereoFrame:
    """Return the same frame with depth instead of the right image."""
    _, depth = tiny_world.render(tiny_world.room(), tiny_world.path_pose(place))
    measured = DepthImage(depth.astype(np.float32), tiny_world.CAMERA, Rigid3.identity())
    return replace(stereo_frame(place), right=None, rig=None, depth=measured)


def walk(places: Sequence[float], seed: int = 0, name: str = "room") -> FrameList:
    """Return frames at these places, a tenth of a second apart."""
    frames = [
        replace(stereo_frame(float(place), seed), t_ns=i * 100_000_000)
        for i, place in enumerate(places)
    ]
    return FrameList(frames, name)


def changed(sequence: FrameList, frames: dict[int, StereoFrame]) -> FrameList:
    """Return the same recording with some frames replaced."""
    return FrameList(
        [frames.get(i, frame) for i, frame in enumerate(sequence.frames)], sequence.name
    )


def blackened(frame: StereoFrame) -> StereoFrame:
    """Return the frame without light."""
    assert frame.right is not None
    return replace(frame, image=np.zeros_like(frame.image), right=np.zeros_like(frame.right))
