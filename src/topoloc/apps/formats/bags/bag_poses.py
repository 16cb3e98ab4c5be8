"""Compute camera poses from TF, odometry or a topic of poses of a bag."""

from __future__ import annotations

from pathlib import Path

from topoloc import RecordingError, Rigid3, TrajectoryError
from topoloc.apps.formats.bags.bag import Bag
from topoloc.apps.formats.bags.messages import TRANSFORM_TYPES, StampedTransform, decode_transforms
from topoloc.apps.formats.bags.topics import TF, Roles
from topoloc.apps.formats.bags.transform_tree import TransformTree, trajectory_from_transforms
from topoloc.plugin import interpolate_poses, read_ground_truth


def read_transform_tree(bag: Bag) -> TransformTree:
    """Return all transforms of the bag. Damaged messages are skipped and counted in the bag's
    notes."""
    tree, num_damaged = TransformTree(), 0
    for name, topic in bag.topics.items():
        if topic.type not in TRANSFORM_TYPES:
            continue
        for ref in bag.messages(name):
            try:
                for its in decode_transforms(topic, bag.read(ref)):
                    tree.add(its, is_static=name.endswith("static"))
            except RecordingError:
                num_damaged += 1
    if num_damaged:
        bag.notes.append(
            f"{bag.path}: {num_damaged} messages of transforms are damaged and left out"
        )
    return tree


def camera_poses(
    bag: Bag, roles: Roles, camera_frame: str, tree: TransformTree, t_ns: list[int]
) -> list[Rigid3 | None]:
    """Return world_from_cam of each frame, None if unknown. Without a topic of poses they are those
    of a TUM file beside the bag.

    Raises:
        TrajectoryError: what was asked for (`--topics pose=`) gives no frame a pose, or the TUM
            file is malformed.
    """
    if not roles.poses:
        beside = bag.path / "truth.tum" if bag.path.is_dir() else bag.path.with_suffix(".tum")
        return read_ground_truth(Path(beside), [], t_ns)
    for source in roles.poses:
        num_notes = len(bag.notes)
        if source == TF:
            poses = _poses_from_tf(roles, camera_frame, tree, t_ns)
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


def _poses_from_tf(
    roles: Roles, camera_frame: str, tree: TransformTree, t_ns: list[int]
) -> list[Rigid3 | None]:
    frame = roles.pose_frame or camera_frame
    return tree.poses(frame, t_ns) if tree.is_moving(frame) else [None] * len(t_ns)


def _poses_from_topic(
    bag: Bag, name: str, frame: str | None, camera_frame: str, tree: TransformTree, t_ns: list[int]
) -> list[Rigid3 | None]:
    """Return camera poses from a topic with the poses of `frame`, or else of the frame that its
    messages name."""
    transforms = _read_topic_transforms(bag, name)
    if not transforms:
        return [None] * len(t_ns)
    whose = frame or transforms[0].child
    body_from_cam = tree.find_static_transform(whose, camera_frame) if whose else None
    if body_from_cam is None:
        body_from_cam = Rigid3.identity()
        if frame:
            raise TrajectoryError(
                f"{bag.path}: no fixed transform from {camera_frame or 'the camera'} to {frame},"
                f" which {name} is of"
            )
        why = (
            f"no fixed transform from {camera_frame} to {whose}"
            if whose
            else "it does not say whose they are (pose_frame=FRAME would)"
        )
        bag.notes.append(f"{bag.path}: poses of {name} are taken for the camera's: {why}")
    world_from_bodies = interpolate_poses(trajectory_from_transforms(transforms), t_ns)
    return [pose @ body_from_cam if pose is not None else None for pose in world_from_bodies]


def _read_topic_transforms(bag: Bag, name: str) -> list[StampedTransform]:
    transforms: list[StampedTransform] = []
    num_damaged = 0
    for ref in bag.messages(name):
        try:
            transforms += decode_transforms(bag.topics[name], bag.read(ref))
        except RecordingError:
            num_damaged += 1
    if num_damaged:
        bag.notes.append(f"{bag.path}: {num_damaged} messages of {name} are damaged and left out")
    return transforms
