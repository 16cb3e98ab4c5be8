"""The recordings of `topoloc demo`, which come with topoloc: the lab by day for the map, and its
queries. Also the texts of the demo's results for the terminal and the report.

They are rendered; `topoloc simulate demo`, of the distribution topoloc-worlds, makes them anew.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from topoloc import EvaluatedQuery
from topoloc.apps.report.report_tables import PublishedResult, ReportTexts

PAPER_LAB = ("the paper's Lab, by day", 0.0202, 0.35)
DAY, NIGHT = "day", "night"
_ABOUT = {
    "day": "a third lap, the light of the map",
    "night": "no daylight, few lamps, chairs and things moved",
    "other camera": "one camera, a focal length 1.4 times as long, 800x600; things moved",
    "elsewhere": "another building, a street, images without content",
}


def create_report_texts(evaluation: dict[str, Any]) -> ReportTexts:
    """Return the texts of the demo's report."""
    m = evaluation["map"]
    return ReportTexts(
        title="One room, mapped by day, localized by night",
        subtitle=(
            f"A lab of 5 x 4 m, recorded twice with a stereo camera ({m['length_m']:.0f} m,"
            f" {m['num_nodes']} nodes, {m['bytes'] / 1e6:.1f} MB). Each query is a single image."
        ),
        paragraphs=[describe_night(evaluation), describe_out_of_map(evaluation), _RENDERED],
        about=_ABOUT,
        published=[PublishedResult(*PAPER_LAB)],
    )


_RENDERED = (
    "The lab is rendered, so every true pose is known exactly. Its camera has noise, vignetting and"
    " an imperfect exposure, but no calibration error. The paper's figure is from a real room of"
    " about this size. It shows the expected scale, and is no comparison."
)


def describe_night(evaluation: dict[str, Any]) -> str:
    """Compare the night with the day."""
    rows = {row["name"]: row for row in evaluation["recordings"]}
    day, night = rows[DAY], rows[NIGHT]
    text = (
        f"By night, {_format_share(night)} of {night['num_queries']} images get a pose, by day"
        f" {_format_share(day)}"
    )
    if night["num_localized"] and day["num_localized"]:
        text += f"; the median error is {_format_error(night)} instead of {_format_error(day)}"
    text += "."
    if lost := night["num_queries"] - night["num_localized"]:
        reasons = ", ".join(
            f"{count} {reason.replace('_', ' ')}"
            for reason, count in night["not_localized"].items()
        )
        text += f" {lost} {'is' if lost == 1 else 'are'} not localized ({reasons})."
    false = night["false_accepts"]
    count = {0: "No pose is", 1: "1 pose is"}.get(false, f"{false} poses are")
    text += (
        f" {count} wrong by more than {EvaluatedQuery.MAX_TRANSLATION:g} m or"
        f" {EvaluatedQuery.MAX_ROTATION_DEG:g} degrees."
    )
    if night["num_localized"]:
        largest = f"{100 * night['max_translation_m']:.1f} cm"
        text += f" The largest error by night is {largest}."
    return text


def describe_out_of_map(evaluation: dict[str, Any]) -> str:
    """Count the poses of out-of-map images."""
    rows = [row for row in evaluation["recordings"] if not row["num_queries"]]
    accepted = sum(row["false_accepts"] for row in rows)
    outcome = "none gets a pose" if accepted == 0 else f"{accepted} wrongly get a pose"
    return f"Of {evaluation['num_elsewhere']} out-of-map images, {outcome}."


def _format_share(row: dict[str, Any]) -> str:
    return f"{100 * row['num_localized'] / row['num_queries']:.0f} %"


def _format_error(row: dict[str, Any]) -> str:
    return (
        f"{100 * row['median_translation_m']:.2f} cm and {row['median_rotation_deg']:.2f} degrees"
    )


Role = Literal["map", "queries", "elsewhere"]

SHIPPED = Path(__file__).parent / "lab"
ROLES: dict[str, Role] = {
    "map_lap1": "map",
    "map_lap2": "map",
    "day": "queries",
    "night": "queries",
    "other_camera": "queries",
    "corridor": "elsewhere",
    "street": "elsewhere",
    "pictures_of_nothing": "elsewhere",
}
"""What each recording is for, by the name of its folder."""


def find_missing_recordings(folder: Path) -> list[str]:
    """Return the names of the demo's recordings that are not in `folder`."""
    return [name for name in ROLES if not (folder / name).is_dir()]
