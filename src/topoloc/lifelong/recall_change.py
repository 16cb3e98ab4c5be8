"""Measure how an edit changes the recall of a map's earlier sessions.

Some nodes are localized before and after the edit, each with the node itself hidden. The small
images stored for the coarse localizers cannot serve as queries. At 160 pixels per side, even their
own map does not localize most of them. The stored features of nodes have the camera's full
resolution.
"""

from __future__ import annotations

from topoloc.lifelong.leave_one_out import localize_left_out, sample_evenly
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.mapping.topomap import TopoMetricMap


def measure_recall_change(
    before: TopoMetricMap,
    after: TopoMetricMap,
    localizer_config: LocalizerConfig | None = None,
    max_queries: int = 24,
) -> dict[str, int]:
    """Count how many nodes of `before` each of the two map versions localizes.

    Args:
        before: the map before the edit.
        after: the map after the edit.
        localizer_config: the localizer's settings.
        max_queries: the maximum number of nodes, evenly spaced.

    Returns:
        The counts by the names used in the map's history. Empty if `max_queries` is 0.

    Raises:
        MapError: a map cannot be read. Further errors as of `Localizer`.
    """
    rows = sample_evenly(before.rows, max_queries)
    if not rows:
        return {}
    counts = {"earlier_asked": len(rows)}
    for name, topomap in (("before", before), ("after", after)):
        answers = localize_left_out(Localizer(topomap, localizer_config), before, rows, 0.0)
        counts[f"earlier_localized_{name}"] = sum(
            answer.is_localized for answer in answers.values()
        )
    return counts
