"""Frames of a ZED that is plugged in: through Stereolabs' SDK, or without it as the side-by-side
USB camera that it is."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from topoloc import CalibrationError, RecordingError, StereoFrame, StereoRig
from topoloc.apps.formats.live import LiveSource
from topoloc.apps.formats.svo import retrieve_image, rig_from_sdk, sdk
from topoloc.apps.formats.zed import is_side_by_side, read_rig


def side_by_side_frames(source: LiveSource, calibration: Path) -> Iterator[StereoFrame]:
    """Both halves of each picture, as the sensors have them.

    Args:
        calibration: Stereolabs' SN*.conf, or a camera.json of one half with a baseline.

    Raises:
        RecordingError: the pictures are not two side by side, or the source stalls.
        CalibrationError: of another resolution than the halves, or not usable.
    """
    rig: StereoRig | None = None
    for picture in source:
        height, width = picture.image.shape[:2]
        if not is_side_by_side(width, height):
            raise RecordingError(
                f"{source.source}: {width}x{height} pixels are not two pictures side by side;"
                " --size asks the device for others"
            )
        if rig is None:
            rig = read_rig(calibration, (width // 2, height))
        if (rig.left.width, rig.left.height) != (width // 2, height):
            raise CalibrationError(
                f"{calibration}: of {rig.left.width}x{rig.left.height}, but each half is"
                f" {width // 2}x{height}"
            )
        left, right = (
            np.ascontiguousarray(half)
            for half in (picture.image[:, : width // 2], picture.image[:, width // 2 :])
        )
        yield StereoFrame(f"{picture.number:06d}", picture.t_ns, left, rig.left, right, rig)


def sdk_frames(stop: threading.Event) -> Iterator[StereoFrame]:
    """Rectified pairs of the first ZED that the SDK finds, until `stop` is set.

    Raises:
        MissingExtraError: Stereolabs' SDK is not installed.
        RecordingError: it finds no ZED, or the camera gives no more pictures.
    """
    sl = sdk("a ZED")
    settings = sl.InitParameters()
    settings.depth_mode, settings.coordinate_units = sl.DEPTH_MODE.NONE, sl.UNIT.METER
    camera: Any = sl.Camera()
    status = camera.open(settings)
    if status != sl.ERROR_CODE.SUCCESS:
        raise RecordingError(f"the ZED SDK can open no camera ({status})")
    try:
        rig, index, failed = rig_from_sdk(camera), 0, 0
        while not stop.is_set():
            if camera.grab() != sl.ERROR_CODE.SUCCESS:
                failed += 1
                if failed > 30:
                    raise RecordingError("the ZED gives no more pictures")
                continue
            t_ns = int(camera.get_timestamp(sl.TIME_REFERENCE.IMAGE).get_nanoseconds())
            left, right = (
                retrieve_image(sl, camera, view) for view in (sl.VIEW.LEFT, sl.VIEW.RIGHT)
            )
            yield StereoFrame(f"{index:06d}", t_ns, left, rig.left, right, rig)
            index, failed = index + 1, 0
    finally:
        camera.close()
