"""Check the calibration of a session's camera against the points of the map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from topoloc.errors import CalibrationError
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.lifelong.leave_one_out import sample_evenly
from topoloc.localization.image_calibration_check import check_camera_calibrations
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame import StereoSequence

_NUM_QUERIES, _MIN_LOCALIZED = 7, 3
_FOCAL_LENGTH_RANGE = 1.5  # widens the range around the stated focal length, in both directions
_MAX_LOG_RATIO = math.log(1.04)


def check_calibration(name: str, results: Sequence[Localization | NotLocalized]) -> None:
    """Check a session's calibration against the localization results of its images.

    Args:
        name: the session's name, for the error message.
        results: the localization results of the session's images.

    Raises:
        CalibrationError: the results together contradict the calibration.
    """
    wrong = next(
        (verdict for verdict in check_camera_calibrations(results) if verdict.is_contradicted), None
    )
    if wrong is not None:
        raise CalibrationError(
            f"{name}: its calibration is not that of its camera: {wrong}; the map stays as it is"
        )


def check_focal_length(
    sequence: StereoSequence, indices: Sequence[int], localizer: Localizer
) -> None:
    """Check if a session is localized better with another focal length than its own.

    The map localizes too few images of such a session. A few of them are localized again with the
    focal length free between 1/1.5 and 1.5 times the stated one. The check ends without an error if
    an image has no camera model.

    Args:
        sequence: the session.
        indices: the frames that were queried. At most seven of them, evenly spread, are localized
            again.
        localizer: the localizer of the map.

    Raises:
        CalibrationError: at least three images agree on a focal length that differs by more than 4
            %.
        UnreadableImageError, QueryError: an image of the session cannot be read or localized.
    """
    tried, found = sample_evenly(indices, _NUM_QUERIES), list[float]()
    for index in tried:
        frame = sequence[index]
        if frame.camera is None:
            return
        camera = frame.camera
        uncalibrated = UncalibratedCamera(
            camera.width,
            camera.height,
            camera.fx / _FOCAL_LENGTH_RANGE,
            camera.fx * _FOCAL_LENGTH_RANGE,
        )
        result = localizer.localize(frame.image, uncalibrated)
        if isinstance(result, Localization) and result.focal_length_px is not None:
            found.append(math.log(result.focal_length_px / camera.fx))
    if len(found) < _MIN_LOCALIZED:
        return
    middle = float(np.median(found))
    agreeing = sum(abs(one - middle) < _MAX_LOG_RATIO for one in found)
    if abs(middle) > _MAX_LOG_RATIO and agreeing >= _MIN_LOCALIZED:
        stated = sequence[tried[0]].camera
        assert stated is not None, "checked above"
        lengths = f"{stated.fx * math.exp(middle):.0f} pixels, not {stated.fx:.0f}"
        raise CalibrationError(
            f"{sequence.name}: its calibration is not that of its camera: the map recognises"
            f" {agreeing} of {len(tried)} pictures where the focal length is about {lengths}; the"
            " map stays as it is"
        )
