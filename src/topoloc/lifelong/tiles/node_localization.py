"""Localize nodes of one map in another map, with their stored features as queries."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from topoloc.localization.localizer import Localizer
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row


def localize_nodes(
    localizer: Localizer,
    source_map: TopoMetricMap,
    rows: Sequence[Row],
    on_localized: Callable[[int], None] = lambda done: None,
) -> dict[Row, Localization | None]:
    """Localize nodes of another map in the localizer's map.

    Args:
        localizer: the localizer of the map.
        source_map: the map that holds the nodes. It has all feature types of the localizer's map.
        rows: the rows of the nodes in `source_map`.
        on_localized: is called with the number of nodes done so far.

    Returns:
        The localizations by row. None if a node is not localized.
    """
    answers: dict[Row, Localization | None] = {}
    for row in rows:
        features = {
            kind: source_map.layers[kind].nodes[row].features for kind in localizer.topomap.kinds
        }
        result = localizer.localize_query(
            QueryImage.of_features(features, source_map.nodes[row].camera)
        )[0]
        answers[row] = result if isinstance(result, Localization) else None
        on_localized(len(answers))
    return answers
