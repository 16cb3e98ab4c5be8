"""Fit the numbers for images that look aside: the limit of votes by chance, and the certainty of a
pose with points in a small part of the image.

    python benchmarks/aside_fits.py MAP_SEQ QUERY_SEQ ... [--elsewhere SEQ ...] [--kind topoloc-net]

MAP_SEQ may be a map file. Queries have exact truth in the same world, as by `topoloc simulate
corridor ... --look 60`. Recordings after `--elsewhere`, such as `SEQ@0::10`, show other places. The
first lines go to `stop.min_votes` of `localization/weights/KIND.json`, the last one to
`max_narrow_log_odds` and `narrow_doubt` of `EvidenceWeights`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace
from scipy.optimize import minimize

from topoloc.geometry.rigid import Rigid3
from topoloc.localization import propose
from topoloc.localization.fitted_weights import compute_log_odds, load_fitted_weights
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.search import Search, Trace, TriedProposal
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.node_ids import Row
from topoloc.recordings.open import open_sequence


@dataclass(eq=False)
class Found:
    """Hold the most votes of a place for each image, and (doubt, is right) of narrow poses."""

    right: list[float] = field(default_factory=list)
    others: list[float] = field(default_factory=list)
    narrow: list[tuple[float, bool]] = field(default_factory=list)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mapped")
    parser.add_argument("queries", nargs="+")
    parser.add_argument("--elsewhere", nargs="+", default=[])
    parser.add_argument("--kind", default="topoloc-net")
    arguments = parser.parse_args()
    is_file = arguments.mapped.endswith(".topo")
    topomap = (
        TopoMetricMap.load(arguments.mapped)
        if is_file
        else build_map(open_sequence(arguments.mapped))
    )
    localizer = Localizer(topomap, LocalizerConfig(kinds=(arguments.kind,)))
    seen, away = Found(), Found()
    for recordings, found in ((arguments.queries, seen), (arguments.elsewhere, away)):
        for recording in recordings:
            ask(localizer, recording, arguments.kind, found, has_truth=found is seen)
    for name, values in (
        ("right poses", seen.right),
        ("other images of the place", seen.others),
        ("elsewhere", away.others),
    ):
        if values:
            low, middle, high = np.percentile(values, [5, 50, 95])
            print(
                f"most votes of a place, {name}: {len(values)} images, least {min(values):.2f},"
                f" 5 % {low:.2f}, median {middle:.2f}, 95 % {high:.2f}, most {max(values):.2f}"
            )
    fit_narrow(seen.narrow + away.narrow)


def ask(localizer: Localizer, recording: str, kind: str, found: Found, *, has_truth: bool) -> None:
    """Localize all images of a recording."""
    weights = replace(load_fitted_weights(kind).evidence, narrow_spread=0.0)
    limit, most = load_fitted_weights(kind).evidence.narrow_spread, list[float]()
    find_places = propose.find_places

    def noting(search: Search) -> Iterator[list[Row]]:
        most.append(float(propose.count_votes(search)[2].max(initial=0.0)))
        return find_places(search)

    propose.find_places = noting
    sequence = open_sequence(recording)
    for index in range(len(sequence)):
        frame, trace = sequence[index], Trace()
        most.clear()
        localizer.localize(frame.image, frame.camera, trace=trace)
        truth = frame.world_from_cam if has_truth else None
        tried = [(one, is_right(one, truth)) for one in trace.tried]
        if most:
            by_votes = any(right and one.source == "votes" for one, right in tried)
            (found.right if by_votes else found.others).append(most[0])
        for one, right in tried:
            evidence = None if one.hypothesis is None else one.hypothesis.evidence
            if right is None or evidence is None or not evidence.is_of_nodes:
                continue
            if evidence.spread < limit and compute_log_odds(evidence, weights) > 0.5:
                found.narrow.append((max(evidence.doubt, 0.05), right))
    propose.find_places = find_places


def is_right(one: TriedProposal, truth: Rigid3 | None) -> bool | None:
    """Return whether a tried pose is right. None between 0.25 m or 2 degrees and 1 m or 5."""
    if truth is None or one.world_from_cam is None:
        return False
    error = (one.world_from_cam.inverse() @ truth).log()
    metres, degrees = np.linalg.norm(error[:3]), np.rad2deg(np.linalg.norm(error[3:]))
    if metres < 0.25 and degrees < 2.0:
        return True
    return False if metres > 1.0 or degrees > 5.0 else None


def fit_narrow(poses: list[tuple[float, bool]]) -> None:
    """Print the log-odds of narrow poses by their doubt, a logistic fit."""
    is_right = np.array([right for _, right in poses], dtype=bool)
    if not 0 < is_right.sum() < len(poses):
        return
    doubts = np.log(np.array([doubt for doubt, _ in poses]) / 0.1)
    signs = np.where(is_right, -1.0, 1.0)

    def loss(line: np.ndarray) -> float:
        return float(np.logaddexp(0.0, signs * (line[0] + line[1] * doubts)).sum())

    at_least, slope = minimize(loss, [1.0, -1.0]).x
    print(
        f"narrow poses: {is_right.sum()} right, {(~is_right).sum()} wrong; log odds"
        f" {at_least:.2f} at a doubt of 0.1, {slope:+.2f} for each e-fold"
    )


if __name__ == "__main__":
    main()
