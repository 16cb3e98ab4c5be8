"""Hold what `topoloc certify` measured of a map, and the promise that follows from it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, to_builtins

from topoloc.json_data import Count, NonNegative

ConditionKind = Literal["walk", "surroundings_removed", "out_of_map"]
Difficulty = Literal["inliers", "angle", "light"]
GroupKind = Literal["angle", "light"]
_Share = Annotated[float, Meta(ge=0, le=1)]
_Text = Annotated[str, Meta(max_length=1000)]


class CertifiedCondition(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the figures of images of one condition.

    - `has_truth` is False for a walk without known poses: nothing says which answers are wrong.
    - `num_pieces` counts independent pieces of the trajectory, `num_wrong_pieces` those with a
      wrong answer, at the certificate's threshold. `max_wrong_share` is the upper confidence bound
      of their share, None without truth.
    - `num_inside` counts right answers whose true pose is inside the 95 % ellipsoid.
    - Times are medians of the milliseconds of answers and refusals, None if there are none.
    """

    name: _Text
    kind: ConditionKind
    has_truth: bool
    num_images: Count
    num_pieces: Count
    num_localized: Count
    num_wrong: Count
    num_wrong_pieces: Count
    max_wrong_share: _Share | None
    num_inside: Count
    answer_ms: NonNegative | None
    refusal_ms: NonNegative | None


class Quarter(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the figures of a quarter of the poses with a known truth, ordered by difficulty.

    - `by` is `inliers`, `angle` (degrees between the image and the nearest node by Eq. 1) or
      `light` (the largest ratio, 1 or more, of the mean grey level, red over green and blue over
      green of the image and the likest node there). `hardest` and `easiest` are its extremes.
    - `num_right` counts poses within 0.25 m and 2 degrees, `num_inside` those whose true pose is
      inside the 95 % ellipsoid.
    """

    by: Difficulty
    hardest: NonNegative
    easiest: NonNegative
    num_poses: Count
    num_right: Count
    mean_probability: _Share
    num_inside: Count
    median_position_sigma_m: NonNegative
    median_rotation_sigma_deg: NonNegative


class CertifiedGroup(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold the promise about images of walks whose `by` (as of `Quarter`) is from `low` to below
    `high`, None: without end. The other fields are those of `Certificate` and its conditions."""

    by: GroupKind
    low: NonNegative
    high: NonNegative | None
    num_images: Count
    num_pieces: Count
    num_localized: Count
    num_wrong: Count
    max_wrong_share: _Share | None
    min_probability: _Share | None
    threshold_wrong_share: _Share | None


class Certificate(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold a promise about the answers of a map, with the conditions in which it was measured.

    - `map_version` is the number of the edit that stored it. `settings` names the settings that
      were not the default, `cameras` the cameras of the images.
    - `max_wrong_share` is the promise: with probability `confidence`, at most this share of
      independent images like these gets a wrong pose. None if no image had a known pose. It and the
      conditions count the answers as the map gives them.
    - `min_probability` is the threshold of the probability that keeps the requested share. None if
      no threshold below 1 does. Answers below it are refused only if `is_applied`.
    - `lost_share` is the share of right answers that the threshold refuses, or would refuse, and
      `threshold_wrong_share` the promise with it. The latter is None in certificates of older
      versions: all their figures are at the threshold.
    - `quarters` are those of the walks by difficulty, `groups` promises for groups of their images.
    """

    map_version: Count
    program: _Text
    date: _Text
    settings: dict[str, Any]
    cameras: list[_Text]
    confidence: _Share
    max_wrong_share: _Share | None
    requested_share: _Share
    min_probability: _Share | None
    lost_share: _Share
    is_applied: bool
    conditions: list[CertifiedCondition]
    threshold_wrong_share: _Share | None = None
    quarters: list[Quarter] = []
    groups: list[CertifiedGroup] = []

    @property
    def applied_min_probability(self) -> float:
        """Return the probability below which the map's answers are refused, 0 if not applied."""
        return (self.min_probability or 0.0) if self.is_applied else 0.0

    def is_outdated(self, map_version: int) -> bool:
        """Return whether the map was edited since."""
        return map_version != self.map_version

    def to_json(self) -> dict[str, Any]:
        """Return the certificate as a JSON object."""
        return to_builtins(self)

    def promise(self) -> str:
        """Return the promise as a sentence."""
        if self.max_wrong_share is None:
            return "no promise: no image with a known pose was localized, and none out of the map"
        kinds = {one.kind for one in self.conditions if one.has_truth}
        named = [text for kind, text in _CONDITIONS.items() if kind in kinds]
        num_pieces = sum(one.num_pieces for one in self.conditions if one.has_truth)
        level, is_older = "", self.threshold_wrong_share is None
        if self.min_probability is not None and (self.is_applied or is_older):
            level = f" at a probability of at least {self.min_probability:.3g}"
        return (
            f"of independent images like these ({', '.join(named)}), at most"
            f" {100 * self.max_wrong_share:.2g} % get a wrong pose{level}, with"
            f" {100 * self.confidence:g} % confidence (n = {num_pieces})"
        )

    def describe_threshold(self) -> str:
        """Return the threshold, whether it is applied, and what it promises and loses, as text."""
        lost = f"{100 * self.lost_share:.1f} % of the right answers"
        if self.min_probability is None:
            return f"none keeps {100 * self.requested_share:.2g} %: wrong answers have p = 1"
        if self.is_applied:
            return f"{self.min_probability:.3g}, applied; it refuses {lost}"
        text = f"{self.min_probability:.3g}, not applied (topoloc certify --apply)"
        if self.threshold_wrong_share is None:
            return f"{text}; it would refuse {lost}"
        share = f"{100 * self.threshold_wrong_share:.2g} %"
        return f"{text}; with it at most {share} would be wrong, and {lost} refused"


_CONDITIONS: dict[ConditionKind, str] = {
    "walk": "walks through the place",
    "surroundings_removed": "places beside the map",
    "out_of_map": "images of elsewhere",
}
