"""What a stream answers to each of its pictures: the picture's own pose, the smoothed one, and how
it was come by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.result import Localization, NotLocalized, pose_to_json

State = Literal["localized", "tracked", "predicted", "ambiguous", "lost"]


@dataclass(frozen=True, eq=False)
class StreamedPose:
    """The answer to one picture of a stream.

    `state` says what stands behind it: "localized", the picture was matched with the map;
    "tracked", points of the map were followed into it from the picture before; "predicted",
    neither, and `smoothed` is what the motion so far lets expect (by the paper's rule: a copy of
    the pose before); "ambiguous", the pictures so far leave open which of several poses it is, or
    say too little for one, and `result.alternatives` names them; "lost", no pose at all. In the
    first two states alone `result` is a `Localization`, the raw pose, and else it says why there is
    none. `smoothed` is world_from_cam as the whole stream up to this picture shows it;
    `smoothed_covariance` (6, 6) is of its left perturbation, order (translation, rotation), metres
    and radians. `is_repeated`: the same picture as the one before, whose answer this is.
    """

    t_ns: int
    state: State
    result: Localization | NotLocalized
    smoothed: Rigid3 | None = None
    smoothed_covariance: Float[np.ndarray, "6 6"] | None = None
    is_repeated: bool = False

    def to_json(self, query: str) -> dict[str, Any]:
        """One line of the result file, see docs/cli.md."""
        smoothed = None if self.smoothed is None else pose_to_json(self.smoothed)
        covariance = None if self.smoothed_covariance is None else self.smoothed_covariance.tolist()
        streamed = {
            "t_ns": self.t_ns,
            "state": self.state,
            "smoothed": smoothed,
            "smoothed_covariance": covariance,
        }
        return (
            self.result.to_json(query) | streamed | ({"repeated": True} if self.is_repeated else {})
        )
