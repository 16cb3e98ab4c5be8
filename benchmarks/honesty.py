"""Measure uncertainty, ambiguity and other cameras, beside the requirements.

    python benchmarks/honesty.py [--shared ../shared] [--rendered FOLDER] [--step 3] [--features
    surf|learned|both]

The places are those of `real_recordings.py`, a map of a third of the kitchen, and the demo's lab.
FOLDER may hold recordings by `topoloc simulate`: `corridor_map`, `corridor_day`, `corridor_night`.
`--step 3` localizes every third query. Longer focal lengths are centre crops, enlarged to the size
of the whole. Shorter ones (x 0.6) are smaller images, because no image holds more than was
recorded. All have the matching intrinsics.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from real_recordings import PLACES, Place
from topoloc.apps.cli.features_option import open_localizer
from topoloc.demo.recordings import SHIPPED
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.config import EvidenceConfig
from topoloc.localization.evidence import compute_translation_tolerance
from topoloc.localization.localizer import Localizer, LocalizerConfig
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.query import QueryImage
from topoloc.localization.result import Localization, NotLocalized
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.nodes import NodeConfig
from topoloc.recordings.open import open_sequence
from topoloc_paper.fit.corpus import read_rigid
from topoloc_paper.fit.pictures import darkened, drawn_pictures

BEYOND = Place(
    "kitchen, beyond the map", "seven_scenes/kitchen@0:120", "seven_scenes/kitchen@120::2", 0.5
)
CHI_SQUARE_6_AT_95 = 12.592
FACTORS = (0.6, 1.3, 1.8)
NUM_DRAWN, NUM_ELSEWHERE = 60, 25


@dataclass
class Asked:
    """Queries of one kind: how many, and of those answered the probability, whether it is right,
    and the squared error in sigmas."""

    num: int = 0
    probability: list[float] = field(default_factory=list)
    is_right: list[bool] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)
    metres: list[float] = field(default_factory=list)
    is_far_off: list[bool] = field(default_factory=list)

    def add(self, answer: tuple[Localization | NotLocalized, float], truth: Rigid3 | None) -> None:
        result, depth = answer
        self.num += 1
        if not isinstance(result, Localization):
            return
        self.probability.append(result.probability)
        if truth is None:
            self.is_right.append(False)
            return
        error = result.world_from_cam.inverse() @ truth
        metres, degrees = float(np.linalg.norm(error.translation)), float(np.rad2deg(error.angle()))
        xi = (truth @ result.world_from_cam.inverse()).log()
        self.metres.append(metres)
        self.is_right.append(
            metres < compute_translation_tolerance(depth, EvidenceConfig()) and degrees < 2.0
        )
        self.is_far_off.append(metres > 0.5 or degrees > 10.0)
        if not self.is_far_off[-1]:
            self.squares.append(float(xi @ np.linalg.solve(result.covariance, xi)))

    @property
    def share(self) -> float:
        return 100.0 * len(self.probability) / max(self.num, 1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--shared", type=Path, default=Path(os.environ.get("TOPOLOC_SHARED", "../shared"))
    )
    parser.add_argument("--rendered", type=Path)
    parser.add_argument("--step", type=int, default=3)
    parser.add_argument(
        "--features",
        help="of the maps' kinds of features those that are asked, as of `topoloc localize`",
    )
    arguments = parser.parse_args()
    data = arguments.shared.resolve() / "data"
    places = [place for place in PLACES if "30 of 50" not in place.name] + [BEYOND]
    places += [
        Place(f"lab, {light}", str(SHIPPED / "map_lap1"), str(SHIPPED / light))
        for light in ("day", "night")
    ]
    if arguments.rendered:
        folder = arguments.rendered.resolve()
        rendered = [
            Place(f"corridor, {light}", f"{folder}/corridor_map", f"{folder}/corridor_{light}")
            for light in ("day", "night")
        ]
        places += [
            place
            for place in rendered
            if Path(place.queries).is_dir()
            or print(f"left out: {place.queries}, which is not there")
        ]
    groups: dict[str, Asked] = {}
    topomap, mapped = None, ""
    for place in places:
        if place.mapping != mapped or topomap is None:
            topomap, mapped = (
                build_map(
                    open_sequence(data / place.mapping),
                    BuildConfig(nodes=NodeConfig(d_thresh=place.d_thresh)),
                ),
                place.mapping,
            )
        localizer = open_localizer(topomap, LocalizerConfig(), arguments.features)
        ask_place(place, places, localizer, data, arguments.step, groups)
        for name, asked in groups.items():
            if name.startswith(place.name):
                print(line(name, asked), flush=True)
    summary(groups)


def ask_place(
    place: Place,
    places: list[Place],
    localizer: Localizer,
    data: Path,
    step: int,
    groups: dict[str, Asked],
) -> None:
    """Own queries as they are, dark, by other cameras; then queries from elsewhere."""
    world_from_truth = (
        read_rigid(data / place.map_from_truth) if place.map_from_truth else Rigid3.identity()
    )
    sequence = open_sequence(data / place.queries)

    def asked(kind: str) -> Asked:
        return groups.setdefault(f"{place.name}: {kind}", Asked())

    for i in range(0, len(sequence), step):
        frame = sequence[i]
        assert frame.world_from_cam is not None
        assert frame.camera is not None
        truth, image, camera = world_from_truth @ frame.world_from_cam, frame.image, frame.camera
        asked("as it is").add(answer(localizer, image, camera), truth)
        asked("dark").add(answer(localizer, darkened(image, 0.6, i), camera), truth)
        if "night" in place.name or place == BEYOND:
            continue
        for factor in FACTORS:
            asked(f"focal x {factor}").add(answer(localizer, *zoomed(image, camera, factor)), truth)
        turned = Rigid3(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
        asked("rolled 90").add(answer(localizer, *rolled(image, camera)), truth @ turned.inverse())
        asked("focal unknown").add(
            answer(localizer, image, UncalibratedCamera.unknown(camera.width, camera.height)), truth
        )
    for other in places:
        if family_of(other.name) != family_of(place.name):
            foreign = open_sequence(data / other.queries)
            for i in np.unique(np.linspace(0, len(foreign) - 1, NUM_ELSEWHERE).astype(int)):
                frame = foreign[int(i)]
                assert frame.camera is not None
                asked("from elsewhere").add(answer(localizer, frame.image, frame.camera), None)
    camera = Camera.pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
    for picture in [*drawn_pictures(NUM_DRAWN), np.zeros((480, 640), np.uint8)]:
        asked("from elsewhere").add(answer(localizer, picture, camera), None)


def answer(
    localizer: Localizer, image: np.ndarray, camera: Camera | UncalibratedCamera
) -> tuple[Localization | NotLocalized, float]:
    """The result, and the median distance (metres) of the points that it stands on."""
    result, named = localizer.localize_query(QueryImage(image, camera))
    if not isinstance(result, Localization):
        return result, 0.0
    ((_, seen),) = named
    return result, float(np.median(result.world_from_cam.inverse().apply(seen.points_world)[:, 2]))


def zoomed(image: np.ndarray, camera: Camera, factor: float) -> tuple[np.ndarray, Camera]:
    """As a camera of another focal length (pixels) takes it: the crop of its field, enlarged to the
    old size; or a smaller picture."""
    if factor < 1.0:
        width, height = round(camera.width * factor), round(camera.height * factor)
        return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), camera.rescaled(
            width, height
        )
    width, height = round(camera.width / factor), round(camera.height / factor)
    x, y = (camera.width - width) // 2, (camera.height - height) // 2
    crop = Camera.pinhole(width, height, camera.fx, camera.fy, camera.cx - x, camera.cy - y)
    enlarged = cv2.resize(
        image[y : y + height, x : x + width],
        (camera.width, camera.height),
        interpolation=cv2.INTER_CUBIC,
    )
    return enlarged, crop.rescaled(camera.width, camera.height)


def rolled(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """The picture turned clockwise: (x, y) goes to (height - 1 - y, x), as by a camera rolled the
    other way."""
    turned = np.ascontiguousarray(np.rot90(image, -1))
    return turned, Camera.pinhole(
        camera.height, camera.width, camera.fy, camera.fx, camera.height - 1 - camera.cy, camera.cx
    )


def line(name: str, asked: Asked) -> str:
    far = sum(asked.is_far_off)
    inside = (
        f"{100 * np.mean(np.array(asked.squares) < CHI_SQUARE_6_AT_95):.0f} % inside"
        if asked.squares
        else ""
    )
    metres = f"{100 * np.median(asked.metres):.2f} cm" if asked.metres else ""
    return (
        f"{name:50s} {len(asked.probability)} of {asked.num} localized ({asked.share:.1f} %) "
        f" {metres}  {inside}  far off: {far}"
    )


def summary(groups: dict[str, Asked]) -> None:
    """Print all places together, beside the requirements."""

    def of(kind: str, but: str = "nothing") -> list[Asked]:
        return [
            asked
            for name, asked in groups.items()
            if name.endswith(": " + kind) and but not in name
        ]

    elsewhere, own, dark = of("from elsewhere"), of("as it is"), of("dark")
    false, num = sum(len(a.probability) for a in elsewhere), sum(a.num for a in elsewhere)
    print(
        f"\nfrom elsewhere: {false} of {num} accepted ({100 * false / num:.2f} %); asked: <= 0.5 %"
        " of >= 500"
    )
    day = [
        asked
        for name, asked in groups.items()
        if name.endswith(": as it is") and "night" not in name and "beyond" not in name
    ]
    print(
        "by day in the map:"
        f" {100 * sum(len(a.probability) for a in day) / sum(a.num for a in day):.1f} % accepted;"
        " asked: >= 95 %"
    )
    answered = [*own, *dark, *elsewhere]
    probability = np.array([p for a in answered for p in a.probability])
    right = np.array([r for a in answered for r in a.is_right])
    print(
        f"calibration error of the answers: {calibration_error(probability, right):.3f}; asked: <="
        " 0.05"
    )
    num_refused = sum(a.num - len(a.probability) for a in answered)
    auroc = separation(
        np.append(probability, np.zeros(num_refused)), np.append(right, np.zeros(num_refused, bool))
    )
    print(f"AUROC of failure, refusals at probability 0: {auroc:.4f}; asked: >= 0.97")
    squares = np.array([s for a in [*own, *dark] for s in a.squares])
    print(
        f"errors inside the 95 % ellipsoid: {100 * np.mean(squares < CHI_SQUARE_6_AT_95):.1f} %;"
        " asked: 88 to 99 %"
    )
    print(
        f"far off (0.5 m or 10 deg): {sum(sum(a.is_far_off) for a in groups.values())} answers"
        " of all"
    )
    usual = sum(len(a.probability) for a in day)
    for kind, wanted in [
        *((f"focal x {factor}", 90) for factor in FACTORS),
        ("rolled 90", 90),
        ("focal unknown", 80),
    ]:
        share = 100 * sum(len(a.probability) for a in of(kind)) / usual
        print(f"{kind}: {share:.1f} % of what the map's camera localizes; asked: >= {wanted} %")


def family_of(name: str) -> str:
    """Maps and queries of one place go together."""
    return name.split(",")[0]


def calibration_error(probability: np.ndarray, y: np.ndarray, num_bins: int = 10) -> float:
    """Return the expected calibration error: the mean distance of the probability from the share of
    right answers."""
    bins = np.minimum((probability * num_bins).astype(int), num_bins - 1)
    errors = [
        abs(probability[bins == k].mean() - y[bins == k].mean()) * np.mean(bins == k)
        for k in range(num_bins)
        if np.any(bins == k)
    ]
    return float(sum(errors))


def separation(probability: np.ndarray, is_right: np.ndarray) -> float:
    """Area under the ROC curve: how often a right answer is the more probable one of a right and a
    wrong one; a tie is half."""
    right, wrong = (
        probability[is_right.astype(bool)][:, None],
        probability[~is_right.astype(bool)][None],
    )
    return float(np.mean((right > wrong) + 0.5 * (right == wrong)))


if __name__ == "__main__":
    main()
