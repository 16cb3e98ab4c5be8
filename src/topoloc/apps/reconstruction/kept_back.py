"""Test a map of photos with runs of its own images: each is localized while the nodes of its run
are hidden."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from topoloc import Localization, Localizer, StereoSequence, TopoMetricMap
from topoloc.apps.core_names import read_left_frame, sample_evenly

_RUN, _NUM_RUNS = 10, 3  # images in a row, and such runs in a recording
_MAX_SHARE = 0.3  # of a recording's images in one run
_MAX_ERRORS = 0.5, 10.0  # metres (units without scale), degrees: further off is another place
_MIN_LOCALIZED = 0.8


def check_kept_back(
    topomap: TopoMetricMap,
    sequences: Sequence[StereoSequence],
    tell: Callable[[str], object] | None,
    warn: Callable[[str], object],
) -> None:
    """Localize runs of images without their nodes, and compare the poses with theirs. `tell` is
    called with the figures, `warn` if many images are lost or one is elsewhere. Raises
    RecordingError, UnreadableImageError: a frame cannot be read."""
    localizer, errors, num = Localizer(topomap), list[tuple[float, float]](), 0
    for session_id, sequence in enumerate(sequences):
        posed = [row for row, pose in enumerate(sequence.poses) if pose is not None]
        length = min(_RUN, int(_MAX_SHARE * len(posed)))
        starts = range(0, len(posed) - length + 1, max(length, 1)) if length else ()
        for start in sample_evenly(starts, _NUM_RUNS):
            rows = posed[start : start + length]
            names = {sequence.names[row] for row in rows}
            hidden = [
                one.node_id
                for one in topomap.summaries
                if one.session_id == session_id and one.name in names
            ]
            if len(hidden) == len(topomap.summaries):
                continue
            num += len(rows)
            errors += _localize(localizer.without(hidden), sequence, rows)
    if not num:
        return
    metres, degrees = np.array(errors).reshape(-1, 2).T
    wrong = int(np.count_nonzero((metres > _MAX_ERRORS[0]) | (degrees > _MAX_ERRORS[1])))
    text = f"{sequences[0].name}: {len(errors)} of {num} images localized without their run's nodes"
    if errors:
        median, unit = float(np.median(metres)), "units"
        if topomap.config.has_scale:
            median, unit = 100.0 * median, "cm"
        text += f", {median:.2g} {unit}, {np.median(degrees):.2f} deg in the median"
    if wrong or len(errors) < _MIN_LOCALIZED * num:
        fault = f"{wrong} at another place: places may look alike" if wrong else "few"
        warn(f"{text}; {fault}; add images, and evaluate the map with others before it is used")
    elif tell is not None:
        tell(text)


def _localize(
    localizer: Localizer, sequence: StereoSequence, rows: Sequence[int]
) -> list[tuple[float, float]]:
    """Return the errors (metres, degrees) of the localized ones of these frames."""
    errors = list[tuple[float, float]]()
    for row in rows:
        frame = read_left_frame(sequence, row)
        result = localizer.localize(frame.image, frame.camera)
        if isinstance(result, Localization) and frame.world_from_cam is not None:
            step = frame.world_from_cam.inverse() @ result.world_from_cam
            metres = float(np.linalg.norm(step.translation))
            errors.append((metres, float(np.rad2deg(step.angle()))))
    return errors
