"""Stereolabs' SVO files, through their SDK: rectified pairs, with the calibration that goes with
them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2

from topoloc import (
    Camera,
    Image,
    MissingExtraError,
    RecordingError,
    Rigid3,
    StereoFrame,
    StereoRig,
    UnreadableImageError,
)
from topoloc.plugin import read_ground_truth

SVO_SUFFIXES = frozenset({".svo", ".svo2"})


@dataclass(eq=False)
class SvoRecording:
    """A StereoSequence in an SVO file. Frames are decoded in their order; to ask for another one
    seeks."""

    name: str
    path: Path
    t_ns: list[int]
    poses: list[Rigid3 | None]
    rig: StereoRig
    sdk: Any
    camera: Any
    with_right: bool = True
    names: list[str] = field(default_factory=list)
    # Of the frame that the SDK gives next; shared by all views of this recording.
    _position: list[int] = field(default_factory=lambda: [-1], repr=False)

    def __post_init__(self) -> None:
        self.names = [f"{index:06d}" for index in range(len(self.t_ns))]

    def __len__(self) -> int:
        return len(self.t_ns)

    def monocular(self) -> SvoRecording:
        """The same recording without the right pictures."""
        return replace(self, with_right=False)

    def __getitem__(self, index: int) -> StereoFrame:
        """Read one frame.

        Raises:
            IndexError: no such frame.
            UnreadableImageError: the SDK cannot decode it.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of a recording of {len(self)}")
        index %= len(self)
        if index != self._position[0]:
            self.camera.set_svo_position(index)
        if self.camera.grab() != self.sdk.ERROR_CODE.SUCCESS:
            self._position[0] = -1
            raise UnreadableImageError(f"{self.path}, frame {index}: cannot be decoded")
        self._position[0] = index + 1
        view = self.sdk.VIEW
        frame = StereoFrame(
            self.names[index],
            self.t_ns[index],
            self._retrieve_view(view.LEFT),
            self.rig.left,
            world_from_cam=self.poses[index],
        )
        return (
            replace(frame, right=self._retrieve_view(view.RIGHT), rig=self.rig)
            if self.with_right
            else frame
        )

    def _retrieve_view(self, view: Any) -> Image:
        return retrieve_image(self.sdk, self.camera, view)


def open_svo(path: Path) -> SvoRecording:
    """Open an SVO file. It is gone through once for its times. Truth is ``NAME.tum`` beside it.

    Raises:
        MissingExtraError: Stereolabs' SDK is not installed.
        RecordingError: the SDK cannot open it, or it has no frame.
    """
    try:
        sl = sdk("an SVO file")
    except MissingExtraError:
        raise MissingExtraError(
            f"{path}: SVO files need pyzed of Stereolabs' ZED SDK; without it export the rectified"
            " pairs on a machine that has it (its sample svo_export, mode 2) into left/ and right/"
            " with a camera.json"
        ) from None
    settings = sl.InitParameters()
    settings.set_from_svo_file(str(path))
    settings.svo_real_time_mode = False
    settings.depth_mode = sl.DEPTH_MODE.NONE
    settings.coordinate_units = sl.UNIT.METER
    camera = sl.Camera()
    status = camera.open(settings)
    if status != sl.ERROR_CODE.SUCCESS:
        raise RecordingError(f"{path}: the ZED SDK cannot open it ({status})")
    t_ns = []
    while camera.grab() == sl.ERROR_CODE.SUCCESS:
        t_ns.append(int(camera.get_timestamp(sl.TIME_REFERENCE.IMAGE).get_nanoseconds()))
    if not t_ns:
        raise RecordingError(f"{path}: no frame of it can be decoded")
    poses = read_ground_truth(path.with_suffix(".tum"), [], t_ns)
    return SvoRecording(path.name, path, t_ns, poses, rig_from_sdk(camera), sl, camera)


def sdk(what: str) -> Any:
    """Stereolabs' package. Raises MissingExtraError, which says that `what` needs it."""
    try:
        import pyzed.sl as sl  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise MissingExtraError(
            f"{what} needs pyzed of Stereolabs' ZED SDK, which is not installed"
        ) from None
    return sl


def retrieve_image(sdk: Any, camera: Any, view: Any) -> Image:
    """What a camera of the SDK saw last, RGB."""
    picture = sdk.Mat()
    camera.retrieve_image(picture, view)
    return cv2.cvtColor(picture.get_data(), cv2.COLOR_BGRA2RGB)


def rig_from_sdk(camera: Any) -> StereoRig:
    """Of the rectified pictures, which the SDK gives; metres."""
    configuration = camera.get_camera_information().camera_configuration
    parameters, size = configuration.calibration_parameters, configuration.resolution
    left = parameters.left_cam
    pinhole = Camera.pinhole(size.width, size.height, left.fx, left.fy, left.cx, left.cy)
    return StereoRig.rectified(pinhole, float(parameters.get_camera_baseline()))
