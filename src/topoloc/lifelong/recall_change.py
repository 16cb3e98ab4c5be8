"""What an edit costs the sessions that a map has: some of its nodes are asked before and after,
each as if nobody had stood there.

The small pictures that the map keeps for its coarse localizers are no use for that: of 160 pixels a
side, most are not localized by the very map that holds them. What is stored of nodes is as sharp as
the camera was.
"""

from __future__ import annotations

from topoloc.lifelong.leave_one_out import localize_left_out, sample_evenly
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.mapping.topomap import TopoMetricMap


def measure_recall_change(
    before: TopoMetricMap,
    after: TopoMetricMap,
    max_asked: int,
    localizer_config: LocalizerConfig | None = None,
) -> dict[str, int]:
    """How many of the earlier nodes each of two versions of a map localizes, by the names that the
    history has for it; empty where none is to be asked. Raises as `Localizer`, and MapError from
    reading."""
    rows = sample_evenly(range(len(before.summaries)), max_asked)
    if not rows:
        return {}
    counts = {"earlier_asked": len(rows)}
    for name, topomap in (("before", before), ("after", after)):
        answers = localize_left_out(Localizer(topomap, localizer_config), before, rows, 0.0)
        counts[f"earlier_localized_{name}"] = sum(
            answer.is_localized for answer in answers.values()
        )
    return counts
