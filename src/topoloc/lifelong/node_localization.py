"""What is stored of the nodes of one map, asked of another one as pictures would be."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from topoloc.localization.localizer import Localizer
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap


def localize_nodes(
    localizer: Localizer,
    source_map: TopoMetricMap,
    rows: Sequence[int],
    on_localized: Callable[[int], None] = lambda done: None,
) -> dict[int, Localization | None]:
    """What the localizer's map answers to these nodes (rows) of another one, which has all its
    kinds of features; None where it refuses.

    Args:
        asked: called with the number of nodes that were asked so far.
    """
    answers: dict[int, Localization | None] = {}
    for row in rows:
        features = {
            kind: source_map.nodes_of(kind)[row].features for kind in localizer.topomap.kinds
        }
        result = localizer.localize_query(
            QueryImage.of_features(features, source_map.nodes[row].camera)
        )[0]
        answers[row] = result if isinstance(result, Localization) else None
        on_localized(len(answers))
    return answers
