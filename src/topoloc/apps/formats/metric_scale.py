"""The metric scale of a model from images only: a number, or measured distances of two cameras."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from topoloc import Rigid3, StereoSequence, TrajectoryError

_DISTANCE = re.compile(r"(?P<one>[^,=]+),(?P<other>[^,=]+)=\s*(?P<metres>[0-9.eE+-]+)\s*m?")
_SCALE_TOLERANCE = 0.05  # of the scale; larger than errors of a measuring tape
_MIN_DISTANCE = 1e-9


def estimate_metric_scale(texts: Sequence[str], sequence: StereoSequence) -> float:
    """Return the metres in a unit of the recording's poses.

    Args:
        texts: one number, or distances between the cameras of two images:
            ``IMG_0001.jpg,IMG_0042.jpg=3.2m``.

    Raises:
        TrajectoryError: a text is malformed, an image is missing or has no pose, or the distances
            do not agree.
    """
    if len(texts) == 1 and "=" not in texts[0]:
        return _positive_number(
            texts[0], f"a scale is a positive number, or IMAGE_A,IMAGE_B=3.2m, not {texts[0][:80]}"
        )
    units, metres = np.array([_units_and_metres(text, sequence) for text in texts]).T
    scales = metres / units
    scale = float(units @ metres / (units @ units))
    worst = int(np.abs(np.log(scales / scale)).argmax())
    if scales.max() > (1.0 + _SCALE_TOLERANCE) * scales.min():
        details = ", ".join(
            f"{text} makes a unit {one:.4g} m" for text, one in zip(texts, scales, strict=True)
        )
        raise TrajectoryError(
            f"{sequence.name}: the distances do not agree: {details}; the worst is {texts[worst]}"
        )
    return scale


def _units_and_metres(text: str, sequence: StereoSequence) -> tuple[float, float]:
    match = _DISTANCE.fullmatch(text.strip())
    if match is None:
        raise TrajectoryError(
            f"{text[:80]!r} is no distance between two images, such as IMAGE_A,IMAGE_B=3.2m"
        )
    metres = _positive_number(match["metres"], f"{text[:80]!r}: the distance must be above 0 m")
    one, other = (_find_pose(match[name].strip(), sequence) for name in ("one", "other"))
    units = float(np.linalg.norm(one.translation - other.translation))
    if units < _MIN_DISTANCE:
        raise TrajectoryError(f"{text[:80]!r}: both images have the same position")
    return units, metres


def _find_pose(name: str, sequence: StereoSequence) -> Rigid3:
    """Find an image by its name, else by its file name with or without suffix."""
    names = sequence.names
    rows = [row for row, other in enumerate(names) if other == name] or [
        row for row, other in enumerate(map(PurePath, names)) if name in (other.name, other.stem)
    ]
    if len(rows) != 1:
        raise TrajectoryError(f"{sequence.name}: {len(rows)} images are named {name[:80]}")
    pose = sequence.poses[rows[0]]
    if pose is None:
        raise TrajectoryError(f"{sequence.name}: {name[:80]} has no pose")
    return pose


def _positive_number(text: str, message: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise TrajectoryError(message)
    return number
