"""Recordings of several cameras of one body: a folder with ``rig.json`` and one recording for each
camera in the folder of its name, and panoramas of 360 x 180 degrees.

Images of one instant have one name. Poses are those of the cameras' recordings, or those of the rig
(`truth.tum` or `poses.txt` beside rig.json). Each image is a frame of its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from topoloc import (
    Image,
    RecordingError,
    Rig,
    RigCamera,
    Rigid3,
    StereoFrame,
    StereoSequence,
    cut_panorama,
    open_sequence,
)
from topoloc.apps.core_names import RigFrame, as_monocular, select_frames, split_selection
from topoloc.plugin import (
    IndexedFrames,
    RecordingFormat,
    natural_key,
    read_ground_truth,
    times_from_rate,
)

EXPECTED_FILES = "rig.json, and a recording in the folder of each camera's name"
_POSE_FILES = ("truth.tum", "poses.tum", "poses.txt")


@dataclass(frozen=True, eq=False)
class RigWalk:
    """Hold the recordings of a rig's cameras, and the name and time of each instant. `poses` are
    those of the rig by the file beside rig.json, None without one."""

    folder: Path
    rig: Rig
    walks: dict[str, StereoSequence]
    rows: dict[str, dict[str, int]]
    names: list[str]
    t_ns: list[int]
    poses: list[Rigid3 | None]

    @staticmethod
    def open(folder: Path, rig_file: Path) -> RigWalk:
        """Open the recordings of a rig that is in a file. Raises as `of_rig`; CalibrationError: the
        file of the rig has another content."""
        return RigWalk.of_rig(folder, Rig.read(rig_file), str(rig_file))

    @staticmethod
    def of_rig(folder: Path, rig: Rig, source: str) -> RigWalk:
        """Open the recordings of the cameras that have one. `source` is where the rig is from.

        Cameras without a model in the file of the rig take that of their recording.

        Raises:
            RecordingError: no camera has a recording, one cannot be read, or names differ.
            TrajectoryError: the poses are malformed.
        """
        found = [name for name in rig.cameras if (folder / name).exists()]
        if not found:
            raise RecordingError(
                f"{folder}: no folder is named as a camera of {source} ({', '.join(rig.cameras)})"
            )
        walks = {name: as_monocular(open_sequence(folder / name)) for name in found}
        cameras = {
            name: replace(one, camera=walks[name][0].camera)
            if one.camera is None and name in walks
            else one
            for name, one in rig.cameras.items()
        }
        rows = {name: {own: k for k, own in enumerate(w.names)} for name, w in walks.items()}
        _check_names(folder, rows)
        times = dict[str, int]()
        for walk in reversed(walks.values()):
            times |= zip(walk.names, walk.t_ns, strict=True)
        names = sorted(times, key=natural_key)
        t_ns = [times[name] for name in names]
        if any(after <= before for before, after in pairwise(t_ns)):  # numbers of photos, no times
            t_ns = times_from_rate(len(names), 1)
        files = [folder / name for name in _POSE_FILES]
        poses = read_ground_truth(files[0], files[1:], t_ns, names)
        return RigWalk(folder, Rig(cameras), walks, rows, names, t_ns, poses)

    def find_pose(self, row: int) -> Rigid3 | None:
        """Return world_from_rig of an instant by its file, or by the first camera with a pose."""
        if self.poses[row] is not None:
            return self.poses[row]
        for camera, own in self.rows.items():
            taken = own.get(self.names[row])
            pose = None if taken is None else self.walks[camera].poses[taken]
            if pose is not None:
                return pose @ self.rig.cameras[camera].rig_from_cam.inverse()
        return None

    def read_images(self, name: str) -> dict[str, Image]:
        """Return the images of an instant by the names of their cameras. Raises
        UnreadableImageError."""
        return {
            camera: self.walks[camera][own[name]].image
            for camera, own in self.rows.items()
            if name in own
        }


def _check_names(folder: Path, rows: dict[str, dict[str, int]]) -> None:
    """Raise RecordingError if the images of a camera have names of their own."""
    for name, own in rows.items():
        others = [other for camera, of in rows.items() if camera != name for other in of]
        if others and own.keys().isdisjoint(others):
            raise RecordingError(
                f"{folder}: no image of {name} ({min(own)}, ...) has the name of one of another"
                f" camera ({min(others)}, ...); name the images of one instant alike"
            )


@dataclass(frozen=True, eq=False, repr=False)
class RigRecording(IndexedFrames):
    """A StereoSequence of all images of a rig. `places` are camera and row of each frame."""

    walk: RigWalk
    places: list[tuple[str, int]]
    names: list[str]
    t_ns: list[int]
    poses: list[Rigid3 | None]

    @property
    def name(self) -> str:
        """Return the name of the folder."""
        return self.walk.folder.name

    def __len__(self) -> int:
        return len(self.places)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one image. Raises UnreadableImageError."""
        camera, own = self.places[row]
        frame = self.walk.walks[camera][own]
        return replace(
            frame,
            name=self.names[row],
            t_ns=self.t_ns[row],
            camera=self.walk.rig.cameras[camera].camera,
            world_from_cam=self.poses[row],
        )


def open_rig(path: Path) -> RigRecording:
    """Open a folder. Raises as `RigWalk.open`."""
    walk = RigWalk.open(path, path / "rig.json")
    places, names, times = list[tuple[str, int]](), list[str](), list[int]()
    poses = list[Rigid3 | None]()
    for instant, t_ns, world_from_rig in zip(walk.names, walk.t_ns, walk.poses, strict=True):
        for k, (camera, rows) in enumerate(walk.rows.items()):
            if instant not in rows:
                continue
            pose = walk.walks[camera].poses[rows[instant]]
            if world_from_rig is not None:
                pose = world_from_rig @ walk.rig.cameras[camera].rig_from_cam
            places.append((camera, rows[instant]))
            names.append(f"{camera}/{instant}")
            times.append(t_ns + k)
            poses.append(pose)
    return RigRecording(walk, places, names, times, poses)


@dataclass(frozen=True, eq=False, repr=False)
class PanoramaRecording(IndexedFrames):
    """A StereoSequence of the views of panoramas, whose poses have z to the centre of the image.

    `mounted` are the views of a panorama. `cut` returns the images of a panorama's views by its
    row; it keeps the last ones, because the views of a panorama are read one after the other.
    """

    panoramas: StereoSequence
    mounted: Mapping[str, RigCamera]
    cut: Callable[[int], tuple[Rig, dict[str, Image]]]
    names: list[str]
    t_ns: list[int]
    poses: list[Rigid3 | None]

    @property
    def name(self) -> str:
        """Return the name of the folder."""
        return self.panoramas.name

    def __len__(self) -> int:
        return len(self.names)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one view. Raises UnreadableImageError; QueryError: no panorama."""
        instant, k = divmod(row, len(self.mounted))
        view = list(self.mounted)[k]
        rig, images = self.cut(instant)
        camera, pose = rig.cameras[view].camera, self.poses[row]
        return StereoFrame(
            self.names[row], self.t_ns[row], images[view], camera, world_from_cam=pose
        )


def open_panoramas(path: Path) -> PanoramaRecording:
    """Open a folder of equirectangular images. Raises RecordingError: it cannot be read;
    QueryError: the first image is no panorama."""
    panoramas = as_monocular(open_sequence(path))

    @lru_cache(maxsize=2)
    def cut(row: int) -> tuple[Rig, dict[str, Image]]:
        return cut_panorama(panoramas[row].image)

    mounted = cut(0)[0].cameras
    turns = [one.rig_from_cam for one in mounted.values()]
    return PanoramaRecording(
        panoramas,
        mounted,
        cut,
        [f"{view}/{name}" for name in panoramas.names for view in mounted],
        [t_ns + k for t_ns in panoramas.t_ns for k in range(len(turns))],
        [None if one is None else one @ by for one in panoramas.poses for by in turns],
    )


@dataclass(frozen=True, eq=False, repr=False)
class Instants(IndexedFrames):
    """A StereoSequence whose frames are the instants of a rig, as `RigFrame`. `poses` are
    world_from_rig, `read` returns the rig and the images of a row."""

    name: str
    names: list[str]
    t_ns: list[int]
    poses: list[Rigid3 | None]
    read: Callable[[int], tuple[Rig, dict[str, Image]]]

    def __len__(self) -> int:
        return len(self.names)

    def read_frame(self, row: int) -> RigFrame:
        """Read one instant. Raises UnreadableImageError; QueryError: no panorama."""
        rig, images = self.read(row)
        name, image = next(iter(images.items()))
        camera, pose = rig.cameras[name].camera, self.poses[row]
        taken = self.names[row], self.t_ns[row], image, camera
        return RigFrame(*taken, world_from_cam=pose, mounted=rig, images=images)


def is_rig(path: str) -> bool:
    """Return whether a path, perhaps with a selection, is a folder with rig.json."""
    return os.path.isfile(
        split_selection(path)[0] / "rig.json"
    )  # False for paths that are too long


def open_instants(path: str, rig_file: str | None = None) -> StereoSequence:
    """Open a folder with one recording for each camera of a rig, or panoramas. PATH@0::2 selects
    instants.

    Args:
        rig_file: a rig.json, None: that of the folder; or `equirectangular`.

    Raises:
        RecordingError, CalibrationError, TrajectoryError: as `RigWalk.open`.
    """
    if rig_file == "equirectangular":
        of = as_monocular(open_sequence(path))
        return Instants(
            of.name, of.names, of.t_ns, of.poses, lambda row: cut_panorama(of[row].image)
        )
    folder, selection = split_selection(path)
    walk = RigWalk.open(folder, folder / "rig.json" if rig_file is None else Path(rig_file))
    rows = range(len(walk.names))
    poses = [walk.find_pose(row) for row in rows]
    instants = Instants(
        folder.name,
        walk.names,
        walk.t_ns,
        poses,
        lambda row: (walk.rig, walk.read_images(walk.names[row])),
    )
    return select_frames(instants, selection)


FORMAT = RecordingFormat(EXPECTED_FILES, lambda path: os.path.isfile(path / "rig.json"), open_rig)
PANORAMAS = RecordingFormat(
    "panoramas of 360 x 180 degrees (--format equirectangular)", lambda path: False, open_panoramas
)
