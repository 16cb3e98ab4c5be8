"""Is a session's calibration that of its camera? The map's points that its pictures show say so."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from topoloc.errors import CalibrationError
from topoloc.geometry.rough_camera import RoughCamera
from topoloc.lifelong.left_out import evenly
from topoloc.localization.calibration_doubt import verdicts_of
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.recordings.frame import StereoSequence

_NUM_TRIED, _LEAST_FOUND = 7, 3
_RANGE = 1.5  # times the focal length that is said
_FAR_OFF = math.log(1.04)


def check_calibration(name: str, results: Sequence[Localization | NotLocalized]) -> None:
    """Hold that what the pictures say together does not contradict the calibration that they came
    with. Raises CalibrationError."""
    wrong = next((verdict for verdict in verdicts_of(results) if verdict.contradicts), None)
    if wrong is not None:
        raise CalibrationError(
            f"{name}: its calibration is not that of its camera: {wrong}; the map stays as it is"
        )


def check_by_other_focal_lengths(
    sequence: StereoSequence, indices: Sequence[int], localizer: Localizer
) -> None:
    """Of a session that the map recognises too little of: hold that it is not recognised where its
    focal length is left open.

    Args:
        indices: the frames that were asked, of which a few are asked once more.

    Raises:
        CalibrationError: the pictures agree on another focal length.
        UnreadableImageError, QueryError: from its pictures.
    """
    tried, found = evenly(indices, _NUM_TRIED), list[float]()
    for index in tried:
        frame = sequence[index]
        if frame.camera is None:
            return
        camera = frame.camera
        rough = RoughCamera(camera.width, camera.height, camera.fx / _RANGE, camera.fx * _RANGE)
        result = localizer.localize(frame.image, rough)
        if isinstance(result, Localization) and result.focal_length_px is not None:
            found.append(math.log(result.focal_length_px / camera.fx))
    if len(found) < _LEAST_FOUND:
        return
    middle = float(np.median(found))
    agreeing = sum(abs(one - middle) < _FAR_OFF for one in found)
    if abs(middle) > _FAR_OFF and agreeing >= _LEAST_FOUND:
        said = sequence[tried[0]].camera
        assert said is not None, "it was asked"
        lengths = f"{said.fx * math.exp(middle):.0f} pixels, not {said.fx:.0f}"
        raise CalibrationError(
            f"{sequence.name}: its calibration is not that of its camera: the map recognises"
            f" {agreeing} of {len(tried)} pictures where the focal length is about {lengths}; the"
            " map stays as it is"
        )
