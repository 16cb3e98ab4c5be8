"""Select the camera model of a query image: from `--camera`, the recording or the image file."""

from __future__ import annotations

from collections.abc import Callable

from topoloc import Camera, QueryError, StereoFrame, TopoMetricMap, UncalibratedCamera
from topoloc.apps.core_names import parse_calibration

CameraOfSize = Callable[[int, int], Camera | UncalibratedCamera]
"""A function from image width and height to a camera model."""


def select_frame_camera(
    frame: StereoFrame, of_size: CameraOfSize | None
) -> Camera | UncalibratedCamera:
    """Return the camera of an image.

    The order is: `--camera`, the recording's calibration, the focal length in the EXIF data,
    unknown.
    """
    height, width = frame.image.shape[:2]
    if of_size is not None:
        return of_size(width, height)
    if frame.camera is not None:
        return frame.camera
    return UncalibratedCamera.from_focal_guess(width, height, frame.exif_focal_px)


def parse_camera_option(
    text: str, topomap: TopoMetricMap | None, allow_files: bool = True
) -> CameraOfSize:
    """Parse the value of `--camera`. `map` is allowed only if a single map is queried. Raises
    CalibrationError: the value is invalid.

    Args:
        allow_files: read the calibration from a file of that name; if not, the text must be
            ``map``, ``unknown`` or ``fx,fy,cx,cy`` (pixels).
    """
    if text == "map" and topomap is not None:
        raw = topomap.sessions[0].camera if topomap.sessions else None
        return _rescaled_camera(raw or topomap.nodes[0].camera)
    if text == "unknown":
        return UncalibratedCamera.unknown
    calibration = parse_calibration(text, allow_files)
    return lambda width, height: calibration(width, height).camera


def _rescaled_camera(camera: Camera) -> CameraOfSize:
    def of_size(width: int, height: int) -> Camera:
        if abs(width * camera.height - height * camera.width) > max(
            camera.width, camera.height
        ):  # more than one pixel of rounding
            raise QueryError(
                f"the image is {width}x{height}, the map's camera {camera.width}x{camera.height}:"
                " not of one shape"
            )
        return camera.rescaled(width, height)

    return of_size
