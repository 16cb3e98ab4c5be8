"""What is known of a query picture's camera: what `--camera` says, its recording, or its file."""

from __future__ import annotations

from collections.abc import Callable

from topoloc.errors import QueryError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.calibration import calibration_of
from topoloc.recordings.frame import StereoFrame

CameraOfSize = Callable[[int, int], Camera | RoughCamera]
"""The camera of a picture of this width and height."""


def camera_of_frame(frame: StereoFrame, of_size: CameraOfSize | None) -> Camera | RoughCamera:
    """What `--camera` says, else the recording; else what the picture's file says of its focal
    length, or nothing."""
    height, width = frame.image.shape[:2]
    if of_size is not None:
        return of_size(width, height)
    if frame.camera is not None:
        return frame.camera
    return (
        RoughCamera.unknown(width, height)
        if frame.noted_focal is None
        else RoughCamera.noted(width, height, frame.noted_focal)
    )


def named_camera(text: str, topomap: TopoMetricMap | None) -> CameraOfSize:
    """What `--camera` says; `map` only where one map is asked. Raises CalibrationError."""
    if text == "map" and topomap is not None:
        return _rescaled(topomap.nodes[0].camera)
    if text == "unknown":
        return RoughCamera.unknown
    calibration = calibration_of(text)
    return lambda width, height: calibration(width, height).camera


def _rescaled(camera: Camera) -> CameraOfSize:
    def of_size(width: int, height: int) -> Camera:
        if abs(width * camera.height - height * camera.width) > max(
            camera.width, camera.height
        ):  # more than a pixel's rounding
            raise QueryError(
                f"the image is {width}x{height}, the map's camera {camera.width}x{camera.height}:"
                " not of one shape"
            )
        return camera.rescaled(width, height)

    return of_size
