"""What the demo says of its own results, on the terminal and in the report: computed, so that it
stays true whatever comes out."""

from __future__ import annotations

from typing import Any

from topoloc import EvaluatedQuery
from topoloc.apps.report.report_tables import PublishedResult, ReportTexts

PAPER_LAB = ("the paper's Lab, by day", 0.0202, 0.35)
DAY, NIGHT = "day", "night"
_ABOUT = {
    "day": "a third lap, the light of the map",
    "night": "no daylight, few lamps, chairs and things moved",
    "other camera": "one camera, a lens 1.4 times as long, 800x600; things moved",
    "elsewhere": "another building, a street, pictures of nothing at all",
}


def create_report_texts(evaluation: dict[str, Any]) -> ReportTexts:
    """The words of the demo's report."""
    m = evaluation["map"]
    return ReportTexts(
        title="One room, mapped by day: what does it know by night?",
        subtitle=(
            f"A lab of 5 x 4 m, walked through twice with a stereo camera ({m['length_m']:.0f} m,"
            f" {m['num_nodes']} nodes, {m['bytes'] / 1e6:.1f} MB). Each query is one picture,"
            " alone."
        ),
        paragraphs=[describe_night(evaluation), describe_out_of_map(evaluation), _RENDERED],
        about=_ABOUT,
        published=[PublishedResult(*PAPER_LAB)],
    )


_RENDERED = (
    "The lab is rendered, so that every true pose is known exactly: its camera has noise,"
    " vignetting and an exposure that is never quite right, but no error of calibration. The"
    " paper's figure is from a real room of about this size, so it says what scale to expect, not"
    " who is better."
)


def describe_night(evaluation: dict[str, Any]) -> str:
    """What the night costs against the day."""
    rows = {row["name"]: row for row in evaluation["recordings"]}
    day, night = rows[DAY], rows[NIGHT]
    text = (
        f"What the night costs: of {night['num_queries']} pictures {_format_share(night)} get a"
        f" pose, by day {_format_share(day)}"
    )
    if night["num_localized"] and day["num_localized"]:
        text += f"; the median error is {_format_error(night)} instead of {_format_error(day)}"
    text += "."
    if lost := night["num_queries"] - night["num_localized"]:
        reasons = ", ".join(
            f"{count} {reason.replace('_', ' ')}"
            for reason, count in night["not_localized"].items()
        )
        text += f' {lost} {"is" if lost == 1 else "are"} answered with "not localized" ({reasons}).'
    false = night["false_accepts"]
    if false == 0:
        return text + " No pose is wrong."
    return (
        text + f" {false} {'pose is' if false == 1 else 'poses are'} wrong by more than"
        f" {EvaluatedQuery.MAX_TRANSLATION:g} m or {EvaluatedQuery.MAX_ROTATION_DEG:g} degrees."
    )


def describe_out_of_map(evaluation: dict[str, Any]) -> str:
    """What happens to pictures that were not taken here."""
    num, accepted = (
        evaluation["num_elsewhere"],
        sum(row["false_accepts"] for row in evaluation["recordings"] if not row["num_queries"]),
    )
    said = "none is given a pose" if accepted == 0 else f"{accepted} wrongly get a pose"
    return f"Of {num} pictures that were taken elsewhere, or show nothing, {said}."


def _format_share(row: dict[str, Any]) -> str:
    return f"{100 * row['num_localized'] / row['num_queries']:.0f} %"


def _format_error(row: dict[str, Any]) -> str:
    return (
        f"{100 * row['median_translation_m']:.2f} cm and {row['median_rotation_deg']:.2f} degrees"
    )
