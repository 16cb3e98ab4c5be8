"""Rectified stereo of Stereolabs' SDK: SVO files and connected ZED cameras."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Iterator
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
from topoloc.plugin import IndexedFrames, read_ground_truth

SVO_SUFFIXES = frozenset({".svo", ".svo2"})


@dataclass(eq=False, repr=False)
class SvoRecording(IndexedFrames):
    """A StereoSequence in an SVO file. Access out of order seeks."""

    name: str
    path: Path
    t_ns: list[int]
    poses: list[Rigid3 | None]
    rig: StereoRig
    sdk: Any
    camera: Any
    with_right: bool = True
    names: list[str] = field(default_factory=list)
    # Index of the SDK's next frame, shared by all views of this recording.
    _position: list[int] = field(default_factory=lambda: [-1], repr=False)

    def __post_init__(self) -> None:
        self.names = [f"{index:06d}" for index in range(len(self.t_ns))]

    def __len__(self) -> int:
        return len(self.t_ns)

    def monocular(self) -> SvoRecording:
        """Return the recording without the right images."""
        return replace(self, with_right=False)

    def read_frame(self, row: int) -> StereoFrame:
        """Read one frame. Raises UnreadableImageError: the SDK cannot decode it."""
        if row != self._position[0]:
            self.camera.set_svo_position(row)
        if self.camera.grab() != self.sdk.ERROR_CODE.SUCCESS:
            self._position[0] = -1
            raise UnreadableImageError(f"{self.path}, frame {row}: cannot be decoded")
        self._position[0] = row + 1
        frame = _retrieve_frame(self.sdk, self.camera, row, self.rig, self.with_right)
        return replace(frame, t_ns=self.t_ns[row], world_from_cam=self.poses[row])


def open_svo(path: Path) -> SvoRecording:
    """Open an SVO file and read its times. Truth is ``NAME.tum`` beside it. Raises
    MissingExtraError: Stereolabs' SDK is not installed; RecordingError: the SDK cannot open the
    file, or it has no frame."""
    hint = (
        "; or export the rectified pairs on a machine with the SDK (its sample svo_export, mode 2)"
        " to left/ and right/ with a camera.json"
    )
    sl, camera = _open_camera(path, hint)
    t_ns = []
    while camera.grab() == sl.ERROR_CODE.SUCCESS:
        t_ns.append(_time_ns(sl, camera))
    if not t_ns:
        raise RecordingError(f"{path}: no frame of it can be decoded")
    poses = read_ground_truth(path.with_suffix(".tum"), [], t_ns)
    return SvoRecording(path.name, path, t_ns, poses, rig_from_sdk(camera), sl, camera)


def sdk_frames(stop: threading.Event) -> Iterator[StereoFrame]:
    """Yield rectified pairs of the first connected ZED until `stop` is set. Raises
    MissingExtraError: Stereolabs' SDK is not installed; RecordingError: there is no ZED, or it
    gives no more images."""
    sl, camera = _open_camera(None)
    try:
        rig, index, failed = rig_from_sdk(camera), 0, 0
        while not stop.is_set():
            if camera.grab() != sl.ERROR_CODE.SUCCESS:
                failed += 1
                if failed > 30:
                    raise RecordingError("the ZED gives no more images")
                continue
            yield _retrieve_frame(sl, camera, index, rig)
            index, failed = index + 1, 0
    finally:
        camera.close()


def _open_camera(path: Path | None, hint: str = "") -> tuple[Any, Any]:
    """Return the SDK and an open SVO file, or the first connected camera if `path` is None."""
    source = "a ZED" if path is None else path
    need = f"{source} needs pyzed of Stereolabs' ZED SDK, which is not installed{hint}"
    try:
        sl: Any = importlib.import_module("pyzed.sl")
    except ImportError:
        raise MissingExtraError(need) from None
    settings = sl.InitParameters()
    if path is not None:
        settings.set_from_svo_file(str(path))
        settings.svo_real_time_mode = False
    settings.depth_mode, settings.coordinate_units = sl.DEPTH_MODE.NONE, sl.UNIT.METER
    camera = sl.Camera()
    status = camera.open(settings)
    if status != sl.ERROR_CODE.SUCCESS:
        raise RecordingError(f"the ZED SDK cannot open {source} ({status})")
    return sl, camera


def _retrieve_frame(
    sdk: Any, camera: Any, index: int, rig: StereoRig, with_right: bool = True
) -> StereoFrame:
    """Return the images that the SDK has grabbed."""

    def retrieve(view: Any) -> Image:
        image = sdk.Mat()
        camera.retrieve_image(image, view)
        return cv2.cvtColor(image.get_data(), cv2.COLOR_BGRA2RGB)

    left = retrieve(sdk.VIEW.LEFT)
    frame = StereoFrame(f"{index:06d}", _time_ns(sdk, camera), left, rig.left)
    return replace(frame, right=retrieve(sdk.VIEW.RIGHT), rig=rig) if with_right else frame


def _time_ns(sdk: Any, camera: Any) -> int:
    return int(camera.get_timestamp(sdk.TIME_REFERENCE.IMAGE).get_nanoseconds())


def rig_from_sdk(camera: Any) -> StereoRig:
    """Return the rig of the rectified images; metres."""
    configuration = camera.get_camera_information().camera_configuration
    parameters, size = configuration.calibration_parameters, configuration.resolution
    left = parameters.left_cam
    pinhole = Camera.pinhole(size.width, size.height, left.fx, left.fy, left.cx, left.cy)
    return StereoRig.rectified(pinhole, float(parameters.get_camera_baseline()))
