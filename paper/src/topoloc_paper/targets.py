"""The figures that must be reached, and whether they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from topoloc_paper.published import MAX_MS_A_QUERY, TARGETS, Target


def rows(
    table: Sequence[dict[str, Any]],
    ablation: Sequence[dict[str, Any]],
    speed: Sequence[dict[str, Any]],
) -> list[dict[str, Any]]:
    """Return a row for each measured target: the best method by the paper's D_thresh, topoloc's own
    nodes, and the change that would help."""
    found = []
    for target in TARGETS:
        asked = [
            r
            for r in table
            if (r["dataset"], r["queries"]) == (target.dataset, target.queries)
            and r["method"] != "posenet"
        ]
        measured = [r for r in asked if r.get("median_translation_m") is not None]
        if measured:
            changed = [
                r
                for r in ablation
                if (r["dataset"], r["queries"]) == (target.dataset, target.queries)
            ]
            found.append(_row(target, measured, changed) | _speed(target, speed))
    return found


def _row(
    target: Target, measured: list[dict[str, Any]], ablation: list[dict[str, Any]]
) -> dict[str, Any]:
    as_paper = [r for r in measured if r["nodes"].startswith("D_thresh")] or measured
    best = min(as_paper, key=lambda r: r["median_translation_m"])
    own = next((r for r in measured if not r["nodes"].startswith("D_thresh")), best)
    row: dict[str, Any] = {
        "dataset": target.dataset,
        "queries": target.queries,
        "asked_m": target.metres,
        "asked_deg": target.degrees,
    }
    row |= {
        "best": _facts(best),
        "own_nodes": _facts(own),
        "reached": _reaches(best, target),
        "reached_by_own_nodes": _reaches(own, target),
    }
    return row | {"helps": _what_helps(ablation)}


def _speed(target: Target, speed: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Milliseconds a query of each coarse localizer, and which take too long."""
    ms = {
        r["method"]: 1e3 * r["quartiles_s"]["total"][1]
        for r in speed
        if r["dataset"] == target.dataset and "quartiles_s" in r
    }
    slow = [f"{method} {value:.0f} ms" for method, value in ms.items() if value > MAX_MS_A_QUERY]
    return {"asked_ms": MAX_MS_A_QUERY, "ms": ms, "ms_reached": not slow, "slow": slow}


def _facts(row: dict[str, Any]) -> dict[str, Any]:
    keys = (
        "method",
        "nodes",
        "median_translation_m",
        "median_rotation_deg",
        "num_localized",
        "num_queries",
        "ms",
    )
    return {key: row.get(key) for key in keys}


def _reaches(row: dict[str, Any], target: Target) -> bool:
    near = row["median_translation_m"] <= target.metres
    return bool(near and (target.degrees is None or row["median_rotation_deg"] <= target.degrees))


def _what_helps(ablation: list[dict[str, Any]]) -> str:
    """Describe the change that lowers the error most, if one lowers it by a tenth."""
    plain = next((r for r in ablation if not r["part"]), None)
    if plain is None or plain["median_translation_m"] is None:
        return ""
    others = [r for r in ablation if r["part"] and r["median_translation_m"] is not None]
    better = [r for r in others if r["median_translation_m"] < 0.9 * plain["median_translation_m"]]
    if not better:
        return (
            "none of the changes lowers the error by a tenth: what is left lies in the pictures and"
            " in the map's points"
        )
    most = min(better, key=lambda r: r["median_translation_m"])
    share = 100 * (1 - most["median_translation_m"] / plain["median_translation_m"])
    return f"{most['part']}: {most['change']} takes {share:.0f} % off the error"
