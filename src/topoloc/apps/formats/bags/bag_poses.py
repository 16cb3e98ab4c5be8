"""Compute camera poses from TF, odometry or a topic of poses of a bag.

In the tree of TF each frame has one parent, and is static or moves in it.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from topoloc import Rigid3, Trajectory, TrajectoryError
from topoloc.apps.formats.bags.bag import Bag
from topoloc.apps.formats.bags.messages import TRANSFORM_TYPES, StampedTransform, decode_transforms
from topoloc.apps.formats.bags.topics import TF, Roles
from topoloc.plugin import read_ground_truth

_MAX_GAP_S = 0.2
# A correction changes slowly, but for a relocalization.
_MAX_CORRECTION_GAP_S, _MAX_CORRECTION_M, _MAX_CORRECTION_RAD = 10.0, 0.5, math.radians(10.0)
_TOLERANCE = 1e-6  # metres, and radians
_MAX_MISSING_SHARE = 0.1
_WORLD_FRAMES = ("map", "odom", "world")  # REP 105


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
    """Hold the transforms of each frame in its parent. Those of `static_frames`, and those that are
    sent again and again with the same numbers, hold for all times."""

    transforms: dict[str, list[StampedTransform]] = field(default_factory=dict)
    static_frames: set[str] = field(default_factory=set)
    _changed_frames: set[str] = field(default_factory=set)

    def add(self, its: StampedTransform, is_static: bool) -> None:
        """Add a transform. If a frame has several parents, the first one is used."""
        known = self.transforms.setdefault(its.child, [])
        if its.child and not (known and known[0].parent != its.parent):
            known.append(its)
            if not _is_same(known[0], its):
                self._changed_frames.add(its.child)
            if is_static:
                self.static_frames.add(its.child)

    def is_moving(self, frame: str) -> bool:
        """Return whether a transform between this frame and the root of its tree changes."""
        return any(not self._is_static(below) for below, _ in self._edges_to_root(frame))

    def is_standing(self, frame: str) -> bool:
        """Return whether transforms up to a world are sent again and again with the same
        numbers, as by a robot that does not move."""
        edges = list(self._edges_to_root(frame))
        sent = [child for child, _ in edges if child not in self.static_frames]
        is_sent_again = any(len(self.transforms[child]) > 1 for child in sent)
        return is_sent_again and edges[-1][1] in _WORLD_FRAMES

    def poses(self, frame: str, t_ns: Sequence[int]) -> list[Rigid3 | None]:
        """Return world_from_frame at each time, with the root as world. None if a transform is
        unknown at that time. Raises TrajectoryError: a quaternion without length."""
        poses: list[Rigid3 | None] = [Rigid3.identity()] * len(t_ns)
        edges = [child for child, _ in self._edges_to_root(frame)]
        carrier = max(edges, key=self._path_length, default="")
        for row, child in enumerate(edges):
            steps = self._poses_at(child, t_ns, row > edges.index(carrier))
            poses = [
                step @ pose if step is not None and pose is not None else None
                for step, pose in zip(steps, poses, strict=True)
            ]
        return poses

    def describe_slow_edge(self, frame: str) -> str | None:
        """Return the first transform above a frame that comes too rarely, with its period."""
        for child, parent in self._edges_to_root(frame):
            if not self._is_static(child):
                gap = _median_gap_s(self.transforms[child])
                if gap > _MAX_GAP_S:
                    return f"TF from {parent} to {child} comes once in {gap:.2g} s"
        return None

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
        return frame in self.static_frames or frame not in self._changed_frames

    def _path_length(self, frame: str) -> float:
        """Return how far a frame moves and turns in its parent (metres plus radians)."""
        if self._is_static(frame):
            return 0.0
        steps = pairwise(self.transforms[frame])
        return sum(math.dist(a.translation, b.translation) + _angle(a, b) for a, b in steps)

    def _poses_at(
        self, child: str, t_ns: Sequence[int], is_correction: bool
    ) -> Sequence[Rigid3 | None]:
        """Return parent_from_child at each time. A correction, such as that of odometry in a map,
        may come rarely."""
        if self._is_static(child):
            return [pose_of_transform(self.transforms[child][-1])] * len(t_ns)
        trajectory = trajectory_from_transforms(self.transforms[child])
        if is_correction:
            return _interpolate_correction(trajectory, t_ns)
        return trajectory.interpolate(t_ns, _MAX_GAP_S)


def _interpolate_correction(trajectory: Trajectory, t_ns: Sequence[int]) -> list[Rigid3 | None]:
    """Return the pose at each time. Neighbours may be some seconds apart, unless they differ as
    after a relocalization. The first and the last one hold as long before and after."""
    times, poses = trajectory.t_ns or [], trajectory.world_from_cam
    clipped = [min(max(time, times[0]), times[-1]) for time in t_ns]
    found = trajectory.interpolate(clipped, _MAX_CORRECTION_GAP_S)
    for row, (time, near) in enumerate(zip(t_ns, clipped, strict=True)):
        after = bisect.bisect_left(times, near)
        is_jump = times[after] - near > 0 and times[after] - times[after - 1] > _MAX_GAP_S * 1e9
        if is_jump:
            change = poses[after - 1].inverse() @ poses[after]
            moved, turned = float(np.linalg.norm(change.translation)), change.angle()
            is_jump = moved > _MAX_CORRECTION_M or turned > _MAX_CORRECTION_RAD
        if is_jump or abs(time - near) > _MAX_CORRECTION_GAP_S * 1e9:
            found[row] = None
    return found


def _is_same(a: StampedTransform, b: StampedTransform) -> bool:
    return math.dist(a.translation, b.translation) <= _TOLERANCE and _angle(a, b) <= _TOLERANCE


def _angle(a: StampedTransform, b: StampedTransform) -> float:
    """Return about the angle between two rotations, if it is small. q and -q are the same one."""
    opposite = tuple(-number for number in b.quat_xyzw)
    return 2.0 * min(math.dist(a.quat_xyzw, b.quat_xyzw), math.dist(a.quat_xyzw, opposite))


def _median_gap_s(transforms: list[StampedTransform]) -> float:
    times = np.unique([its.t_ns for its in transforms])
    return float(np.median(np.diff(times))) / 1e9 if len(times) > 1 else 0.0


def _read_transforms(bag: Bag, name: str) -> tuple[list[StampedTransform], int]:
    """Return the transforms of a topic and the number of damaged messages. If those of a frame all
    have one time, they get the times of writing."""
    parsed, num_damaged = bag.parse_messages(name, decode_transforms)
    times: dict[str, list[int]] = {}
    for its in (its for _, some in parsed for its in some):
        times.setdefault(its.child, []).append(its.t_ns)
    timeless = {
        child for child, stamps in times.items() if len(stamps) > 2 and len(set(stamps)) == 1
    }
    timed = list[StampedTransform]()
    for ref, some in parsed:
        for its in some:
            is_timeless = its.child in timeless
            t_ns = ref.log_t_ns if is_timeless else bag.clock.unwrap(ref.place, its.t_ns)
            timed.append(its if t_ns == its.t_ns else replace(its, t_ns=t_ns))
    return timed, num_damaged


def read_transform_tree(bag: Bag) -> TransformTree:
    """Return all transforms of the bag. Damaged messages are skipped and counted in the bag's
    notes."""
    tree, total = TransformTree(), 0
    for name in [name for name, topic in bag.topics.items() if topic.type in TRANSFORM_TYPES]:
        transforms, num_damaged = _read_transforms(bag, name)
        for its in transforms:
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
    frame = roles.pose_frame or camera_frame
    for source in roles.poses:
        num_notes = len(bag.notes)
        if source == TF:
            poses = tree.poses(frame, t_ns) if tree.is_moving(frame) else []
            slow = tree.describe_slow_edge(frame)
        else:
            poses, slow = _poses_from_topic(bag, source, roles, camera_frame, tree, t_ns)
        num_missing = sum(pose is None for pose in poses)
        if num_missing < len(poses):
            if slow and num_missing > _MAX_MISSING_SHARE * len(poses):
                bag.notes.append(
                    f"{bag.path}: {slow}, too rarely to interpolate: {num_missing} of {len(poses)}"
                    " pictures have no pose; choose another topic (--topics pose=TOPIC) or compute"
                    " the poses (--trajectory slam)"
                )
            return poses
        del bag.notes[num_notes:]
    if TF in roles.poses and tree.is_standing(frame):
        return tree.poses(frame, t_ns)
    message = (
        f"{bag.path}: no pose of {camera_frame or 'the camera'} at the times of the pictures in"
        f" {' or '.join(roles.poses)}"
    )
    if roles.is_pose_requested:
        raise TrajectoryError(message)
    bag.notes.append(f"{message}; the recording is taken as one without poses")
    return [None] * len(t_ns)


def _poses_from_topic(
    bag: Bag, name: str, roles: Roles, camera_frame: str, tree: TransformTree, t_ns: list[int]
) -> tuple[list[Rigid3 | None], str | None]:
    """Return camera poses from a topic with the poses of the roles' frame, or else of the frame
    that its messages name. The second value says so if they come too rarely."""
    frame = roles.pose_frame
    transforms, num_damaged = _read_transforms(bag, name)
    bag.note_damaged(num_damaged, name)
    if not transforms:
        return [None] * len(t_ns), None
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
    gap = _median_gap_s(transforms)
    slow = f"poses of {name} come once in {gap:.2g} s" if gap > _MAX_GAP_S else None
    world_from_bodies = trajectory_from_transforms(transforms).interpolate(t_ns, _MAX_GAP_S)
    return [pose and pose @ body_from_cam for pose in world_from_bodies], slow
