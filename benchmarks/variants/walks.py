"""Recordings as lists of files, which can be changed and written as a folder again."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.camera import Camera
from topoloc.geometry.rig import StereoRig
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import SequenceView, StereoFrame
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import Recording

Edit = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Walk:
    """A stereo or RGB-D recording. `others` are right or depth images, or empty.

    `times` are seconds. `pose_times` are those of the truth. An
    edit changes the pixels of an image while it is written. `damaged` are rows of left images that
    are cut.
    """

    lefts: list[Path]
    others: list[Path]
    camera: Camera
    times: list[float]
    pose_times: list[float]
    poses: list[Rigid3] | None
    baseline: float | None = None
    depth_factor: float | None = None
    layout: str = "folder"
    edit_left: Edit | None = None
    edit_other: Edit | None = None
    damaged: tuple[int, ...] = ()
    rig: StereoRig | None = None

    def select(self, rows: slice | list[int]) -> Walk:
        """Return some of the frames. If there are poses, each frame has one."""
        chosen = list(range(len(self.lefts)))[rows] if isinstance(rows, slice) else rows

        def of(values: list) -> list:
            return [values[row] for row in chosen] if values else values

        return replace(
            self,
            lefts=of(self.lefts),
            others=of(self.others),
            times=of(self.times),
            pose_times=of(self.pose_times),
            poses=self.poses and of(self.poses),
        )

    def with_poses(self, change: Callable[[Rigid3], Rigid3]) -> Walk:
        """Return the recording with changed poses."""
        assert self.poses is not None
        return replace(self, poses=[change(pose) for pose in self.poses])

    def write(self, folder: Path) -> Path:
        """Write the recording to a new folder. Unchanged images are links."""
        first, second = ("left", "right") if self.baseline is not None else ("rgb", "depth")
        if self.layout == "kitti":
            first, second = "image_0", "image_1"
        lists = ((first, self.lefts, self.edit_left), (second, self.others, self.edit_other))
        for name, paths, edit in lists:
            if paths:
                _write_images(folder / name, paths, edit, self.damaged if name == first else ())
        _write_lines(folder / "times.txt", [f"{t:.9f}" for t in self.times])
        if self.poses is not None:
            _write_lines(
                folder / "truth.tum",
                [
                    " ".join(map(repr, (t, *pose.translation.tolist(), x, y, z, w)))
                    for t, pose in zip(self.pose_times, self.poses, strict=True)
                    for w, x, y, z in [pose.quat_wxyz().tolist()]
                ],
            )
        self._write_calibration(folder)
        return folder

    def _write_calibration(self, folder: Path) -> None:
        camera, shift = self.camera, self.camera.fx * (self.baseline or 0.0)
        if self.layout == "kitti":
            rows = [
                f"P{k}: {camera.fx} 0 {camera.cx} {-k * shift} 0 {camera.fy} {camera.cy} 0 0 0 1 0"
                for k in range(2)
            ]
            _write_lines(folder / "calib.txt", rows)
            return
        if self.rig is not None:
            matrix = self.rig.right_from_left.matrix().tolist()
            data = {"left": self.rig.left.to_json(), "right": self.rig.right.to_json()}
            text = json.dumps(data | {"right_from_left": matrix})
            (folder / "camera.json").write_text(text)
            return
        names = ("model", "width", "height", "fx", "fy", "cx", "cy")
        data = {name: getattr(camera, name) for name in names}
        given = {"baseline": self.baseline, "depth_factor": self.depth_factor}
        data |= {key: value for key, value in given.items() if value is not None}
        (folder / "camera.json").write_text(json.dumps(data))


def _write_lines(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))


def _write_images(
    folder: Path, paths: list[Path], edit: Edit | None, damaged: tuple[int, ...]
) -> None:
    folder.mkdir(parents=True)
    for row, path in enumerate(paths):
        target = folder / f"{row:06d}{path.suffix if edit is None else '.png'}"
        if row in damaged:
            target.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        elif edit is None:
            os.symlink(path, target)
        else:
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert image is not None
            cv2.imwrite(str(target), edit(image))


# Recordings below the data, `demo:`, or `sgm:` (depth by semi-global matching).
BASES = {
    "zed1": "zed_lab/session1@0:80",
    "zed2": "zed_lab/session2@0:80",
    "street1": "kitti/sequences/street1",
    "street2": "kitti/sequences/street2",
    "lab": "demo:map_lap1",
    "kitchen": "seven_scenes/kitchen/seq-01@0:100",
    "zed depth": "sgm:zed_lab/session2@0:80",
    "euroc": "euroc/v1_01_part",
}


@cache
def read_walk(name: str, data: Path, work: Path) -> Walk:
    """Read a recording of `BASES`. Depth is registered to the image, and written below `work`."""
    address = BASES[name]
    place = address.removeprefix("sgm:")
    is_demo = place.startswith("demo:")
    path = SHIPPED / place.removeprefix("demo:") if is_demo else data / place
    view = open_sequence(path)
    rows = view.indices if isinstance(view, SequenceView) else list(range(len(view)))
    base = view.base if isinstance(view, SequenceView) else view
    assert isinstance(base, Recording)
    assert base.camera is not None
    files = [[file.resolve() for file in base.paths_of(row)] for row in rows]
    times = [t / 1e9 for t in view.t_ns]
    posed = [(t, pose) for t, pose in zip(times, view.poses, strict=True) if pose is not None]
    poses = [pose for _, pose in posed] if posed else None
    start = [one[0] for one in files], [], base.camera, times, [t for t, _ in posed], poses
    walk = Walk(*start)
    if base.right is not None and not address.startswith("sgm:"):
        rig = base.right.rig
        walk = replace(walk, others=[one[1] for one in files], baseline=rig.baseline)
        return walk if rig.is_rectified else replace(walk, rig=rig)
    depths = []
    for row in rows:
        depths.append(work / "depth" / name / f"{row:06d}.png")
        depths[-1].parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(depths[-1]), depth_mm(base[row]))
    return replace(walk, others=depths, depth_factor=1000.0)


def depth_mm(frame: StereoFrame) -> np.ndarray:
    """Return the depth of the image in millimetres, 0 if unknown. Depth of stereo pairs is by
    semi-global matching (Hirschmueller 2008, in OpenCV's version)."""
    view = prepare_frame(frame)
    if view.depth is not None:
        return np.rint(1000.0 * np.nan_to_num(view.depth)).astype(np.uint16)
    assert view.rig is not None
    assert view.right_grey is not None
    matcher = cv2.StereoSGBM.create(
        0, 128, 5, 8 * 25, 32 * 25, 1, 63, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH
    )
    disparity = matcher.compute(view.grey, view.right_grey).astype(np.float64) / 16.0
    with np.errstate(divide="ignore"):
        millimetres = 1000.0 * view.rig.left.fx * view.rig.baseline / disparity
    is_known = (disparity > 1.0) & (millimetres < 65000.0)
    return np.where(is_known, np.rint(millimetres), 0).astype(np.uint16)
