"""Tables of counts: a busy machine does not change them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from acceptance_jobs.figures import Figure
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.open import open_sequence

from .bench import Bench, figures_of

FIT = "zed_lab/session1_from_session2.json"
KITCHEN = "seven_scenes/kitchen"
FAR = ("0-99/350", "250-349/350", "120-199/350")
FAR_METRES, FAR_DEGREES = 0.5, 30.0
ANY_PROBABILITY = 0.002


def exactness(bench: Bench) -> Iterator[Figure]:
    """Errors of images of real recordings and of the demo, without and with the last step."""
    places = {
        "lab": ("demo:map_lap1", ("demo:day", "demo:night"), ()),
        "zed": ("zed_lab/session1", ("zed_lab/session2@0:99",), ("--map-from-truth", FIT)),
        "kitchen": (f"{KITCHEN}@0::2", (f"{KITCHEN}@1::6",), ()),
        "street1": ("kitti/sequences/street1@0::2", ("kitti/sequences/street1@1::2",), ()),
        "street2": ("kitti/sequences/street2@0::2", ("kitti/sequences/street2@1::2",), ()),
    }
    for name, (mapped, queries, options) in places.items():
        path = bench.map(name, bench.data(mapped))
        words = [bench.data(word) if word == FIT else word for word in options]
        found = bench.script("exactness", path, *map(bench.data, queries), *words)
        yield from _rows(name, found)


def recall(bench: Bench) -> Iterator[Figure]:
    """Images of rendered corridors and streets (the other lane), by light."""
    lights = {
        "corridor1": ("day", "evening", "night"),
        "corridor2": ("day", "night"),
        "street1": ("clear", "cloudy", "rain"),
        "street2": ("clear", "rain"),
    }
    for place, of_place in lights.items():
        path = bench.map(place, bench.render(f"{place}_map"))
        queries = [bench.render(f"{place}_{light}") for light in of_place]
        yield from _rows(place, bench.script("exactness", path, *queries))


def aside(bench: Bench) -> Iterator[Figure]:
    """Images that look aside of the direction in which the corridor was mapped."""
    path = bench.map("corridor1", bench.render("corridor1_map"))
    queries = [bench.render(f"corridor1_aside{degrees}") for degrees in (20, 40, 60)]
    yield from _rows("aside", bench.script("exactness", path, *queries))


def far(bench: Bench) -> Iterator[Figure]:
    """Images of the kitchen far beside any mapped one, as answered and at any probability."""
    for frames in FAR:
        mapped = bench.data(f"{KITCHEN}@{frames}")
        path, query = bench.map(f"far{frames[:3]}", mapped), far_frames(bench, mapped)
        for name, words in (("", ()), (", any p", ("--min-probability", ANY_PROBABILITY))):
            found = bench.script("exactness", path, query, "--max-degrees", 5, *words)
            best = {key: row for key, row in found.items() if key.endswith("best")}
            yield from _rows(f"{frames}{name}", best)


def far_frames(bench: Bench, mapped: str) -> str:
    """Return every fifth frame of those that were not mapped, if it is far from all that were."""
    first, last = (int(word) for word in mapped.partition("@")[2].split("/")[0].split("-"))
    poses = open_sequence(bench.data(KITCHEN)).poses
    assert poses is not None
    others = [k for k in range(len(poses)) if not first <= k <= last]
    known = [pose for pose in poses[first : last + 1] if pose is not None]
    chosen = [k for k in others[::5] if _is_far(poses[k], known)]
    return f"{bench.data(KITCHEN)}@" + ",".join(f"{k}:{k + 1}" for k in chosen)


def _is_far(pose: Rigid3 | None, known: list[Rigid3]) -> bool:
    """Return whether a pose is far from each known one in position or in angle."""
    if pose is None:
        return False
    errors = [one.inverse() @ pose for one in known]
    return all(
        np.linalg.norm(error.translation) > FAR_METRES or np.rad2deg(error.angle()) > FAR_DEGREES
        for error in errors
    )


def floors(bench: Bench) -> Iterator[Figure]:
    """Colours of this floor and of other floors of the same building (other seeds)."""
    path = bench.map("corridor1", bench.render("corridor1_map"))
    out = bench.folder() / "floors.jsonl"
    out.unlink(missing_ok=True)
    own = [bench.render(f"corridor1_{light}") for light in ("day", "evening", "night")]
    others = [bench.render(name) for name in ("corridor2_day", "corridor2_night", "corridor3_day")]
    bench.plain("floors", "ask", path, *own, "--out", out)
    bench.plain("floors", "ask", path, *others, "--out", out, "--other")
    for name, row in bench.script("floors", "judge", out).items():
        rule = "at least" if name == "all own" else "at most"
        columns = [column for column in row if column.endswith(("now", "setting"))]
        yield from figures_of(name, row, dict.fromkeys(columns, rule))


def aliased(bench: Bench) -> Iterator[Figure]:
    """Images and a stream along a wall of equal panels."""
    words = (bench.render("hospital1_map"), bench.render("hospital1_query"), "--seed", 1)
    found = bench.script("aliased_place", *words)
    rules = {"ambiguous_with_truth": "at least", "one_panel_off": "at most"}
    for name in ("alone", "stream"):
        row = {key: value for key, value in found[name].items() if not isinstance(value, dict)}
        yield from figures_of(name, row, rules)


def reverse(bench: Bench) -> Iterator[Figure]:
    """A corridor mapped in one direction and walked in the other."""
    words = (bench.render("corridor1_map"), bench.render("corridor1_reverse"))
    found = bench.script("other_way", *words)
    row = found["with side nodes"]
    columns = {key: row[key] for key in ("answered", "right", "far_off", "median_m")}
    yield from figures_of(f"of {found['seen_twice']} seen twice", columns, {"far_off": "at most"})


def inputs(bench: Bench) -> Iterator[Figure]:
    """Images as people hand them in: a row for each situation, of all places together."""
    words = ("--shared", bench.shared, "--num", 10)
    found = bench.script("inputs", *words)
    total: dict[str, Counter[str]] = {}
    for answers in found.values():
        for situation, of_images in answers.items():
            total.setdefault(situation, Counter()).update(_verdicts(of_images))
    for situation, row in total.items():
        columns = {key: row[key] for key in ("images", "right", "wrong, p > .5", "wrong, p > .9")}
        rules = {"wrong, p > .5": "at most", "wrong, p > .9": "at most"}
        yield from figures_of(situation, columns, rules, slack=2)


def _verdicts(of_images: Mapping[str, Mapping[str, Any]]) -> Counter[str]:
    """Count the answers of one situation in one place."""
    from inputs import is_right

    counts: Counter[str] = Counter(images=len(of_images))
    for answer in of_images.values():
        right = is_right(dict(answer))
        counts["right"] += right
        for least in (0.5, 0.9):
            counts[f"wrong, p > {f'{least:.1f}'[1:]}"] += not right and answer["p"] > least
    return counts


def calibration(bench: Bench) -> Iterator[Figure]:
    """Verdicts of successive images on right and wrong calibrations."""
    kitchen60 = bench.map("kitchen60", bench.data(f"{KITCHEN}@0-59/100"))
    places = {
        "kitchen60": (kitchen60, f"{KITCHEN}@60-99/100", 5),
        "lab": (bench.map("lab", bench.data("demo:map_lap1")), "demo:day", 1),
    }
    for name, (path, recording, every) in places.items():
        words = (path, bench.data(recording), "--every", every)
        for num, row in bench.script("calibration_verdict", *words).items():
            columns = {"accused": row["accused"], "named": row["named"]}
            yield from figures_of(f"{name}, {num} images", columns, slack=2)


def wrong_recordings(bench: Bench) -> Iterator[Figure]:
    """Wrong and right variants of recordings, by the checks before SLAM and mapping."""
    found = bench.script("wrong_recordings", "--checks", "--shared", bench.shared)
    for group, rule in (("wrong", "at least"), ("right", "at most")):
        statuses = Counter(
            row["status"] for name, row in found.items() if name.startswith(f"{group}, ")
        )
        reported = statuses["refused"] + statuses["warned"]
        columns = {"variants": statuses.total(), "reported": reported}
        yield from figures_of(group, columns, {"reported": rule})
        yield from figures_of(group, {"traceback": statuses["traceback"]}, {"traceback": "at most"})


def streams(bench: Bench) -> Iterator[Figure]:
    """Streams of the kitchen, the ZED camera and the demo."""
    rules = {"beyond_50_cm": "at most", "jitter_ratio": "median"}
    for name, row in bench.script("streams", "--shared", bench.shared).items():
        yield from figures_of(name, row, rules)


def _rows(place: str, found: Mapping[str, Mapping[str, float]]) -> Iterator[Figure]:
    """Return the figures of `exactness.py`, rows without the digest of a render."""
    for name, row in found.items():
        recording, _, exact = name.rpartition(", ")
        recording = recording.rpartition("-")[0] if "-" in recording else recording
        asked = "" if recording.startswith(KITCHEN.rpartition("/")[2] + "@") else f", {recording}"
        yield from figures_of(f"{place}{asked}, {exact}", row)
