"""Streams and SLAM on real recordings."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from pathlib import Path

from .answers import pose_difference
from .figures import Figure, rounded
from .places import FIT
from .workplace import Workplace


def stream(work: Workplace) -> Iterator[Figure]:
    """Follow recordings as streams: the demo's lab, ZED session 2, and one that jumps elsewhere."""
    yield from _of_stream(work, "demo, lap 2", work.map("lab"), work.lab("map_lap2"), ())
    fit = ("--map-from-truth", work.data(FIT))
    zed = work.data("zed_lab/session2@0:99")
    yield from _of_stream(work, "zed", work.map("zed"), zed, fit)
    kidnapped = work.data("zed_lab/session2@0:30,70:99")
    yield from _of_stream(work, "zed, kidnapped once", work.map("zed"), kidnapped, fit)


def slam(work: Workplace) -> Iterator[Figure]:
    """Run SLAM without poses, also on a recording with missing frames."""
    recordings = {
        "street1": "kitti/sequences/street1",
        "euroc": "euroc/v1_01_part",
        "zed": "zed_lab/session1",
        "kitchen": "seven_scenes/kitchen",
        "kitchen, 40 of 100 frames missing": "seven_scenes/kitchen@0-59/100",
    }
    for name, recording in recordings.items():
        found = work.answer("slam", work.data(recording), work.folder / "out.tum")
        count = f"{name}: frames kept of {found['num_frames']}"
        yield Figure(count, found["num_tracked"], "at least")
        if "ate_m" in found:
            yield Figure(f"{name}: ATE, cm", rounded(100 * found["ate_m"]), "median")
        else:
            yield Figure(f"{name}: length, m", round(found["length_m"], 3))


def _of_stream(
    work: Workplace, name: str, where: Path, recording: object, fit: tuple[object, ...]
) -> Iterator[Figure]:
    lines = work.answer("localize", where, recording, "--stream")
    evaluation = work.answer("evaluate", where, recording, *fit)
    # The evaluation gives the truth in the world of the map.
    truth = {Path(a["query"]).stem: a["true_world_from_cam"] for a in evaluation["answers"]}
    found = [line for line in lines if line["localized"]]
    errors = [
        pose_difference(truth[Path(line["query"]).stem], line["world_from_cam"])[0]
        for line in found
    ]
    lost = sum(line["state"] in ("lost", "ambiguous") for line in lines)
    yield Figure(f"{name}: frames with a pose of {len(lines)}", len(found), "at least")
    yield Figure(f"{name}: median error, cm", rounded(100 * statistics.median(errors)), "median")
    yield Figure(f"{name}: worst error, cm", rounded(100 * max(errors)), "median")
    yield Figure(f"{name}: frames lost or ambiguous", lost, "at most")
