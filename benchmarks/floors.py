"""Measure the appearance of images of this floor and of other floors of the same building.

    python benchmarks/floors.py ask MAP RECORDING [RECORDING ...] --out FILE [--other] [--every N]
    python benchmarks/floors.py fit FILE [FILE ...]
    python benchmarks/floors.py judge FILE [FILE ...] [--json FILE]

Recordings by `topoloc simulate corridor --seed N` of other seeds are other floors (`--other`).
`ask` appends a line for each image: the pose's probability without the appearance, the agreement of
the colours, the error. `fit` prints weights for `localization/exact/appearance.json`: a logistic
regression in which both classes weigh the same. `judge` counts the answers (p at least 0.5) by
recording, without the appearance, with it, and in a map with look-alike floors; then streams of
three successive images, whose last one is an answer.
"""

from __future__ import annotations

import argparse
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import minimize

from topoloc.geometry.rigid import Rigid3
from topoloc.localization.exact import appearance, pixel_evidence
from topoloc.localization.exact.appearance import (
    AppearanceWeights,
    ColourAgreement,
    load_appearance_weights,
)
from topoloc.localization.localizer import Localizer
from topoloc.localization.result import Localization
from topoloc.recordings.open import open_sequence

Row = dict[str, Any]
COLUMNS = (
    *("images", "before", "now", "with the setting"),
    *("streams", "streams before", "streams now", "streams with the setting"),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("step", choices=["ask", "fit", "judge"])
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--other", action="store_true")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write the counts of `judge` to this file")
    arguments = parser.parse_args()
    if arguments.step == "ask":
        ask(arguments.paths[0], arguments.paths[1:], arguments)
        return
    rows = [
        json.loads(line)
        for path in arguments.paths
        for line in Path(path).read_text(encoding="utf-8").splitlines()
    ]
    if arguments.step == "fit":
        fit(rows)
        return
    counts = judge(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(counts, indent=1))


def ask(map_file: str, recordings: list[str], arguments: argparse.Namespace) -> None:
    """Append the numbers of each image to a file."""
    weights, compare = load_appearance_weights(), appearance.compare_colours
    without_floors = msgspec.structs.replace(weights, floor_odds=(0.0, 0.0))
    appearance.load_appearance_weights = lambda: without_floors
    seen = list[ColourAgreement | None]()

    def keep(*given: Any) -> ColourAgreement | None:
        seen.append(compare(*given))
        return seen[-1]

    appearance.compare_colours = pixel_evidence.compare_colours = keep
    localizer = Localizer(map_file)
    for recording in recordings:
        sequence = open_sequence(recording)
        asked = f"{Path(map_file).stem} {Path(recording.partition('@')[0]).name}"
        for index in range(0, len(sequence), arguments.every):
            frame = sequence[index]
            row: Row = {"asked": asked, "image": index, "other": arguments.other}
            seen.clear()
            found = localizer.localize(frame.image, frame.camera)
            if isinstance(found, Localization):
                row |= {"p": found.probability, "pose": found.world_from_cam.to_json()}
            if isinstance(found, Localization) and seen and seen[0] is not None:
                row["with_pixels"] = found.appearance is None
                row["seen"] = [seen[0].correlation, seen[0].light_change, seen[0].contrast]
            with arguments.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")


def fit(rows: list[Row]) -> None:
    """Print the weights."""
    known, noise = [row for row in rows if "seen" in row], load_appearance_weights().noise
    inputs = np.array([[_atanh(row["seen"][0]), row["seen"][1], 1.0] for row in known])
    variances = np.array([row["seen"][2] for row in known]) ** 2
    inputs *= (variances / (variances + noise**2))[:, None]
    signs = np.array([-1.0 if row["other"] else 1.0 for row in known])
    shares = np.where(signs > 0, 0.5 / np.sum(signs > 0), 0.5 / np.sum(signs < 0))

    def loss(weights: np.ndarray) -> float:
        return float(
            shares @ np.logaddexp(0.0, -signs * (inputs @ weights)) + 1e-4 * weights @ weights
        )

    print(np.sum(signs > 0), "images of this floor,", np.sum(signs < 0), "of others")
    for name, value in zip(
        ("agreement", "light", "bias"), minimize(loss, np.zeros(3)).x, strict=True
    ):
        print(name, round(float(value), 2))


def judge(rows: list[Row]) -> dict[str, dict[str, int]]:
    """Print the answers by recording, and return those of all together."""
    weights = load_appearance_weights()
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(("other: " if row["other"] else "own: ") + row["asked"], []).append(row)
    for name, group in groups.items():
        print(name, describe(count([group], weights)), sep=", ")
    together: dict[str, dict[str, int]] = {}
    for start, name in (("own", "all own"), ("other", "all others")):
        chosen = [group for key, group in groups.items() if key.startswith(start)]
        counts = count(chosen, weights)
        print(name, describe(counts), sep=", ")
        together[name] = dict(zip(COLUMNS, counts, strict=True))
    return together


def describe(counts: list[int]) -> str:
    """Return the counts as text."""
    return ", ".join(f"{name} {number}" for name, number in zip(COLUMNS, counts, strict=True))


def count(groups: list[list[Row]], weights: AppearanceWeights) -> list[int]:
    """Count images and their answers, then streams of three images and their answers."""
    rows = [row for group in groups for row in group]
    triples = [group[k : k + 3] for group in groups for k in range(len(group) - 2)]
    odds = 0.0, *weights.floor_odds
    return [
        len(rows),
        *(sum(_is_answer(row, one, weights) for row in rows) for one in odds),
        len(triples),
        *(sum(_is_stream_answer(three, one, weights) for three in triples) for one in odds),
    ]


def _log_odds(row: Row, odds: float, weights: AppearanceWeights) -> float | None:
    if "seen" not in row or (row["with_pixels"] and odds < 1.0):
        return None
    certainty = 0.0 if odds >= 1.0 else row["p"]  # as `weigh_appearance`
    seen = ColourAgreement(*row["seen"]).appearance(certainty, weights)
    return math.log(seen / (1.0 - seen))


def _is_answer(row: Row, odds: float, weights: AppearanceWeights) -> bool:
    log_odds = _log_odds(row, odds, weights)
    others = 0.0 if log_odds is None else odds * math.exp(-log_odds)
    return row.get("p", 0.0) / (1.0 + others) >= 0.5


def _is_stream_answer(three: list[Row], odds: float, weights: AppearanceWeights) -> bool:
    """Return whether the last of three images is an answer, by the rule of `FloorEvidence`."""
    if odds == 0.0 or not _is_answer(three[-1], odds, weights):
        return _is_answer(three[-1], odds, weights)
    answers = [row for row in three if _is_answer(row, odds, weights)]
    poses = [Rigid3.from_json(row["pose"]) for row in answers]
    is_one_way = all(
        np.linalg.norm(a.translation - b.translation) < 3.0 for a, b in pairwise(poses)
    )
    seen = [
        min(max(log, -4.0), 4.0)
        for row in three
        if (log := _log_odds(row, odds, weights)) is not None
    ]
    is_enough = len(seen) == 3
    least = math.log(odds) + (weights.places_log_odds[odds >= 1.0] if is_enough else 0.0)
    return is_one_way and (is_enough or odds < 1.0) and sum(seen) >= least


def _atanh(correlation: float) -> float:
    return math.atanh(min(max(correlation, -0.97), 0.97))


if __name__ == "__main__":
    main()
