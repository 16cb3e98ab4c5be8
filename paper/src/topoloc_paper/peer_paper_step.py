"""Implement the paper's fine step as written (section III-B), with OpenCV.

It uses the first node alone and patch normalisation in 17x17 windows. The features are OpenCV's
SURF if it is built in (wheels lack it), else its SIFT, with default settings. "A fast nearest
neighbour-based matcher" is FLANN with five KD-trees and Lowe's ratio of 0.7. `solvePnPRansac` runs
with default settings, and every result is accepted. Nodes, the source of their 3-D positions and
the coarse step (`surf-vlad`) are those of topoloc's map, so only the fine step differs.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from topoloc.features.extraction import PatchNormalizationConfig, patch_normalize
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.points.metric_points import locate_points
from topoloc.recordings.frame import StereoFrame, StereoSequence, to_grey
from topoloc.recordings.frame_preparation import prepare_frame
from topoloc_paper.peer_answers import PeerAnswer
from topoloc_paper.peer_retrieval import Retrieval

RATIO = 0.7
_TREES, _CHECKS, _KDTREE = 5, 50, 1
_MIN_MATCHES = 4


@dataclass(frozen=True, eq=False)
class _Node:
    world_from_cam: Rigid3
    points_cam: Float64[np.ndarray, "n 3"]
    descriptors: Float32[np.ndarray, "n d"]


class PaperStep:
    """Nodes with OpenCV's features, and the coarse localizer of the map they are those of."""

    def __init__(self, topomap: TopoMetricMap, sequences: Sequence[StereoSequence]) -> None:
        self._retrieval = Retrieval(topomap)
        self._detector, self.feature_name = _detector()
        frames = {
            (sequence.name, name): (sequence, i)
            for sequence in sequences
            for i, name in enumerate(sequence.names)
        }
        self._nodes = [
            self._node(*frames[summary.recording, summary.name]) for summary in topomap.summaries
        ]
        arrays = [
            array
            for node in self._nodes
            for array in (node.points_cam.astype(np.float32), node.descriptors)
        ]
        self.map_bytes = sum(array.nbytes for array in arrays) + self._retrieval.map_bytes

    def localize(self, frames: Sequence[StereoFrame]) -> list[PeerAnswer]:
        answers = []
        for frame in frames:
            start = time.perf_counter()
            pose = self._pose(frame)
            answers.append(PeerAnswer(pose, 1e3 * (time.perf_counter() - start)))
        return answers

    def _node(self, sequence: StereoSequence, index: int) -> _Node:
        frame = sequence[index]
        assert frame.world_from_cam is not None, "a mapping frame"
        view = prepare_frame(frame)
        points_img, sizes, descriptors = self._features(view.grey)
        zeros = np.zeros(len(points_img), np.float32)
        located = locate_points(Features(points_img, sizes, zeros, zeros, descriptors), view)
        return _Node(
            frame.world_from_cam @ view.view_from_cam.inverse(),
            located.points_cam[located.valid],
            descriptors[located.valid],
        )

    def _features(
        self, grey: UInt8[np.ndarray, "h w"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        normalized = patch_normalize(grey, PatchNormalizationConfig.paper())
        keypoints, descriptors = self._detector.detectAndCompute(normalized, None)
        if len(keypoints) == 0:
            return (
                np.zeros((0, 2), np.float32),
                np.zeros(0, np.float32),
                np.zeros((0, 128), np.float32),
            )
        points_img = np.array([k.pt for k in keypoints], np.float32)
        return (
            points_img,
            np.array([k.size for k in keypoints], np.float32),
            descriptors.astype(np.float32),
        )

    def _pose(self, frame: StereoFrame) -> Rigid3 | None:
        assert frame.camera is not None
        (node_id,) = self._retrieval.nodes(frame.image, 1)
        node = self._nodes[node_id]
        points_img, _, descriptors = self._features(to_grey(frame.image))
        if len(points_img) < 2 or len(node.descriptors) < 2:
            return None
        matcher = cv2.FlannBasedMatcher(
            {"algorithm": _KDTREE, "trees": _TREES}, {"checks": _CHECKS}
        )
        pairs = [
            pair for pair in matcher.knnMatch(descriptors, node.descriptors, k=2) if len(pair) == 2
        ]
        good = [first for first, second in pairs if first.distance < RATIO * second.distance]
        if len(good) < _MIN_MATCHES:
            return None
        pixels = points_img[[match.queryIdx for match in good]].astype(np.float64)
        cam_from_node = solved(
            node.points_cam[[match.trainIdx for match in good]], pixels, frame.camera
        )
        return None if cam_from_node is None else node.world_from_cam @ cam_from_node.inverse()


def solved(points: np.ndarray, pixels: np.ndarray, camera: Camera) -> Rigid3 | None:
    """OpenCV's `solvePnPRansac` with its default settings, on pixels without distortion."""
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    rays = camera.rays_from_img(pixels)
    straight = rays[:, :2] / rays[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    try:
        done, rotation, translation, _ = cv2.solvePnPRansac(points, straight, matrix, None)
    except cv2.error:  # too few points for what it tried
        return None
    if not done or not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    return Rigid3(cv2.Rodrigues(rotation)[0], np.asarray(translation, np.float64).ravel())


def _detector() -> tuple[Any, str]:
    surf = getattr(getattr(cv2, "xfeatures2d", None), "SURF_create", None)
    try:
        if surf is not None:
            return surf(), "OpenCV SURF"
    except cv2.error:  # there by name, but left out of this build
        pass
    return cv2.SIFT_create(), "OpenCV SIFT"  # pyright: ignore[reportAttributeAccessIssue]  # missing in the stubs of OpenCV 5
