"""Map photos with known poses by topoloc and by pycolmap (SIFT, all pairs matched, triangulated
from the poses), and localize the photos between them by both, in one table.

    python benchmarks/photos_peer.py KITCHEN [--every 6 12 24] [--noise METRES DEGREES] [--work DIR]

KITCHEN is the colour sequence of 7-Scenes or another recording with poses; its depth and right
images are left out. Of each N-th image N / 2 is mapped alternately: with --every 12 images 0, 12,
24 are mapped and 6, 18, 30 asked. --noise moves the poses of mapped images (standard deviations of
an axis). pycolmap matches a query with all mapped images, so it needs no retrieval; its pose is the
robust and refined absolute pose. --work keeps the models of pycolmap, one folder a row.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from pathlib import Path

import numpy as np

from hloc_peer import Queries, summarize, topoloc_results
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.frame import StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc.recordings.recording import as_monocular, with_poses
from topoloc_paper.peer_answers import PeerAnswer
from topoloc_paper.peer_colmap import map_rows, pose_of, query_row, run_worker


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording")
    parser.add_argument("--every", type=int, nargs="+", default=[6, 12, 24])
    parser.add_argument("--noise", type=float, nargs=2, default=(0.0, 0.0))
    parser.add_argument("--work", type=Path)
    arguments = parser.parse_args()
    for every in arguments.every:
        whole = as_monocular(open_sequence(arguments.recording))
        mapped = add_noise(whole[::every], *arguments.noise)
        asked = [whole[k] for k in range(every // 2, len(whole), every)]
        queries = Queries([f"every {every}, {len(mapped)} mapped"] * len(asked), asked)
        topoloc_results(argparse.Namespace(map=None), mapped, queries)
        with tempfile.TemporaryDirectory() as temporary:
            work = arguments.work / str(every) if arguments.work else Path(temporary)
            work.mkdir(parents=True, exist_ok=True)
            summarize("pycolmap, SIFT", queries, colmap_answers(work, mapped, queries))


def add_noise(sequence: StereoSequence, metres: float, degrees: float) -> StereoSequence:
    """Return the recording with noise on each axis of the poses, the same in each run."""
    rng, noisy = np.random.default_rng(0), list[Rigid3 | None]()
    for pose in sequence.poses:
        turn = Rigid3.exp(np.array([0.0, 0.0, 0.0, *np.radians(degrees) * rng.normal(size=3)]))
        moved = metres * rng.normal(size=3)
        noisy.append(pose and Rigid3(pose.rotation @ turn.rotation, pose.translation + moved))
    return with_poses(sequence, noisy) if metres or degrees else sequence


def colmap_answers(work: Path, mapped: StereoSequence, queries: Queries) -> list[PeerAnswer]:
    """Localize the queries by pycolmap, each matched with all mapped images."""
    rows = [row for k in range(len(mapped)) for row in map_rows(work, k, mapped[k])]
    everything = range(len(mapped))
    job = {
        "map": rows,
        "pairs": list(itertools.combinations([row["name"] for row in rows], 2)),
        "queries": [
            query_row(work, k, frame, everything) for k, frame in enumerate(queries.frames)
        ],
    }
    found = run_worker(work, job)["queries"]
    return [PeerAnswer(pose_of(each["cam_from_world"]), each["ms"]) for each in found]


if __name__ == "__main__":
    main()
