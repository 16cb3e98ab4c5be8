"""Measure recall of the coarse search before and after differences of place vectors between lights
are reduced.

    python benchmarks/session_light.py [--kinds surf topoloc-net]

As in growing maps, vocabulary and whitening are learned from the first walk, and the second one
joins. `gardenspoint` is one path by day, beside it by day, and by night. Images of equal numbers
show the same place, a hit is within two. The night covers the whole path, a quarter of it, or one
half with queries in the other half. The demo's lab (rendered) has a day's lap and half of a night's
images, and the rest are queries. A hit is within 30 cm and 20 degrees. Walks by one light stay
unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import tyro

from topoloc.features.extraction import extract_features
from topoloc.features.feature_types import FeatureConfig
from topoloc.features.features import Features
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.coarse_models import (
    compute_illumination_distance,
    group_by_illumination,
)
from topoloc.mapping.config import MapConfig
from topoloc.mapping.storage.entries import (
    Illumination,
    Session,
    average_illumination,
)
from topoloc.recordings.frame import to_grey
from topoloc.recordings.image_io import read_image
from topoloc.recordings.open import open_sequence
from topoloc.retrieval.vlad import SurfVlad, append_positions, learn_words, vlad

SHARED = Path(os.environ.get("TOPOLOC_SHARED", Path(__file__).parents[2] / "shared"))
LAB = Path(__file__).parents[1] / "src/topoloc/demo/lab"
_WIDTH_PX, _NEAR_FRAMES, _NEAR_M, _NEAR_DEG = 640, 2, 0.3, 20.0
_FIRST = (1, 4, 16)


@dataclass(frozen=True, eq=False)
class View:
    """Hold an image's data for the coarse search, and its place: its number, or a pose."""

    features: Features
    size: tuple[int, int]
    light: Illumination
    place: int | Rigid3


@dataclass(frozen=True)
class Args:
    kinds: tuple[str, ...] = ("surf", "topoloc-net")


@cache
def walk(name: str, kind: str) -> list[View]:
    """Of a folder of the shared recordings, or of the demo's lab."""
    if name.startswith("lab/"):
        sequence = open_sequence(LAB / name.removeprefix("lab/"))
        pictures = [
            (sequence[k].image, pose) for k, pose in enumerate(sequence.poses) if pose is not None
        ]
    else:
        pictures = [
            (read_image(path), k)
            for k, path in enumerate(sorted((SHARED / "data" / name).glob("*.jpg")))
        ]
    return [_view(picture, place, kind) for picture, place in pictures]


def _view(picture: np.ndarray, place: int | Rigid3, kind: str) -> View:
    scale = _WIDTH_PX / picture.shape[1]
    if scale < 1.0:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    features = extract_features(to_grey(picture), FeatureConfig(kind=kind))
    return View(
        features, (picture.shape[1], picture.shape[0]), Illumination.of_image(picture), place
    )


def is_hit(a: View, b: View) -> bool:
    if isinstance(a.place, Rigid3) and isinstance(b.place, Rigid3):
        apart = a.place.inverse() @ b.place
        return bool(
            np.linalg.norm(apart.translation) <= _NEAR_M and np.degrees(apart.angle()) <= _NEAR_DEG
        )
    return (
        isinstance(a.place, int)
        and isinstance(b.place, int)
        and abs(a.place - b.place) <= _NEAR_FRAMES
    )


def judge(title: str, sessions: Sequence[Sequence[View]], asked: Sequence[View], kind: str) -> None:
    config, first = MapConfig().vlad_config_for(kind), sessions[0]
    found = [append_positions(view.features, *view.size, config) for view in first]
    words = learn_words(np.concatenate(found), config)
    vlads = np.stack([vlad(descriptors, words) for descriptors in found])
    model = SurfVlad.fit(
        words, vlads, np.arange(len(first)), config, [view.features.cells for view in first]
    )
    views = [view for session in sessions for view in session]
    added = views[len(first) :]
    model = model.extend_with_features(
        [(view.features, *view.size) for view in added], np.arange(len(first), len(views))
    )
    lights = [average_illumination([view.light for view in session]) for session in sessions]
    of = group_by_illumination(
        [Session(k, str(k), light=light) for k, light in enumerate(lights)],
        {k: len(s) for k, s in enumerate(sessions)},
    )
    groups = np.concatenate([np.full(len(session), of[k]) for k, session in enumerate(sessions)])
    apart = max(
        compute_illumination_distance(lights[0], light)
        for light in lights[1:]
        if lights[0] is not None and light is not None
    )
    right = np.array([[is_hit(view, other) for other in views] for view in asked])
    rows = np.flatnonzero(right.any(axis=1))
    changed = model.suppress_group_differences(groups) if groups.any() else model
    said = " | ".join(_recall(way, asked, right, rows) for way in (model, changed))
    print(f"{kind:12} {title:36} {apart:.2f} apart, {len(rows):3d} asked: {said}", flush=True)


def _recall(model: SurfVlad, asked: Sequence[View], right: np.ndarray, rows: np.ndarray) -> str:
    ranked = []
    for k in rows:
        view = asked[k]
        blank = np.zeros((view.size[1], view.size[0]), np.uint8)
        ranked.append(
            [right[k, score.row] for score in model.rank(blank, view.features, max(_FIRST))]
        )
    hits = np.array(ranked)
    return "  ".join(f"@{n} {int(hits[:, :n].any(axis=1).sum()):3d}" for n in _FIRST)


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    for kind in args.kinds:
        left, right, night = (
            walk(f"gardenspoint/{name}", kind) for name in ("day_left", "day_right", "night_right")
        )
        judge("day and night, day asked", [left, night], right, kind)
        judge("day and a quarter night, day asked", [left, night[::4]], right, kind)
        judge("day and a quarter night, night asked", [left, night[::4]], night[2::4], kind)
        judge("day and first half of night", [left, night[:50]], night[53:], kind)
        judge("day and second half of night", [left, night[50:]], night[:47], kind)
        judge("day and day, night asked", [left, right], night, kind)
        lap, day, dark = (walk(f"lab/{name}", kind) for name in ("map_lap1", "day", "night"))
        judge("lab: day and half night, night", [lap, dark[::2]], dark[1::2], kind)
        judge("lab: day and first half of night", [lap, dark[:16]], dark[16:], kind)
        judge("lab: day and second half of night", [lap, dark[16:]], dark[:16], kind)
        judge("lab: day and night, day asked", [lap, dark], day, kind)


if __name__ == "__main__":
    main()
