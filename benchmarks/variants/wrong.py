"""Wrong variants of recordings, as users make them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3, exp_so3
from topoloc.recordings.trajectory import Trajectory
from variants.walks import Walk

Change = Callable[[Walk], Walk]


@dataclass(frozen=True)
class Variant:
    """A kind of change, the recording, and the change. `second`: a second recording, and its
    change."""

    kind: str
    base: str
    change: Change
    second: tuple[str, Change] | None = None

    @property
    def name(self) -> str:
        return f"{self.base}: {self.kind}"


STEREO = ("zed1", "zed2", "street1", "street2", "lab")
DEPTH = ("kitchen", "zed depth")
TURNING = ("zed1", "zed2", "lab", *DEPTH)  # not straight at an even speed
FLIP = np.diag([1.0, -1.0, -1.0])


def by_slam(change: Change) -> Change:
    """Leave the poses out."""
    return lambda walk: replace(change(walk), poses=None)


def swap(walk: Walk) -> Walk:
    return replace(walk, lefts=walk.others, others=walk.lefts)


def scale_baseline(factor: float) -> Change:
    return lambda walk: replace(walk, baseline=factor * (walk.baseline or 0.0))


def scale_focal(factor: float) -> Change:
    def change(walk: Walk) -> Walk:
        c = walk.camera
        camera = Camera.pinhole(c.width, c.height, factor * c.fx, factor * c.fy, c.cx, c.cy)
        return replace(walk, camera=camera)

    return change


def scale_poses(factor: float) -> Change:
    return lambda walk: walk.with_poses(lambda p: Rigid3(p.rotation, factor * p.translation))


def scale_depth(factor: float) -> Change:
    return lambda walk: replace(walk, depth_factor=(walk.depth_factor or 0.0) * factor)


def change_poses(change: Callable[[Rigid3], Rigid3]) -> Change:
    return lambda walk: walk.with_poses(change)


def rotate_right(degrees: float, axis: tuple[float, float, float]) -> Change:
    """Turn the right camera: a pair that was not rectified."""

    def change(walk: Walk) -> Walk:
        c = walk.camera
        k = np.array([[c.fx, 0.0, c.cx], [0.0, c.fy, c.cy], [0.0, 0.0, 1.0]])
        turned = k @ exp_so3(np.radians(degrees) * np.array(axis)) @ np.linalg.inv(k)
        return replace(walk, edit_other=lambda im: cv2.warpPerspective(im, turned, im.shape[1::-1]))

    return change


def forget_rig(walk: Walk) -> Walk:
    camera = Camera.pinhole(walk.camera.width, walk.camera.height, *walk.camera.intrinsics)
    return replace(walk, rig=None, camera=camera)


def shift_clock(seconds: float) -> Change:
    """The poses of a clock that is not the images'."""

    def change(walk: Walk) -> Walk:
        assert walk.poses is not None
        trajectory = Trajectory(walk.poses, [round(1e9 * t) for t in walk.pose_times])
        times = [round(1e9 * (t + seconds)) for t in walk.times]
        found = trajectory.interpolate(times, 1.0)
        rows = [row for row, pose in enumerate(found) if pose is not None]
        poses = [pose for pose in found if pose is not None]
        kept = walk.select(rows)
        return replace(kept, poses=poses, pose_times=kept.times)

    return change


def shift_poses(walk: Walk) -> Walk:
    """Each image has the pose of the next one."""
    assert walk.poses is not None
    kept = walk.select(slice(0, -1))
    return replace(kept, poses=walk.poses[1:])


def scale_times(images: float, poses: float) -> Change:
    return lambda walk: replace(
        walk,
        times=[images * t for t in walk.times],
        pose_times=[poses * t for t in walk.pose_times],
    )


def enlarge_calibration(is_size_changed: bool, layout: str = "folder") -> Change:
    """The calibration of an image of twice the size."""

    def change(walk: Walk) -> Walk:
        c = walk.camera
        size = (2 * c.width, 2 * c.height) if is_size_changed else (c.width, c.height)
        k = [2.0 * v for v in (c.fx, c.fy, c.cx, c.cy)]
        return replace(walk, camera=Camera.pinhole(*size, *k), layout=layout)

    return change


def move_depth(metres: float, focal: float = 1.0) -> Change:
    """The depth of a camera beside the image's, or of another focal length."""

    def change(walk: Walk) -> Walk:
        c = walk.camera

        def edit(depth: np.ndarray) -> np.ndarray:
            v, u = np.nonzero(depth)
            z = depth[v, u].astype(np.float64) / (walk.depth_factor or 1.0)
            x = focal * (u - c.cx) + focal * c.fx * metres / z + c.cx
            y = focal * (v - c.cy) + c.cy
            moved = np.zeros_like(depth)
            order = np.argsort(-z)
            x, y, values = (np.rint(a[order]).astype(int) for a in (x, y, depth[v, u]))
            inside = (x >= 0) & (y >= 0) & (x < c.width) & (y < c.height)
            moved[y[inside], x[inside]] = values[inside]
            holes = cv2.morphologyEx(moved, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
            return np.where(moved == 0, holes, moved)

        return replace(walk, edit_other=edit)

    return change


def to_8_bits(walk: Walk) -> Walk:
    return replace(walk, edit_other=lambda depth: np.clip(depth // 20, 0, 255).astype(np.uint8))


def damage(walk: Walk) -> Walk:
    return replace(walk, damaged=(3, 7, 8))


def move_world(walk: Walk) -> Walk:
    moved = Rigid3(exp_so3(np.array([0.1, -0.7, 0.2])), np.array([2.0, -1.0, 0.5]))
    return walk.with_poses(lambda pose: moved @ pose)


def wrong_variants() -> Iterator[Variant]:
    """Yield all wrong variants."""
    yield from _wrong_stereo()
    yield from _wrong_depth()
    yield from _wrong_poses()
    yield from _wrong_times()
    for base in ("zed1", "kitchen"):
        yield Variant("damaged images", base, damage)
    halves = [(lambda w: w.select(slice(None, None, 2))), lambda w: w.select(slice(1, None, 2))]
    for base in ("zed1", "kitchen", "lab", "street1"):
        other = halves[1]
        yield Variant(
            "two worlds", base, halves[0], (base, lambda w, half=other: move_world(half(w)))
        )
    yield Variant("two worlds", "zed1 and zed2", lambda w: w, ("zed2", lambda w: w))


def _wrong_stereo() -> Iterator[Variant]:
    for base in STEREO:
        yield Variant("swapped", base, swap)
        yield Variant("right turned 1 deg about x", base, rotate_right(1.0, (1.0, 0.0, 0.0)))
        yield Variant("right turned 1.5 deg about z", base, rotate_right(1.5, (0.0, 0.0, 1.0)))
        for name, factor in {"mm": 1e3, "cm": 1e2, "15 % more": 1.15, "15 % less": 0.85}.items():
            yield Variant(f"baseline, {name}", base, scale_baseline(factor))
        yield Variant("baseline, feet", base, scale_baseline(1 / 0.3048))
        yield Variant(
            "calibration of larger image, KITTI", base, enlarge_calibration(True, "kitti")
        )
    for base in ("zed1", "lab"):
        yield Variant("swapped, slam", base, by_slam(swap))
        turn = rotate_right(1.0, (1.0, 0.0, 0.0))
        yield Variant("right turned 1 deg about x, slam", base, by_slam(turn))
        yield Variant("baseline, mm, slam", base, by_slam(scale_baseline(1e3)))
        larger = by_slam(enlarge_calibration(True, "kitti"))
        yield Variant("calibration of larger image, KITTI, slam", base, larger)
        larger = by_slam(enlarge_calibration(False))
        yield Variant("calibration of larger image, slam", base, larger)
    yield Variant("swapped, slam", "euroc", swap)
    yield Variant("not rectified, slam", "euroc", forget_rig)


def _wrong_depth() -> Iterator[Variant]:
    for base in DEPTH:
        factors = {"10x": 10.0, "1/10": 0.1, "1000x": 1e3, "15 % more": 1.15, "15 % less": 0.85}
        for name, factor in factors.items():
            yield Variant(f"depth factor, {name}", base, scale_depth(factor))
        yield Variant("depth of a camera 5 cm beside", base, move_depth(0.05))
        yield Variant("depth of a camera 5 cm beside, slam", base, by_slam(move_depth(-0.05)))
        yield Variant("depth of focal length x 1.12", base, move_depth(0.0, 1.12))
        yield Variant("depth of 8 bits", base, to_8_bits)


def _wrong_poses() -> Iterator[Variant]:
    for base in (*STEREO, *DEPTH):
        yield Variant("focal length 15 % more", base, scale_focal(1.15))
        yield Variant("focal length 15 % less", base, scale_focal(0.85))
        yield Variant("calibration of larger image", base, enlarge_calibration(False))
        yield Variant("calibration and size of larger image", base, enlarge_calibration(True))
        factors = {"15 % more": 1.15, "15 % less": 0.85, "2x": 2.0, "mm": 1000.0, "feet": 3.2808}
        for name, factor in factors.items():
            yield Variant(f"poses, {name}", base, scale_poses(factor))
        yield Variant("poses, inverse", base, change_poses(Rigid3.inverse))
        yield Variant(
            "poses, OpenGL", base, change_poses(lambda p: Rigid3(p.rotation @ FLIP, p.translation))
        )
        yield Variant(
            "poses, transposed",
            base,
            change_poses(lambda p: Rigid3(p.rotation.T.copy(), p.translation)),
        )
    for base in ("zed1", "lab", "kitchen", "zed depth"):
        yield Variant("focal length 15 % more, slam", base, by_slam(scale_focal(1.15)))


def _wrong_times() -> Iterator[Variant]:
    for base in TURNING:
        for seconds in (0.3, 1.0):
            yield Variant(f"clock off by {seconds:g} s", base, shift_clock(seconds))
        yield Variant("poses shifted by one", base, shift_poses)
    yield from changed_times("kitchen")


def changed_times(base: str) -> Iterator[Variant]:
    """Yield variants with times in other units. Dates are recognized, others are not."""
    for name, factor in {"ms": 1e3, "us": 1e6, "ns": 1e9}.items():
        yield Variant(f"times in {name}", base, scale_times(factor, 1.0))
        yield Variant(f"all times in {name}", base, scale_times(factor, factor))
        yield Variant(f"times in {name}, slam", base, by_slam(scale_times(factor, factor)))
