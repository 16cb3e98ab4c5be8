"""The figures of certificates and of quarters of difficulty as text, for prints and pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from topoloc.apps.core_names import Certificate, CertifiedCondition, CertifiedGroup, Quarter

QUARTER_COLUMNS = (
    "quarter by",
    "hardest to easiest",
    "poses",
    "right",
    "mean p",
    "inside 95 %",
    "median sigma",
)
_LIMITS = {
    "walk": "no walk with known poses: other light and changed things are not tested",
    "surroundings_removed": "each image shows most of the map: places beside it are not tested",
    "out_of_map": "no images of elsewhere (--out-of-map)",
}


def describe_condition(one: CertifiedCondition) -> str:
    """Return the figures of one condition."""
    text = f"{one.num_localized} of {one.num_images} images localized"
    if one.max_wrong_share is not None:
        text += (
            f", {one.num_wrong} wrong; {one.num_wrong_pieces} of {one.num_pieces}"
            f" independent ones wrong, at most {100 * one.max_wrong_share:.2g} %"
        )
    num_right = one.num_localized - one.num_wrong
    if one.kind == "walk" and one.has_truth and num_right:
        text += f"; {one.num_inside} of {num_right} right poses inside the 95 % ellipsoid"
    times = [f"answer {one.answer_ms:.0f} ms"] if one.answer_ms is not None else []
    times += [f"refusal {one.refusal_ms:.0f} ms"] if one.refusal_ms is not None else []
    return "; ".join([text, ", ".join(times)]) if times else text


def describe_group(group: CertifiedGroup) -> tuple[str, str]:
    """Return the group in words, and its promise."""
    unit = " deg" if group.by == "angle" else ""
    end = f"{unit} or more" if group.high is None else f" to {group.high:g}{unit}"
    name = f"{group.by} {group.low:g}{end}"
    share, at_threshold = group.max_wrong_share, group.threshold_wrong_share
    if share is None:
        return name, "no promise: the walks have no such image"
    beside = "" if group.min_probability is not None else "; no threshold makes it less"
    if at_threshold is not None and at_threshold < share:
        share_text = f"{100 * at_threshold:.2g} %"
        beside = f"; a threshold of {group.min_probability:.3g}, not applied, makes it {share_text}"
    return name, (
        f"at most {100 * share:.2g} % wrong (n = {group.num_pieces}); {group.num_localized} of"
        f" {group.num_images} images localized, {group.num_wrong} wrong{beside}"
    )


def describe_limits(certificate: Certificate) -> str:
    """Return which conditions the promise does not cover."""
    kinds = {one.kind for one in certificate.conditions if one.has_truth}
    lacking = [text for kind, text in _LIMITS.items() if kind not in kinds]
    return "; ".join([*lacking, "images unlike these are not covered"])


def quarter_cells(quarter: Quarter) -> tuple[str, ...]:
    """Return the figures of a quarter, in the order of `QUARTER_COLUMNS`."""
    digits, unit = {"inliers": (0, ""), "angle": (1, " deg"), "light": (2, "")}[quarter.by]
    return (
        quarter.by,
        f"{quarter.hardest:.{digits}f} to {quarter.easiest:.{digits}f}{unit}",
        str(quarter.num_poses),
        f"{100 * quarter.num_right / quarter.num_poses:.1f} %",
        f"{100 * quarter.mean_probability:.1f} %",
        f"{100 * quarter.num_inside / quarter.num_poses:.1f} %",
        f"{100 * quarter.median_position_sigma_m:.2f} cm,"
        f" {quarter.median_rotation_sigma_deg:.2f} deg",
    )
