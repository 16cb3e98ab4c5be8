"""Answers to a camera that runs now: each picture alone, or as the next of a stream; what it shows
meanwhile is left out."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack

from topoloc import CalibrationError, Localizer, Tracker, UncalibratedCamera
from topoloc.apps.cli.output import UsageError, catch_stop_signals
from topoloc.apps.cli.queries.query_answers import QueryAnswer
from topoloc.apps.formats.live import LiveImage, LiveSource, is_live
from topoloc.apps.query_camera import CameraOfSize

NEEDS_CALIBRATION = (
    "a stream needs a calibration: --camera FILE, --camera fx,fy,cx,cy or --camera map; or --single"
)


def find_live_input(inputs: tuple[str, ...]) -> str | None:
    """The live source among the inputs. Raises UsageError: it is not the only one."""
    live = next((path for path in inputs if is_live(path)), None)
    if live is not None and len(inputs) > 1:
        raise UsageError(f"{live} is a live source, which is asked alone")
    return live


def localize_live(
    localizer: Localizer,
    tracker: Tracker | None,
    source: str,
    camera_of_size: CameraOfSize,
) -> Iterator[QueryAnswer]:
    """Answers until the source ends, or Ctrl-C or SIGTERM come. Raises RecordingError where it does
    not answer, or stalls."""
    with ExitStack() as stack:
        live = stack.enter_context(LiveSource(source))
        live.stop = stack.enter_context(catch_stop_signals())
        asked = 0
        for picture in live:
            yield _localize_image(localizer, tracker, picture, camera_of_size)
            asked += 1
        if not live.stop.is_set():
            print(
                f"warning: {source} ended after {live.num_read} pictures, {asked} of them asked",
                file=sys.stderr,
            )


def _localize_image(
    localizer: Localizer,
    tracker: Tracker | None,
    picture: LiveImage,
    camera_of_size: CameraOfSize,
) -> QueryAnswer:
    height, width = picture.image.shape[:2]
    name, camera = f"{picture.number:06d}", camera_of_size(width, height)
    if tracker is None:
        return QueryAnswer(
            name, picture.t_ns, localizer.localize(picture.image, camera, t_ns=picture.t_ns)
        )
    if isinstance(camera, UncalibratedCamera):
        raise CalibrationError(NEEDS_CALIBRATION)
    streamed = tracker.process(picture.image, camera, picture.t_ns)
    return QueryAnswer(name, picture.t_ns, streamed.result, streamed)
