"""Compose transforms of TF: each frame has one parent and is static or moves in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from topoloc import Rigid3, Trajectory
from topoloc.apps.formats.bags.messages import StampedTransform
from topoloc.plugin import interpolate_poses


def trajectory_from_transforms(transforms: list[StampedTransform]) -> Trajectory:
    """Return the poses in order of time. Of equal times the last one is used."""
    by_time = {its.t_ns: its for its in sorted(transforms, key=lambda its: its.t_ns)}
    rows = [(*its.translation, *its.quat_xyzw) for its in by_time.values()]
    numbers = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return Trajectory.from_quaternions(numbers, list(by_time))


def _pose_of_transform(its: StampedTransform) -> Rigid3:
    x, y, z, w = its.quat_xyzw
    return Rigid3.from_quat_wxyz(np.array([w, x, y, z]), np.array(its.translation))


@dataclass(eq=False)
class TransformTree:
    """Hold the transforms of each frame in its parent. Those of `static_frames` hold for all
    times."""

    transforms: dict[str, list[StampedTransform]] = field(default_factory=dict)
    static_frames: set[str] = field(default_factory=set)

    def add(self, its: StampedTransform, is_static: bool) -> None:
        """Add a transform. If a frame has several parents, the first one is used."""
        known = self.transforms.setdefault(its.child, [])
        if its.child and not (known and known[0].parent != its.parent):
            known.append(its)
            if is_static:
                self.static_frames.add(its.child)

    def is_moving(self, frame: str) -> bool:
        """Return whether a transform between this frame and the root of its tree changes."""
        return any(not self._is_static(below) for below, _ in self._edges_to_root(frame))

    def poses(self, frame: str, t_ns: Sequence[int]) -> list[Rigid3 | None]:
        """Return world_from_frame at each time, with the root as world. None if a transform is
        unknown at that time.

        Raises:
            TrajectoryError: a quaternion without length.
        """
        poses: list[Rigid3 | None] = [Rigid3.identity()] * len(t_ns)
        for child, _ in self._edges_to_root(frame):
            steps = self._poses_at(child, t_ns)
            poses = [
                step @ pose if step is not None and pose is not None else None
                for step, pose in zip(steps, poses, strict=True)
            ]
        return poses

    def find_static_transform(self, target: str, source: str) -> Rigid3 | None:
        """Return to_from_of if both are static in a common frame, else None."""
        paths = [
            [end, *(parent for child, parent in self._static_edges(end))]
            for end in (target, source)
        ]
        common = next((name for name in paths[0] if name in paths[1]), None)
        if common is None:
            return None
        common_from_to, common_from_of = (
            self._compose_along(path[: path.index(common) + 1]) for path in paths
        )
        return common_from_to.inverse() @ common_from_of

    def _compose_along(self, path: list[str]) -> Rigid3:
        """Return last_from_first."""
        pose = Rigid3.identity()
        for child, _ in pairwise(path):
            pose = _pose_of_transform(self.transforms[child][-1]) @ pose
        return pose

    def _static_edges(self, frame: str) -> Iterator[tuple[str, str]]:
        for child, parent in self._edges_to_root(frame):
            if not self._is_static(child):
                return
            yield child, parent

    def _edges_to_root(self, frame: str) -> Iterator[tuple[str, str]]:
        """Yield (child, parent) from a frame up to its root."""
        seen = {frame}
        while self.transforms.get(frame):
            parent = self.transforms[frame][0].parent
            yield frame, parent
            if parent in seen:  # a circle
                return
            seen.add(parent)
            frame = parent

    def _is_static(self, frame: str) -> bool:
        return frame in self.static_frames or len(self.transforms[frame]) == 1

    def _poses_at(self, child: str, t_ns: Sequence[int]) -> Sequence[Rigid3 | None]:
        """Return parent_from_child at each time."""
        if self._is_static(child):
            return [_pose_of_transform(self.transforms[child][-1])] * len(t_ns)
        return interpolate_poses(trajectory_from_transforms(self.transforms[child]), t_ns)
