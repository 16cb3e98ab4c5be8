"""Whether the promise of `topoloc certify` holds on recordings that it did not see.

    python benchmarks/certificates.py MAP_SEQ --walk SEQ ... --unseen SEQ ...
        [--out-of-map SEQ ...] [--map-from-truth FILE]

The map of MAP_SEQ is certified with the walks. Each unseen recording with truth is then localized,
and its wrong independent pieces are counted as the map gives its answers, beside the promise.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import topoloc
from topoloc.apps.cli.queries.evaluate import read_rigid
from topoloc.apps.quality.certificate_texts import describe_condition
from topoloc.apps.quality.certified_answers import CertifiedAnswers, find_pieces


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map_seq")
    for name in ("--walk", "--unseen", "--out-of-map"):
        parser.add_argument(name, nargs="*", default=[])
    parser.add_argument("--map-from-truth", type=Path)
    args = parser.parse_args()
    map_from_truth = None if args.map_from_truth is None else read_rigid(args.map_from_truth)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.topo"
        topoloc.build_map(args.map_seq).save(path)
        walks, others = (
            [topoloc.open_sequence(one) for one in named] for named in (args.walk, args.out_of_map)
        )
        found = topoloc.certify(path, walks, others, map_from_truth)
        print(found.certificate.promise())
        for one in found.certificate.conditions:
            print(f"  {one.name}: {describe_condition(one)}")
        level = found.certificate.applied_min_probability
        localizer = topoloc.Localizer(path)
        for name in args.unseen:
            sequence = topoloc.open_sequence(name)
            answers = topoloc.localize_queries(localizer, sequence, map_from_truth)
            pieces = find_pieces(localizer.topomap, answers, by_pose=True)
            facts = CertifiedAnswers(sequence.name, "walk", True, answers, pieces).facts(
                level, 0.95
            )
            share = facts.num_wrong_pieces / facts.num_pieces
            is_held = share <= (found.certificate.max_wrong_share or 1.0)
            print(
                f"unseen {facts.name}: {facts.num_localized} of {facts.num_images} localized,"
                f" {facts.num_wrong} wrong, {facts.num_wrong_pieces} of {facts.num_pieces} pieces"
                f" ({share:.1%}): {'held' if is_held else 'BROKEN'}"
            )


if __name__ == "__main__":
    main()
