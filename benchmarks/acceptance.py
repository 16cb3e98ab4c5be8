"""Fit the weights of `localization/evidence.py` anew, and try them on places that they were not fitted on.

    python benchmarks/acceptance.py [--shared ../shared] [--rendered FOLDER] [--step N] [--save FILE] [--load FILE]

Each place is asked about its own pictures (in good light and bad), about those of other places and about drawn pictures; every pose
that was tried and weighed is kept, not only the one answered. It is right within 0.25 m (5 % of the distance, where that is less) and
2 degrees, wrong beyond 0.5 m or 10 degrees; what lies between is left out. The walls to both sides (`walls.py`) are not asked:
their poses have weights of their own. Nor is the weight of the doubt fitted, see `evidence.py`.

FOLDER holds recordings of `topoloc simulate` (docs/benchmarks.md says how each was made); what is missing is left out, with a line.
With --step N only every N-th of the pictures is asked, with the same maps. --save keeps the poses for `rival_weights.py`; --load fits
to poses that were kept.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from real_recordings import darkened, drawn_pictures, read_rigid
from topoloc.errors import RecordingError
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.evidence import Evidence, EvidenceConfig, log_odds_of, score_features, tolerated_translation
from topoloc.localization.fitted_weights import weights_of
from topoloc.localization.localizer import Localizer
from topoloc.localization.trace import Trace
from topoloc.map.build import BuildConfig, build_map
from topoloc.map.side_nodes import SideNodesConfig
from topoloc.map.topomap import TopoMetricMap
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.open import open_sequence

IN_USE, TOLERATED = weights_of("surf"), EvidenceConfig()
COLUMNS = ("even share", "chance", "inliers", "inlier share", "spread", "bias")
KITCHEN, ZED = "seven_scenes/kitchen@60-99/100", "zed_lab/session2@0:99"
STREET_1, STREET_2 = "kitti/sequences/street1@1::2", "kitti/sequences/street2@1::2"
FAMILIES = {"corridor": "corridor", "lab": "lab", "street": "street", "seven_scenes": "kitchen", "zed_lab": "ZED lab", "kitti": "KITTI"}
GAMMAS = {"as it is": None, "dark": 0.6, "darker": 1 / 0.6}


@dataclass(frozen=True)
class AskedPlace:
    """A map, and of each recording every how manieth picture it is asked about. A name without a slash is that of a rendered recording."""

    mapping: str
    own: dict[str, int]
    others: dict[str, int] = field(default_factory=dict)
    """Pictures from elsewhere; drawn ones with them."""
    is_darkened: bool = False
    map_from_truth: str | None = None


PLACES = (
    AskedPlace(
        "corridor_map",
        {"corridor_night": 1, "corridor_evening": 1, "corridor_day": 6},
        {"lab_night": 3, "street_rain": 8, KITCHEN: 12, ZED: 10, STREET_1: 8},
    ),
    AskedPlace("corridor_map@0:268", {"corridor_reverse": 1}),  # one lap, in one direction
    AskedPlace("lab_map", {"lab_night": 1}, {"corridor_night": 4, KITCHEN: 12, ZED: 10, "street_cloudy": 10}),
    AskedPlace(
        "street_map",
        {"street_cloudy": 2, "street_rain": 2, "street_clear": 5, "street_reverse": 3},
        {"corridor_night": 8, "lab_night": 8, STREET_1: 4, STREET_2: 4, ZED: 10},
    ),
    AskedPlace("seven_scenes/kitchen@0-59/100", {KITCHEN: 6}, {"corridor_night": 8, ZED: 5, "lab_night": 8, STREET_1: 8}, True),
    AskedPlace(
        "zed_lab/session1",
        {ZED: 4},
        {KITCHEN: 8, "lab_night": 4, "corridor_night": 8, STREET_2: 8},
        True,
        "zed_lab/session1_from_session2.json",
    ),
    AskedPlace("kitti/sequences/street1@0::2", {STREET_1: 3}, {KITCHEN: 10, "street_cloudy": 4, "corridor_night": 10, ZED: 8}, True),
    AskedPlace("kitti/sequences/street2@0::2", {STREET_2: 3}, {KITCHEN: 10, "street_rain": 4, "corridor_night": 10, "lab_night": 10}, True),
)


@dataclass(frozen=True)
class TriedPose:
    """A pose that a picture led to, and what spoke for it.

    `error_m`, `error_deg`: None for a picture from elsewhere. `depth`: median distance (metres) of the points that it stands on.
    `first_evidence`: the same with the matches that it came from and their own inliers; None where these were guided.
    """

    mapping: str
    queries: str
    index: int
    light: str
    error_m: float | None
    error_deg: float | None
    depth: float
    evidence: Evidence
    first_evidence: Evidence | None

    @property
    def is_right(self) -> bool:
        if self.error_m is None or self.error_deg is None:
            return False
        return self.error_m < tolerated_translation(self.depth, TOLERATED) and self.error_deg < TOLERATED.max_rotation_deg

    @property
    def is_wrong(self) -> bool:
        return self.error_m is None or self.error_deg is None or self.error_m >= 0.5 or self.error_deg >= 10.0

    @property
    def picture(self) -> tuple[str, str, int, str]:
        return (self.mapping, self.queries, self.index, self.light)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared")))
    parser.add_argument("--rendered", type=Path)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--save", type=Path)
    parser.add_argument("--load", type=Path)
    arguments = parser.parse_args()
    if arguments.load:
        poses = load_poses(arguments.load)
    else:
        recordings = open_all(arguments.shared.resolve() / "data", arguments.rendered)
        poses = [pose for place in PLACES for pose in ask_place(place, recordings, arguments.shared.resolve() / "data", arguments.step)]
    if arguments.save:
        arguments.save.write_text(json.dumps([asdict(pose) for pose in poses]))
    report(poses)


def open_all(data: Path, rendered: Path | None) -> dict[str, StereoSequence]:
    """The recordings by their names; a line for each that is missing."""
    recordings: dict[str, StereoSequence] = {}
    for name in dict.fromkeys(name for place in PLACES for name in (place.mapping, *place.own, *place.others)):
        if "/" not in name and rendered is None:
            print(f"left out: {name}, which is rendered (--rendered FOLDER)")
            continue
        try:
            recordings[name] = open_sequence((data if "/" in name or rendered is None else rendered.resolve()) / name)
        except RecordingError as error:
            print(f"left out: {error}")
    return recordings


def ask_place(place: AskedPlace, recordings: dict[str, StereoSequence], data: Path, step: int) -> list[TriedPose]:
    """Every pose that the place's map leads to; none where its recording is missing."""
    if place.mapping not in recordings:
        return []
    poses: list[TriedPose] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "place.topo"
        build_map(recordings[place.mapping], BuildConfig(sides=SideNodesConfig(spacing=0.0))).save(path)
        localizer = Localizer(TopoMetricMap.load(path))
        world_from_truth = read_rigid(data / place.map_from_truth) if place.map_from_truth else Rigid3.identity()
        for name, index, frame in _frames(place.own, recordings, step):
            assert frame.world_from_cam is not None
            truth = world_from_truth @ frame.world_from_cam
            for light, gamma in GAMMAS.items():
                if gamma is None or place.is_darkened:
                    image = frame.image if gamma is None else darkened(frame.image, gamma, index)
                    poses += _tried(localizer, image, frame.camera, truth, (place.mapping, name, index, light))
        for name, index, frame in _frames(place.others, recordings, step):
            poses += _tried(localizer, frame.image, frame.camera, None, (place.mapping, name, index, "as it is"))
        camera = Camera.pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
        for index, image in enumerate(drawn_pictures(25)[::step] if place.others else []):
            poses += _tried(localizer, image, camera, None, (place.mapping, "drawn", index, "as it is"))
        print(f"{place.mapping}: {len(poses)} poses of {len({pose.picture for pose in poses})} pictures", flush=True)
    return poses


def _frames(asked: dict[str, int], recordings: dict[str, StereoSequence], step: int) -> Iterator[tuple[str, int, Any]]:
    for name, every in asked.items():
        if name in recordings:
            for index in range(0, len(recordings[name]), every * step):
                yield name, index, recordings[name][index]


def _tried(
    localizer: Localizer, image: np.ndarray, camera: Camera, world_from_cam: Rigid3 | None, picture: tuple[str, str, int, str]
) -> Iterator[TriedPose]:
    """`world_from_cam` is the truth, in the map's world; None for a picture from elsewhere."""
    trace = Trace()
    localizer.localize(image, camera, trace=trace)
    for tried in trace.tried:
        if tried.hypothesis is None:
            continue
        final, evidence = tried.hypothesis.fit, tried.hypothesis.evidence
        assert final.pose is not None
        first_evidence = None
        if tried.source != "viewpoints":
            first_evidence = replace(evidence, num_matches=len(tried.first.matches), num_inliers=tried.first.num_inliers)
        cam_from_world, error_m, error_deg = final.pose.cam_from_world, None, None
        if world_from_cam is not None:
            error = cam_from_world @ world_from_cam
            error_m, error_deg = float(np.linalg.norm(error.translation)), math.degrees(error.angle())
        points_world = final.local_map.points_world[final.matches.train_idx[final.pose.inliers]]
        depth = float(np.median(cam_from_world.apply(points_world)[:, 2]))
        yield TriedPose(*picture, error_m, error_deg, depth, evidence, first_evidence)


def load_poses(path: Path) -> list[TriedPose]:
    def evidence(saved: dict[str, Any] | None) -> Evidence | None:
        return None if saved is None else Evidence(**saved)

    read = json.loads(path.read_text())
    return [TriedPose(**row | {key: evidence(row[key]) for key in ("evidence", "first_evidence")}) for row in read]


def report(poses: list[TriedPose]) -> None:
    num_between = sum(not pose.is_right and not pose.is_wrong for pose in poses)
    poses = [pose for pose in poses if pose.is_right or pose.is_wrong]
    if len({pose.is_right for pose in poses}) < 2:
        raise SystemExit("right and wrong poses are needed, and there are not both")
    x, y = np.array([score_features(pose.evidence) for pose in poses]), np.array([pose.is_right for pose in poses])
    print(f"{len(y)} poses, {y.sum()} of them right; {num_between} more are neither right nor wrong")
    in_use = np.array([*IN_USE.evidence.in_order[:-1], IN_USE.evidence.bias])
    print(f"{'':20}" + "".join(f"{name:>14}" for name in COLUMNS))
    for name, weights in (("fitted", fit(x, y)), ("its std. deviation", deviation(x, y, poses)), ("in use", in_use)):
        print(f"{name:20}" + "".join(f"{weight:14.2f}" for weight in weights))
    odds_in_use = log_odds(x, in_use)
    of_map = np.array([FAMILIES[family_key(pose.mapping)] for pose in poses])
    of_queries = np.array([FAMILIES.get(family_key(pose.queries), "drawn") for pose in poses])
    for family in dict.fromkeys(of_map):
        here, rest = of_map == family, (of_map != family) & (of_queries != family)
        print(f"{family}: in use {verdict(odds_in_use[here], y[here])}")
        if len(set(y[rest])) == 2:
            print(f"{'':{len(family)}}  fitted without it {verdict(log_odds(x[here], fit(x[rest], y[rest])), y[here])}")
    elsewhere = [odds for odds, pose in zip(odds_in_use, poses, strict=True) if pose.error_m is None]
    if elsewhere:
        print(f"the most probable of {len(elsewhere)} poses of pictures from elsewhere: {1 / (1 + math.exp(-max(elsewhere))):.2f}")
    first = [log_odds_of(pose.first_evidence, IN_USE) for pose in poses if pose.is_wrong and pose.first_evidence]
    clearest = f"{max(odds_in_use[~y]):.1f}" + (f", by its first matches {max(first):.1f}" if first else "")
    print(f"log odds of the clearest wrong pose: {clearest}; clear is what has more than {IN_USE.evidence.clear_log_odds}")


def family_key(name: str) -> str:
    return next((prefix for prefix in FAMILIES if name.startswith(prefix)), name)


def log_odds(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """`weights` are those of all but the doubt (last in `x`), whose weight is given, and the bias."""
    return x[:, :-1] @ weights[:-1] + weights[-1] + IN_USE.evidence.doubt * x[:, -1]


def fit(x: np.ndarray, y: np.ndarray, counts: np.ndarray | None = None) -> np.ndarray:
    """Logistic regression, lightly shrunk; nothing that speaks for a pose may count against it. Each pose counts `counts` times."""
    signs, counts = 2 * y - 1, np.ones(len(y)) if counts is None else counts

    def loss(weights: np.ndarray) -> float:
        return float(counts @ np.logaddexp(0.0, -signs * log_odds(x, weights)) + 5e-4 * len(y) * np.sum(weights[:-1] ** 2))

    num = x.shape[1] - 1
    return minimize(loss, np.full(num + 1, 0.1), bounds=[(0.0, None)] * num + [(None, None)], method="L-BFGS-B").x


def deviation(x: np.ndarray, y: np.ndarray, poses: list[TriedPose], num_rounds: int = 20) -> np.ndarray:
    """Standard deviation of the fitted weights, from pictures drawn anew: poses of one picture are not independent."""
    numbers = {picture: i for i, picture in enumerate(dict.fromkeys(pose.picture[:3] for pose in poses))}
    of_picture, rng = np.array([numbers[pose.picture[:3]] for pose in poses]), np.random.default_rng(0)
    drawn = rng.multinomial(len(numbers), np.full(len(numbers), 1.0 / len(numbers)), size=num_rounds)
    return np.std([fit(x, y, counts[of_picture].astype(float)) for counts in drawn], axis=0)


def verdict(odds: np.ndarray, y: np.ndarray) -> str:
    probability, wrong, lost = 1.0 / (1.0 + np.exp(-odds)), np.sum((odds > 0) & ~y), np.sum((odds <= 0) & y)
    bins = np.minimum((probability * 10).astype(int), 9)
    error = sum(abs(np.sum(probability[bins == k] - y[bins == k])) for k in range(10)) / len(y)
    return f"accepts {wrong} of {np.sum(~y)} wrong, loses {lost} of {np.sum(y)} right, calibration error {error:.3f}"


if __name__ == "__main__":
    main()
