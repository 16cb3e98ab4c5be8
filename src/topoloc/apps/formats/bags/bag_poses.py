"""Compute camera poses from TF, odometry or a topic of poses of a bag.

In the tree of TF each frame has one parent, and is static or moves in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from topoloc import Rigid3, Trajectory, TrajectoryError
from topoloc.apps.formats.bags.bag import Bag
from topoloc.apps.formats.bags.messages import TRANSFORM_TYPES, StampedTransform, decode_transforms
from topoloc.apps.formats.bags.topics import TF, Roles
from topoloc.plugin import read_ground_truth


def trajectory_from_transforms(transforms: list[StampedTransform]) -> Trajectory:
    """Return the poses in order of time. Of equal times the last one is used."""
    by_time = {its.t_ns: its for its in sorted(transforms, key=lambda its: its.t_ns)}
    rows = [(*its.translation, *its.quat_xyzw) for its in by_time.values()]
    numbers = np.array(rows, dtype=np.float64).reshape(-1, 7)
    return Trajectory.from_quaternions(numbers, list(by_time))


def pose_of_transform(its: StampedTransform) -> Rigid3:
    """Return parent_from_child."""
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
        unknown at that time. Raises TrajectoryError: a quaternion without length."""
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
            pose = pose_of_transform(self.transforms[child][-1]) @ pose
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
            return [pose_of_transform(self.transforms[child][-1])] * len(t_ns)
        return trajectory_from_transforms(self.transforms[child]).interpolate(t_ns)


def read_transform_tree(bag: Bag) -> TransformTree:
    """Return all transforms of the bag. Damaged messages are skipped and counted in the bag's
    notes."""
    tree, total = TransformTree(), 0
    for name in [name for name, topic in bag.topics.items() if topic.type in TRANSFORM_TYPES]:
        parsed, num_damaged = bag.parse_messages(name, decode_transforms)
        for its in (its for _, transforms in parsed for its in transforms):
            tree.add(its, is_static=name.endswith("static"))
        total += num_damaged
    bag.note_damaged(total, "transforms")
    return tree


def camera_poses(
    bag: Bag, roles: Roles, camera_frame: str, tree: TransformTree, t_ns: list[int]
) -> list[Rigid3 | None]:
    """Return world_from_cam of each frame, None if unknown. Without a topic of poses they are those
    of a TUM file beside the bag. Raises TrajectoryError: the topic of `--topics pose=` has no pose
    for any frame, or the TUM file is malformed."""
    if not roles.poses:
        beside = bag.path / "truth.tum" if bag.path.is_dir() else bag.path.with_suffix(".tum")
        return read_ground_truth(Path(beside), [], t_ns)
    for source in roles.poses:
        num_notes = len(bag.notes)
        if source == TF:
            frame = roles.pose_frame or camera_frame
            poses = tree.poses(frame, t_ns) if tree.is_moving(frame) else []
        else:
            poses = _poses_from_topic(bag, source, roles.pose_frame, camera_frame, tree, t_ns)
        if any(pose is not None for pose in poses):
            return poses
        del bag.notes[num_notes:]
    message = (
        f"{bag.path}: no pose of {camera_frame or 'the camera'} at the times of the pictures in"
        f" {' or '.join(roles.poses)}"
    )
    if roles.is_pose_requested:
        raise TrajectoryError(message)
    bag.notes.append(f"{message}; the recording is taken as one without poses")
    return [None] * len(t_ns)


def _poses_from_topic(
    bag: Bag, name: str, frame: str | None, camera_frame: str, tree: TransformTree, t_ns: list[int]
) -> list[Rigid3 | None]:
    """Return camera poses from a topic with the poses of `frame`, or else of the frame that its
    messages name."""
    parsed, num_damaged = bag.parse_messages(name, decode_transforms)
    bag.note_damaged(num_damaged, name)
    transforms = [its for _, some in parsed for its in some]
    if not transforms:
        return [None] * len(t_ns)
    body = frame or transforms[0].child
    body_from_cam = tree.find_static_transform(body, camera_frame) if body else None
    if body_from_cam is None:
        body_from_cam = Rigid3.identity()
        if frame:
            raise TrajectoryError(
                f"{bag.path}: no fixed transform from {camera_frame or 'the camera'} to {frame},"
                f" which {name} is of"
            )
        why = "it does not say whose they are (pose_frame=FRAME would)"
        why = f"no fixed transform from {camera_frame} to {body}" if body else why
        bag.notes.append(f"{bag.path}: poses of {name} are taken for the camera's: {why}")
    world_from_bodies = trajectory_from_transforms(transforms).interpolate(t_ns)
    return [pose @ body_from_cam if pose is not None else None for pose in world_from_bodies]
