"""A frame made ready for mapping: the view of it, and the pose of what that view's camera sees."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from topoloc.errors import RecordingError
from topoloc.geometry.rigid import Rigid3
from topoloc.sequences.frame import StereoFrame
from topoloc.sequences.frame_view import FrameView, frame_view


@dataclass(frozen=True, eq=False)
class MappingView(FrameView):
    """A view with the pose of its camera, which rectification may have turned."""

    world_from_cam: Rigid3 = field(kw_only=True)


def mapping_view(frame: StereoFrame, with_depth: bool = True) -> MappingView:
    """The view of a frame whose pose is known; see `frame_view`.

    Raises:
        CalibrationError: the frame has no camera.
        RecordingError: the frame has no pose, or neither a right picture nor depth.
    """
    view = frame_view(frame, with_depth)
    if frame.world_from_cam is None:
        raise RecordingError(f"{frame.name}: no pose")
    of_view = {item.name: getattr(view, item.name) for item in fields(FrameView)}
    return MappingView(**of_view, world_from_cam=frame.world_from_cam @ view.view_from_cam.inverse())
