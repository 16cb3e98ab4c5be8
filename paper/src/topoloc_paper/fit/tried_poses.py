"""Collect every tested pose of an image, also unreported ones, with its evidence and its error."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topoloc.features.feature_types import FeatureConfig
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.config import EvidenceConfig
from topoloc.localization.evidence import compute_translation_tolerance
from topoloc.localization.fitted_weights import NodeStop
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.provenance import Evidence
from topoloc.localization.search import Trace
from topoloc.mapping.build import BuildConfig
from topoloc.mapping.config import VirtualNodesConfig
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import StereoSequence
from topoloc_paper.fit.corpus import GAMMAS, AskedPlace, read_rigid
from topoloc_paper.fit.pictures import darkened, drawn_pictures

ASKED = EvidenceConfig()
_NUM_DRAWN = 25


@dataclass(frozen=True)
class TriedPose:
    """Hold a tested pose of an image, and its evidence.

    `error_m` and `error_deg` are None for an out-of-map image. `depth` is the median distance
    (metres) of the pose's points. `first_evidence` is the evidence of its first matches, None if
    these were guided. `square` is its squared error in standard deviations, with a covariance that
    takes all matches as independent. `rho` is the error share that the map's points have in common.
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
    square: float | None
    rho: float

    @property
    def is_right(self) -> bool:
        if self.error_m is None or self.error_deg is None:
            return False
        return (
            self.error_m < compute_translation_tolerance(self.depth, ASKED)
            and self.error_deg < ASKED.max_rotation_deg
        )

    @property
    def is_wrong(self) -> bool:
        return (
            self.error_m is None
            or self.error_deg is None
            or self.error_m >= 0.5
            or self.error_deg >= 10.0
        )

    @property
    def picture(self) -> tuple[str, str, int, str]:
        return (self.mapping, self.queries, self.index, self.light)


def ask_place(
    place: AskedPlace, recordings: dict[str, StereoSequence], data: Path, kind: str, step: int
) -> list[TriedPose]:
    """Return every tested pose in the place's map of one feature type, none if the recording is
    missing.

    Args:
        step: query only every `step`-th image.
    """
    if place.mapping not in recordings:
        return []
    poses: list[TriedPose] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "place.topo"
        sides = VirtualNodesConfig() if place.asks_walls else VirtualNodesConfig(spacing=0.0)
        config = BuildConfig(features=FeatureConfig(kind=kind), other_kinds=(), sides=sides)
        build_map(recordings[place.mapping], config).save(path)
        topomap = TopoMetricMap.load(path)
        # A fit needs wrong poses, which the stop leaves untried.
        weights = replace(Localizer(topomap).context.first.weights, stop=NodeStop())
        localizer = Localizer(topomap, weights=weights)
        world_from_truth = (
            read_rigid(data / place.map_from_truth) if place.map_from_truth else Rigid3.identity()
        )
        for name, index, frame in _frames(place.own, recordings, step):
            truth = world_from_truth @ frame.world_from_cam
            for light, gamma in GAMMAS.items():
                if gamma is None or place.is_darkened:
                    image = frame.image if gamma is None else darkened(frame.image, gamma, index)
                    poses += _tried(
                        localizer, image, frame.camera, truth, (place.mapping, name, index, light)
                    )
        for name, index, frame in _frames(place.others, recordings, step):
            poses += _tried(
                localizer, frame.image, frame.camera, None, (place.mapping, name, index, "as it is")
            )
        camera = Camera.pinhole(640, 480, 525.0, 525.0, 319.5, 239.5)
        for index, image in enumerate(drawn_pictures(_NUM_DRAWN)[::step] if place.others else []):
            poses += _tried(
                localizer, image, camera, None, (place.mapping, "drawn", index, "as it is")
            )
    return poses


def save_poses(poses: list[TriedPose], path: Path) -> None:
    path.write_text(json.dumps([asdict(pose) for pose in poses]), encoding="utf-8")


def load_poses(path: Path) -> list[TriedPose]:
    """Read the poses that `save_poses` wrote."""

    def evidence(saved: dict[str, Any] | None) -> Evidence | None:
        return None if saved is None else Evidence(**saved)

    read = json.loads(path.read_text(encoding="utf-8"))
    return [
        TriedPose(**row | {key: evidence(row[key]) for key in ("evidence", "first_evidence")})
        for row in read
    ]


def _frames(
    asked: dict[str, int], recordings: dict[str, StereoSequence], step: int
) -> Iterator[tuple[str, int, Any]]:
    for name, every in asked.items():
        if name in recordings:
            for index in range(0, len(recordings[name]), every * step):
                yield name, index, recordings[name][index]


def _tried(
    localizer: Localizer,
    image: np.ndarray,
    camera: Camera,
    world_from_cam: Rigid3 | None,
    picture: tuple[str, str, int, str],
) -> Iterator[TriedPose]:
    """`world_from_cam` is the truth, in the map's world; None for a picture from elsewhere."""
    trace = Trace()
    localizer.localize(image, camera, trace=trace)
    rho = localizer.context.first.correlated_errors
    for tried in trace.tried:
        if (
            tried.hypothesis is None or tried.source == "repetition"
        ):  # that counts the matches of another pose
            continue
        final, evidence = tried.hypothesis.fit, tried.hypothesis.evidence
        first_evidence = None
        if tried.source not in ("viewpoints", "walls"):
            first_evidence = replace(
                evidence, num_matches=len(tried.first.matches), num_inliers=tried.first.num_inliers
            )
        cam_from_world, error_m, error_deg, square = final.pose.cam_from_world, None, None, None
        if world_from_cam is not None:
            error = cam_from_world @ world_from_cam
            error_m, error_deg = (
                float(np.linalg.norm(error.translation)),
                math.degrees(error.angle()),
            )
            xi = error.log()
            square = float(xi @ np.linalg.solve(final.pose.covariance, xi))
        points_world = final.local_map.points_world[final.inlier_point_idx]
        depth = float(np.median(cam_from_world.apply(points_world)[:, 2]))
        yield TriedPose(*picture, error_m, error_deg, depth, evidence, first_evidence, square, rho)
