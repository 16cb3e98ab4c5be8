"""How hard is the night of a rendered world? Queries localized by day and by night against a map
made by day.

    topoloc simulate lab /tmp/map                                     # and so on, or the recordings
    of `topoloc demo` python benchmarks/night_difficulty.py --map /tmp/map --day /tmp/day --night
    /tmp/night

Plain SIFT (no normalisation, OpenCV's own contrast threshold, five candidate nodes pooled, no
guided step, every pose with a dozen inliers taken) shows what the light costs a common method; it
should lose about half of what it localizes by day. Beside it the paper's scheme (its normalisation,
one node) and this project's defaults. A query counts where its pose is right within both bounds; a
pose that is wrong by more than 0.5 m or 10 degrees is a false accept.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from topoloc.evaluation.metrics import summarize
from topoloc.evaluation.query_localization import localize_queries
from topoloc.features.extraction import FeatureConfig
from topoloc.localization.config import EvidenceConfig
from topoloc.localization.guided import GuidedConfig
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.build import BuildConfig
from topoloc.recordings.open import open_sequence

BOUNDS = ("0.05m_5deg", "0.25m_2deg")
UNGUIDED = GuidedConfig(num_nodes=0)
ANY_POSE = EvidenceConfig(min_inliers=12, min_found=12, min_probability=0.0)


@dataclass(frozen=True)
class Method:
    """Hold the settings and the feature type of a method."""

    name: str
    features: FeatureConfig
    localizer: LocalizerConfig


METHODS = (
    Method(
        "plain SIFT, five nodes",
        FeatureConfig(kind="sift", normalization="none", contrast_threshold=0.04),
        LocalizerConfig(
            num_candidates=5, guided=UNGUIDED, evidence=ANY_POSE, num_first_features=1_000_000
        ),
    ),
    Method(
        "the paper's scheme",
        FeatureConfig(kind="surf", normalization="paper"),
        LocalizerConfig(
            num_candidates=1, guided=UNGUIDED, evidence=ANY_POSE, num_first_features=1_000_000
        ),
    ),
    Method("defaults", FeatureConfig(), LocalizerConfig()),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--map", nargs="+", required=True, help="recordings by day with depth or stereo"
    )
    parser.add_argument("--day", required=True)
    parser.add_argument("--night", required=True)
    arguments = parser.parse_args()
    mapping = [open_sequence(path) for path in arguments.map]
    queries = {"day": open_sequence(arguments.day), "night": open_sequence(arguments.night)}
    print(
        "| method | light | within"
        f" {' | within '.join(bound.replace('_', ' ') for bound in BOUNDS)} | false accepts |"
        " median |"
    )
    print("|---|---|---|---|---|---|")
    for method in METHODS:
        localizer = Localizer(
            build_map(mapping, BuildConfig(features=method.features)), method.localizer
        )
        for light, sequence in queries.items():
            e = summarize(localize_queries(localizer, sequence))
            shares = " | ".join(f"{100 * e['recall'][bound]:.0f} %" for bound in BOUNDS)
            median = (
                f"{100 * e['median_translation_m']:.1f} cm, {e['median_rotation_deg']:.2f} deg"
                if e["num_localized"]
                else "-"
            )
            print(
                f"| {method.name} | {light} | {shares} | {e['false_accepts']} of {e['num_queries']}"
                f" | {median} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
