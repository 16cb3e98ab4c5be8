"""Frames and the transforms between them, as TF has them: each frame has one parent, and stands or
moves in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from topoloc.apps.formats.bags.messages import TimedTransform
from topoloc.geometry.lazy_poses import LazyPoses, pose_of_quaternion
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.trajectory import Trajectory, poses_at


def trajectory_of(transforms: list[TimedTransform]) -> Trajectory:
    """In order of time, of equal times the last."""
    by_time = {its.t_ns: its for its in sorted(transforms, key=lambda its: its.t_ns)}
    return Trajectory(poses_of(list(by_time.values())), list(by_time))


def poses_of(transforms: Sequence[TimedTransform]) -> Sequence[Rigid3]:
    """Transforms as poses."""
    rows = np.array(
        [(*its.translation, *its.quat_xyzw) for its in transforms], dtype=np.float64
    ).reshape(-1, 7)
    return LazyPoses(rows, pose_of_quaternion)


@dataclass(eq=False)
class FrameTree:
    """The transforms of each frame in its parent; those of `fixed` frames hold for all times."""

    transforms: dict[str, list[TimedTransform]] = field(default_factory=dict)
    fixed: set[str] = field(default_factory=set)

    def add(self, its: TimedTransform, is_static: bool) -> None:
        """Adds a transform. Of a frame with several parents the first counts."""
        known = self.transforms.setdefault(its.child, [])
        if its.child and not (known and known[0].parent != its.parent):
            known.append(its)
            if is_static:
                self.fixed.add(its.child)

    def moves(self, frame: str) -> bool:
        """Whether anything moves between this frame and the root of its tree."""
        return any(not self._is_fixed(below) for below, _ in self._edges(frame))

    def poses(self, frame: str, t_ns: Sequence[int]) -> list[Rigid3 | None]:
        """world_from_frame at each time, the root being the world; None where a transform on the
        way is not known then.

        Raises:
            TrajectoryError: a quaternion without length.
        """
        poses: list[Rigid3 | None] = [Rigid3.identity()] * len(t_ns)
        for child, _ in self._edges(frame):
            steps = self._at(child, t_ns)
            poses = [
                step @ pose if step is not None and pose is not None else None
                for step, pose in zip(steps, poses, strict=True)
            ]
        return poses

    def fixed_between(self, to: str, of: str) -> Rigid3 | None:
        """to_from_of, where both stand still in a common frame; else None."""
        ways = [[end, *(parent for child, parent in self._fixed_edges(end))] for end in (to, of)]
        common = next((name for name in ways[0] if name in ways[1]), None)
        if common is None:
            return None
        common_from_to, common_from_of = (self._along(way[: way.index(common) + 1]) for way in ways)
        return common_from_to.inverse() @ common_from_of

    def _along(self, way: list[str]) -> Rigid3:
        """last_from_first."""
        pose = Rigid3.identity()
        for child, _ in pairwise(way):
            pose = poses_of(self.transforms[child][-1:])[0] @ pose
        return pose

    def _fixed_edges(self, frame: str) -> Iterator[tuple[str, str]]:
        for child, parent in self._edges(frame):
            if not self._is_fixed(child):
                return
            yield child, parent

    def _edges(self, frame: str) -> Iterator[tuple[str, str]]:
        """(child, parent) from a frame up to its root."""
        seen = {frame}
        while self.transforms.get(frame):
            parent = self.transforms[frame][0].parent
            yield frame, parent
            if parent in seen:  # a circle
                return
            seen.add(parent)
            frame = parent

    def _is_fixed(self, frame: str) -> bool:
        return frame in self.fixed or len(self.transforms[frame]) == 1

    def _at(self, child: str, t_ns: Sequence[int]) -> Sequence[Rigid3 | None]:
        """parent_from_child at each time."""
        if self._is_fixed(child):
            return [poses_of(self.transforms[child][-1:])[0]] * len(t_ns)
        return poses_at(trajectory_of(self.transforms[child]), t_ns)
