"""What is stored of the nodes of one map, asked of another one as pictures would be."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from topoloc.localization.localizer import Localizer
from topoloc.localization.query import Picture
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap


def ask_nodes(
    localizer: Localizer,
    of: TopoMetricMap,
    rows: Sequence[int],
    asked: Callable[[int], None] = lambda done: None,
) -> dict[int, Localization | None]:
    """What the localizer's map answers to these nodes (rows) of another one, which has all its
    kinds of features; None where it refuses.

    Args:
        asked: called with the number of nodes that were asked so far.
    """
    answers: dict[int, Localization | None] = {}
    for row in rows:
        features = {kind: of.nodes_of(kind)[row].features for kind in localizer.topomap.kinds}
        result = localizer.ask(Picture.of_features(features, of.nodes[row].camera))[0]
        answers[row] = result if isinstance(result, Localization) else None
        asked(len(answers))
    return answers
