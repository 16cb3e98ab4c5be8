"""Hold what `topoloc certify` measured of a map, and the promise that follows from it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct, to_builtins

from topoloc.json_data import Count, NonNegative

ConditionKind = Literal["walk", "surroundings_removed", "out_of_map"]
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

    def describe(self) -> str:
        """Return the figures as text."""
        text = f"{self.num_localized} of {self.num_images} images localized"
        if self.max_wrong_share is not None:
            text += (
                f", {self.num_wrong} wrong; {self.num_wrong_pieces} of {self.num_pieces}"
                f" independent ones wrong, at most {100 * self.max_wrong_share:.2g} %"
            )
        num_right = self.num_localized - self.num_wrong
        if self.kind == "walk" and self.has_truth and num_right:
            text += f"; {self.num_inside} of {num_right} right poses inside the 95 % ellipsoid"
        times = [f"answer {self.answer_ms:.0f} ms"] if self.answer_ms is not None else []
        times += [f"refusal {self.refusal_ms:.0f} ms"] if self.refusal_ms is not None else []
        return "; ".join([text, ", ".join(times)]) if times else text


class Certificate(Struct, frozen=True, forbid_unknown_fields=True):
    """Hold a promise about the answers of a map, with the conditions in which it was measured.

    - `map_version` is the number of the edit that stored it. `settings` names the settings that
      were not the default, `cameras` the cameras of the images.
    - `max_wrong_share` is the promise: with probability `confidence`, at most this share of
      independent images like these gets a wrong pose. None if no image had a known pose.
    - `min_probability` is the threshold of the probability that keeps the promise. None if no
      threshold below 1 does. Answers below it are refused only if `is_applied`.
    - `lost_share` is the share of right answers that the threshold refuses.
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
        if self.min_probability is None:
            threshold = "at any threshold"
        else:
            threshold = f"at a probability of at least {self.min_probability:.3g}"
        return (
            f"of independent images like these ({', '.join(named)}), at most"
            f" {100 * self.max_wrong_share:.2g} % get a wrong pose {threshold}, with"
            f" {100 * self.confidence:g} % confidence (n = {num_pieces})"
        )

    def limits(self) -> str:
        """Return what the promise does not cover."""
        kinds = {one.kind for one in self.conditions if one.has_truth}
        lacking = [text for kind, text in _LIMITS.items() if kind not in kinds]
        return "; ".join([*lacking, "images unlike these are not covered"])


_LIMITS: dict[ConditionKind, str] = {
    "walk": "no walk with known poses: other light and changed things are not tested",
    "surroundings_removed": "each image shows most of the map: places beside it are not tested",
    "out_of_map": "no images of elsewhere (--out-of-map)",
}
_CONDITIONS: dict[ConditionKind, str] = {
    "walk": "walks through the place",
    "surroundings_removed": "places beside the map",
    "out_of_map": "images of elsewhere",
}
