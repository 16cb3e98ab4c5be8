"""Result of one image of a stream: its own pose, the smoothed pose and their source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from topoloc.geometry.rigid import Rigid3
from topoloc.json_data import OneLine
from topoloc.localization.result import Localization, NotLocalized

State = Literal["localized", "tracked", "predicted", "ambiguous", "lost"]


@dataclass(frozen=True, eq=False, repr=False)
class StreamedPose(OneLine):
    """Hold the result of one image of a stream.

    Attributes:
        t_ns: capture time, nanoseconds.
        state: source of the pose, see below.
        result: the raw pose, a `Localization` in the states "localized" and "tracked". Otherwise
            the reason for none.
        smoothed: smoothed world_from_cam, from the whole stream up to this image.
        smoothed_covariance: covariance (6, 6) of its left perturbation, order (translation,
            rotation), metres and radians.
        is_repeated: True if the image equals the preceding one. It is no evidence, and after a
            second the camera is lost, unless `is_confirmed`.
        is_confirmed: True if such an image shows that the camera stands, see
            `tracking/repeated_images.py`. It has the result of the preceding one.
        track: number of the hypothesis that the pose is of, None if there is none. Poses of one
            track continue each other by the motion of the stream.

    The states are:

    - "localized": the image was matched with the map.
    - "tracked": map points were tracked from the preceding image.
    - "predicted": neither. `smoothed` is extrapolated from the motion, or copied in mode "paper".
    - "ambiguous": several poses remain, or one with too little weight. `result.alternatives` holds
      them.
    - "lost": no pose.
    """

    t_ns: int
    state: State
    result: Localization | NotLocalized
    smoothed: Rigid3 | None = None
    smoothed_covariance: Float[np.ndarray, "6 6"] | None = None
    is_repeated: bool = False
    is_confirmed: bool = False
    track: int | None = None

    @property
    def is_measured(self) -> bool:
        """Return whether the pose is evidence: matched, or tracked, in an image that is no old one
        sent again."""
        is_old = self.is_repeated and not self.is_confirmed
        return isinstance(self.result, Localization) and not is_old

    def to_json(self, query: str) -> dict[str, Any]:
        """Return one line of the result file, see docs/cli.md."""
        smoothed = None if self.smoothed is None else self.smoothed.to_json()
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
