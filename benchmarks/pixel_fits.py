"""Measure the pixels of hypotheses (`exact/pixel_evidence.py`), and fit their weights.

    python benchmarks/pixel_fits.py ask MAP_SEQ SEQ ... --out FILE [--group NAME] [--every N]
        [--elsewhere | --map-from-truth TRANSFORM]
    python benchmarks/pixel_fits.py fit FILE ... [--floors WEIGHT]

MAP_SEQ may be a map file. `ask` appends a line for each hypothesis of each image: its log-odds,
those of its place, what pixels say, and whether it is right (within 0.25 m and 5 degrees) or wrong
(beyond 0.5 m, a tenth of the distance of its points, or 10 degrees; all with `--elsewhere`). `fit`
prints the weights for `exact/pixels.json` and a row for each group. Poses of other floors (group
`floors`) count `--floors` times: pixels do not tell floors apart, colours do. Groups whose name
begins with `held` are not fitted.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from topoloc.geometry.rigid import Rigid3
from topoloc.localization import decision
from topoloc.localization.answer import Answer
from topoloc.localization.belief import Hypothesis
from topoloc.localization.exact.pixel_evidence import (
    PixelAgreement,
    load_pixel_weights,
    measure_pixels,
    select_unclear,
)
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.map_query import MapQuery
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence
from topoloc_paper.fit.corpus import read_rigid


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    asking = commands.add_parser("ask")
    asking.add_argument("mapped")
    asking.add_argument("recordings", nargs="+")
    asking.add_argument("--out", type=Path, required=True)
    asking.add_argument("--group", default="own")
    asking.add_argument("--every", type=int, default=1)
    asking.add_argument("--elsewhere", action="store_true")
    asking.add_argument("--map-from-truth", type=Path)
    fitting = commands.add_parser("fit")
    fitting.add_argument("files", nargs="+", type=Path)
    fitting.add_argument("--floors", type=float, default=1.0)
    arguments = parser.parse_args()
    if arguments.command == "ask":
        ask(arguments)
    else:
        lines = [line for path in arguments.files for line in path.read_text().splitlines()]
        fit([json.loads(line) for line in lines], arguments.floors)


def ask(arguments: argparse.Namespace) -> None:
    """Append the hypotheses of all images to a file."""
    is_file = arguments.mapped.endswith(".topo")
    topomap = (
        TopoMetricMap.load(arguments.mapped)
        if is_file
        else build_map(open_sequence(arguments.mapped))
    )
    localizer, asked = Localizer(topomap), list[MapQuery]()

    def note(query: MapQuery, answer: Answer) -> None:
        asked.append(query)

    decision.CHECKS = (note, *decision.CHECKS)
    file = arguments.map_from_truth
    map_from_truth = read_rigid(file) if file else Rigid3.identity()
    with arguments.out.open("a") as out:
        for recording in arguments.recordings:
            sequence = open_sequence(recording)
            for index in range(0, len(sequence), arguments.every):
                frame = sequence[index]
                truth = frame.world_from_cam
                asked.clear()
                localizer.localize(frame.image, frame.camera)
                known = None if arguments.elsewhere or truth is None else map_from_truth @ truth
                for query in asked:
                    for row in describe(query, known):
                        facts = {"group": arguments.group, "map": Path(arguments.mapped).name}
                        facts |= {"recording": Path(recording).name, "index": index}
                        out.write(json.dumps(facts | row) + "\n")


def describe(query: MapQuery, truth: Rigid3 | None) -> list[dict[str, Any]]:
    """Return the rows of the hypotheses that would be weighed."""
    rows = list[dict[str, Any]]()
    for search in query.searches:
        for one in select_unclear(search):
            if (agreement := measure_pixels(search, one)) is not None:
                place = search.weights.place_log_odds(one.evidence)
                row = {"kind": search.map.kind.name, "right": is_right(one, truth)}
                rows.append(row | {"log_odds": one.log_odds, "place": place} | asdict(agreement))
    return rows


def is_right(one: Hypothesis, truth: Rigid3 | None) -> bool | None:
    """Return whether a hypothesis is right. None: neither right nor wrong."""
    if truth is None:
        return False
    error = one.world_from_cam.inverse() @ truth
    metres, degrees = np.linalg.norm(error.translation), math.degrees(error.angle())
    if metres < 0.25 and degrees < 5.0:
        return True
    return False if metres > max(0.5, 0.1 * one.fit.median_depth) or degrees > 10.0 else None


def fit(rows: list[dict[str, Any]], floor_weight: float) -> None:
    """Print the weights, and what they do with the poses of each group."""
    weights = load_pixel_weights()
    rows = [one for one in rows if one["right"] is not None]
    inputs = np.array([[one["place"], *of_pixels(one), 1.0] for one in rows])
    signs = np.array([1.0 if one["right"] else -1.0 for one in rows])
    shares = np.array([floor_weight if one["group"] == "floors" else 1.0 for one in rows])
    held_out = np.array([one["group"].startswith("held") for one in rows])
    shares[held_out] = 0.0

    def loss(line: np.ndarray) -> float:
        shrinkage = 0.3 * float(np.sum(line[:-1] ** 2))
        return float(np.sum(shares * np.logaddexp(0.0, -signs * (inputs @ line)))) + shrinkage

    line = minimize(loss, np.zeros(5), method="BFGS").x
    names = ("place", "found", "angle", "colours", "bias")
    print(json.dumps(dict(zip(names, np.round(line, 2).tolist(), strict=True))))
    print(f"{np.sum(shares > 0)} poses, {loss(line) / shares.sum():.4f} nats each")
    log_odds = np.array([one["log_odds"] for one in rows])
    by_pixels = np.clip(inputs @ line, log_odds - weights.max_loss, log_odds + weights.max_gain)
    groups = defaultdict[tuple[str, str, bool], list[int]](list)
    for k, one in enumerate(rows):
        groups[one["group"], one["recording"][:20], one["right"]].append(k)
    for (group, recording, right), of_group in sorted(groups.items()):
        before, after = log_odds[of_group] > 0.0, by_pixels[of_group] > 0.0
        print(
            f"{group:10}{recording:22}{'right' if right else 'wrong'} {len(of_group):4}: passed"
            f" {before.sum():4} -> {after.sum():4}, {by_pixels[of_group].min():5.1f} to"
            f" {by_pixels[of_group].max():5.1f}"
        )


def of_pixels(row: dict[str, Any]) -> tuple[float, float, float]:
    """Return the inputs of the regression."""
    names = ("found", "by_chance", "angle", "colours")
    return PixelAgreement(*(row[name] for name in names)).inputs(load_pixel_weights())


if __name__ == "__main__":
    main()
