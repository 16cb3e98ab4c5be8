"""Localize the images of a live camera, alone or as a stream. Images that arrive during a query are
skipped."""

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
    """Return the live source among the inputs. Raises UsageError: there are other inputs."""
    live = next((path for path in inputs if is_live(path)), None)
    if live is not None and len(inputs) > 1:
        raise UsageError(f"{live} is a live source, which must be the only input")
    return live


def localize_live(
    localizer: Localizer,
    tracker: Tracker | None,
    source: str,
    camera_of_size: CameraOfSize,
) -> Iterator[QueryAnswer]:
    """Yield results until the source ends or the process is interrupted. Raises RecordingError: the
    source does not respond or stalls."""
    with ExitStack() as stack:
        live = stack.enter_context(LiveSource(source))
        live.stop = stack.enter_context(catch_stop_signals())
        asked = 0
        for picture in live:
            yield _localize_image(localizer, tracker, picture, camera_of_size)
            asked += 1
        if not live.stop.is_set():
            print(
                f"warning: {source} ended after {live.num_read} images, {asked} were localized",
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
