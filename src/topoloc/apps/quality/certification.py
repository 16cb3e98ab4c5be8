"""Measure what a user may rely on: how often a map's answers are wrong, with a confidence bound.

Three kinds of images are localized: walks through the place, images of elsewhere, and images of
places beside the map. The last kind is the hardest, and costs no recording: all nodes that show
what an image of the map or of a walk shows are hidden. `certified_answers.py` derives the
certificate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from topoloc import (
    CalibrationError,
    Camera,
    EvaluatedQuery,
    Evaluation,
    Localizer,
    LocalizerConfig,
    MapError,
    Rigid3,
    StereoSequence,
    TopoMetricMap,
    TrajectoryError,
    localize_out_of_map,
    localize_queries,
)
from topoloc.apps.core_names import (
    Certificate,
    GroupKind,
    NodeId,
    OneLine,
    QueryImage,
    Row,
    edit_map,
    sample_evenly,
)
from topoloc.apps.quality.certified_answers import CertifiedAnswers, derive_certificate, find_pieces

Progress = Callable[[str, int, int], None]
_MAX_IMAGES = 200  # of the map, and of the walks
_MIN_SEEN_SHARE, _MAX_SCALE = 0.2, 3.0
"""A node shows what an image shows if this share of its points is in view there, at a distance
that differs by less than this factor."""
_NUM_POINTS = 100


@dataclass(frozen=True, eq=False, repr=False)
class Certification(OneLine):
    """Hold a certificate and the answers that it follows from, by condition."""

    certificate: Certificate
    conditions: list[CertifiedAnswers]

    @property
    def blind_spots(self) -> list[Rigid3]:
        """Return one pose (world_from_cam) of each piece of the walks of which no image was
        localized."""
        found = list[Rigid3]()
        for condition in self.conditions:
            if condition.kind == "walk" and condition.has_truth:
                pairs = list(zip(condition.pieces, condition.answers, strict=True))
                seen = {piece for piece, answer in pairs if answer.result.localized}
                poses = {piece: answer.world_from_cam for piece, answer in pairs}
                found += [pose for piece, pose in poses.items() if piece not in seen and pose]
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the certificate, its promise, the blind spots (world_from_cam) and all answers as
        JSON."""
        return self.certificate.to_json() | {
            "promise": self.certificate.promise(),
            "threshold": self.certificate.describe_threshold(),
            "blind_spots": [pose.to_json() for pose in self.blind_spots],
            "answers": [
                answer.to_json() | {"condition": condition.name, "piece": piece}
                for condition in self.conditions
                for piece, answer in zip(condition.pieces, condition.answers, strict=True)
            ],
        }


def certify(
    path: str | Path,
    walks: Sequence[StereoSequence] = (),
    out_of_map: Sequence[StereoSequence] = (),
    map_from_truth: Rigid3 | None = None,
    max_wrong_share: float = 0.01,
    is_applied: bool = False,
    config: LocalizerConfig | None = None,
    progress: Progress | None = None,
    on_wait: Callable[[], None] | None = None,
    group_by: Sequence[GroupKind] = (),
) -> Certification:
    """Measure the answers of a map and store the certificate in its file.

    Args:
        walks: recordings of the place that are not in the map, with or without known poses.
        out_of_map: recordings of other places.
        map_from_truth: transform from the world of the walks' poses into the map's (m).
        max_wrong_share: the requested limit of the share of wrong pieces.
        is_applied: from now on, answers below the threshold are refused.
        config: settings of the localizer.
        progress: called with a name, images done and images in all.
        on_wait: called once before waiting for another edit of the map.
        group_by: `angle`, `light`: also a promise for each group of the walks' images by these.

    Raises:
        MapError: the map cannot be read or written, or was edited meanwhile; nothing is stored.
        TrajectoryError: a walk is of another place, or its poses are in another world.
        CalibrationError: a recording has no camera.
    """
    config = config or LocalizerConfig()
    with TopoMetricMap.load(path) as topomap:
        topomap.require_scale("a certificate")
        localizer, measured = Localizer(replace(topomap, certificate=None), config), topomap.file
        conditions = [
            *_localize_walks(localizer, walks, map_from_truth, progress),
            *_localize_beside_map(localizer, walks, map_from_truth, progress),
        ]
        for recording in out_of_map:
            answers = localize_out_of_map(localizer, recording, progress)
            pieces = find_pieces(topomap, answers, False)
            conditions.append(CertifiedAnswers(recording.name, "out_of_map", True, answers, pieces))
    certificate = derive_certificate(conditions, config, max_wrong_share, is_applied, group_by)
    with edit_map(path, on_wait) as edit:
        file = edit.topomap.file
        if measured is None or file is None or file.digest != measured.digest:
            raise MapError(f"map {path} was edited meanwhile: certify it again")
        certificate = structs.replace(certificate, map_version=edit.topomap.free_ids.edit)
        edit.commit(replace(edit.topomap, certificate=certificate), "certify")
    return Certification(certificate, conditions)


def _localize_walks(
    localizer: Localizer,
    walks: Sequence[StereoSequence],
    map_from_truth: Rigid3 | None,
    progress: Progress | None,
) -> Iterator[CertifiedAnswers]:
    """Localize the walks. Raises TrajectoryError."""
    for walk in walks:
        has_truth = any(walk.poses)
        if has_truth:
            answers = localize_queries(localizer, walk, map_from_truth, progress)
        else:
            answers = localize_out_of_map(localizer, walk, progress)
        if not any(answer.result.localized for answer in answers):
            raise TrajectoryError(
                f"{walk.name}: none of {len(answers)} images is localized. If it is of another"
                " place, give it by --out-of-map; else the map does not show it: topoloc update"
            )
        if has_truth and Evaluation(answers).world_fits:
            raise TrajectoryError(
                f"{walk.name}: its poses are in another world than the map. `topoloc evaluate"
                " --fit-map-from-truth FILE` writes the transform; certify with --map-from-truth"
            )
        pieces = find_pieces(localizer.topomap, answers, has_truth)
        yield CertifiedAnswers(walk.name, "walk", has_truth, answers, pieces)


def _localize_beside_map(
    localizer: Localizer,
    walks: Sequence[StereoSequence],
    map_from_truth: Rigid3 | None,
    progress: Progress | None,
) -> Iterator[CertifiedAnswers]:
    """Localize images of the map and of the walks, without the nodes that show the same."""
    rows = sample_evenly(localizer.topomap.rows, _MAX_IMAGES)
    of_map = [_HiddenImage.of_node(localizer.topomap, row) for row in rows]
    frames = [(walk, i) for walk in walks for i, pose in enumerate(walk.poses) if pose is not None]
    sampled = sample_evenly(frames, _MAX_IMAGES)
    of_walks = [_HiddenImage.of_frame(walk, i, map_from_truth) for walk, i in sampled]
    for name, images in (("map", of_map), ("walks", of_walks)):
        answers, label = list[EvaluatedQuery](), f"{name}, surroundings removed"
        for done, hidden_image in enumerate(images):
            hidden = find_nodes_in_view(
                localizer.topomap, hidden_image.world_from_cam, hidden_image.camera
            )
            if len(hidden) < len(localizer.topomap.summaries):
                result, _ = localizer.without(hidden).localize_query(hidden_image.read())
                answers.append(
                    EvaluatedQuery(
                        hidden_image.name,
                        result,
                        hidden_image.world_from_cam,
                        recording=label,
                        camera=hidden_image.camera,
                    )
                )
            if progress is not None:
                progress(label, done + 1, len(images))
        if answers:
            pieces = find_pieces(localizer.topomap, answers, True)
            yield CertifiedAnswers(label, "surroundings_removed", True, answers, pieces)


@dataclass(frozen=True, eq=False)
class _HiddenImage:
    """Hold an image with a known pose in the map's world. `read` returns the query."""

    name: str
    world_from_cam: Rigid3
    camera: Camera
    read: Callable[[], QueryImage]

    @staticmethod
    def of_node(topomap: TopoMetricMap, row: Row) -> _HiddenImage:
        """Return a node's stored features as a query: the map does not hold its whole image."""
        node = topomap.nodes[row]

        def read() -> QueryImage:
            features = {kind: layer.nodes[row].features for kind, layer in topomap.layers.items()}
            return QueryImage.of_features(features, node.camera)

        return _HiddenImage(node.summary.name, node.summary.world_from_cam, node.camera, read)

    @staticmethod
    def of_frame(walk: StereoSequence, index: int, map_from_truth: Rigid3 | None) -> _HiddenImage:
        """Return a frame with a pose. Raises CalibrationError: it has no camera."""
        frame, pose = walk[index], walk.poses[index]
        if frame.camera is None or pose is None:
            raise CalibrationError(f"{frame.name}: no calibration and pose; both are needed")
        camera = frame.camera
        world_from_cam = pose if map_from_truth is None else map_from_truth @ pose
        return _HiddenImage(
            frame.name, world_from_cam, camera, lambda: QueryImage(walk[index].image, camera)
        )


def find_nodes_in_view(
    topomap: TopoMetricMap, world_from_cam: Rigid3, camera: Camera
) -> list[NodeId]:
    """Return the nodes of which a fifth of the points is in view of a camera, at a distance that
    differs by less than a factor of three. Walls do not hide points here, so these are too many
    rather than too few."""
    cam_from_world, found = world_from_cam.inverse(), list[NodeId]()
    for row in topomap.rows:
        node = topomap.nodes[row]
        points = node.points_cam[:: max(1, len(node.points_cam) // _NUM_POINTS)].astype(float)
        if len(points) == 0:
            continue
        seen = (cam_from_world @ node.summary.world_from_cam).apply(points)
        pixels = camera.img_from_cam(seen)
        with np.errstate(invalid="ignore"):
            is_in_view = (pixels >= 0.0).all(axis=1) & (pixels < [camera.width, camera.height]).all(
                axis=1
            )
        ratios = np.linalg.norm(seen, axis=1) / np.linalg.norm(points, axis=1)
        is_in_view &= (ratios < _MAX_SCALE) & (ratios > 1.0 / _MAX_SCALE)
        if np.mean(is_in_view) >= _MIN_SEEN_SHARE:
            found.append(node.summary.node_id)
    return found
