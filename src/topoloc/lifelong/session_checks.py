"""Check a session before it joins a map: its calibration against the points of the map, and that
the map does not contain it yet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from topoloc.errors import CalibrationError, DuplicateSessionError
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.lifelong.node_localization import sample_evenly
from topoloc.localization.image_calibration_check import check_camera_calibrations
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.mapping_frames import encode_place_image
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc.recordings.recording import find_source_path
from topoloc.retrieval.network_images import decode_stored_image

_NUM_QUERIES, _MIN_LOCALIZED = 7, 3
_FOCAL_LENGTH_RANGE = 1.5  # widens the range around the stated focal length, in both directions
_MAX_LOG_RATIO = math.log(1.04)


def check_calibration(name: str, results: Sequence[Localization | NotLocalized]) -> None:
    """Raise CalibrationError if the localization results of a session's images together contradict
    its calibration. The error begins with `name`."""
    for verdict in check_camera_calibrations(results):
        if verdict.is_contradicted:
            raise CalibrationError(
                f"{name}: its calibration is not that of its camera: {verdict}; the map stays as it"
                " is"
            )


def check_focal_length(
    sequence: StereoSequence, indices: Sequence[int], localizer: Localizer
) -> None:
    """Check if a session is localized better with another focal length than its own.

    The map localizes too few images of such a session. At most seven of the queried frames
    (`indices`) are localized again with the focal length free between 1/1.5 and 1.5 times the
    stated one. The check ends without an error if an image has no camera model.

    Raises:
        CalibrationError: at least three images agree on a focal length that differs by more than 4
            %.
        UnreadableImageError, QueryError: an image of the session cannot be read or localized.
    """
    tried, found, stated = sample_evenly(indices, _NUM_QUERIES), list[float](), 0.0
    for index in tried:
        frame = sequence[index]
        if (camera := frame.camera) is None:
            return
        stated = stated or camera.fx
        bounds = camera.fx / _FOCAL_LENGTH_RANGE, camera.fx * _FOCAL_LENGTH_RANGE
        uncalibrated = UncalibratedCamera(camera.width, camera.height, *bounds)
        result = localizer.localize(frame.image, uncalibrated)
        if isinstance(result, Localization) and result.focal_length_px is not None:
            found.append(math.log(result.focal_length_px / camera.fx))
    if len(found) < _MIN_LOCALIZED:
        return
    middle = float(np.median(found))
    agreeing = sum(abs(one - middle) < _MAX_LOG_RATIO for one in found)
    if abs(middle) > _MAX_LOG_RATIO and agreeing >= _MIN_LOCALIZED:
        lengths = f"{stated * math.exp(middle):.0f} pixels, not {stated:.0f}"
        raise CalibrationError(
            f"{sequence.name}: its calibration is not that of its camera: the map recognises"
            f" {agreeing} of {len(tried)} pictures where the focal length is about {lengths}; the"
            " map stays as it is"
        )


def check_session_is_new(topomap: TopoMetricMap, sequence: StereoSequence) -> None:
    """Check that a session is not in the map already.

    Names and times may also be those of another day. So the check compares images or file paths,
    too. Raises DuplicateSessionError.
    """
    if len(sequence) == 0:
        return
    times, path = (min(sequence.t_ns), max(sequence.t_ns)), find_source_path(sequence)
    for session in topomap.sessions:
        if session.name != sequence.name or session.start_ns is None or session.end_ns is None:
            continue
        if min(times[1], session.end_ns) < max(times[0], session.start_ns):
            continue
        is_same_path = path is not None and path == session.recording
        is_same_file = is_same_path and (session.start_ns, session.end_ns) == times
        if is_same_file or _has_same_images(topomap, session.session_id, sequence, is_same_path):
            raise DuplicateSessionError(
                f"{sequence.name}: it is in the map already, as session {session.session_id}; the"
                " map stays as it is"
            )


def _has_same_images(
    topomap: TopoMetricMap, session_id: int, sequence: StereoSequence, is_same_path: bool
) -> bool:
    """Return whether images of the same name are identical, according to the small images in the
    map.

    Of the same folder (`is_same_path`), other images of the same time span count as the same
    session, too. This covers selections such as every second frame, then the frames between.
    """
    rows = {name: index for index, name in enumerate(sequence.names)}
    kept = [image for image in topomap.place_images if image.session_id == session_id]
    common = [image for image in kept if image.name in rows]
    if not common:
        return is_same_path and bool(kept)
    for image in sample_evenly(common, 3):
        side_px = min(decode_stored_image(image.jpeg).shape[:2])
        picture = prepare_frame(sequence[rows[image.name]], False).picture
        if encode_place_image(picture, side_px) == image.jpeg:
            return True
    return False
