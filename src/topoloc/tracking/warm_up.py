"""Compile everything that a query needs before the first one.

A synthetic place is mapped, localized in and tracked through. The machine code is cached (see
`compiled.py`). With the cache this takes a second or two, without it half a minute.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from topoloc.compiled import is_cached
from topoloc.features.extraction import FeatureConfig, extract_features
from topoloc.features.features import MatchingConfig
from topoloc.features.matching import largest_similarities, match_features
from topoloc.features.surf import integral_image
from topoloc.geometry.camera import Camera
from topoloc.geometry.rigid import Rigid3
from topoloc.localization.guided import count_consistent_displacements, match_projections
from topoloc.localization.localizer import Localizer
from topoloc.localization.map_facts.map_building import build_map
from topoloc.localization.walls.propose_virtual_views import estimate_upright_pose
from topoloc.mapping.config import Progress
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.frame import DepthImage, MemorySequence, StereoFrame
from topoloc.slam.bundle.block_kernels import solve_factored
from topoloc.tracking.tracker import Tracker

STAGE = "compiling"

_CAMERA = Camera.pinhole(320, 240, 260.0, 260.0, 159.5, 119.5)
_TEXELS_PER_METRE = 130.0
_WALL_Z, _WALL_SLOPE = 2.0, 0.4  # the wall: z = 2 m + 0.4 x


def warm_up(
    progress: Progress | None = None, only_if_cold: Callable[[], None] | None = None
) -> None:
    """Compile or load all kernels for images and streams, so that the first query is not slower.

    It also fills the cache of machine code, for example while a container image is built.

    Args:
        progress: called with ("compiling", steps done, total steps).
        only_if_cold: called before the work, which is skipped if the machine code of the main
            kernels is cached. By default everything is compiled or loaded.
    """
    if only_if_cold is not None:
        # kernels at the start and at the end of a search, and the last one of a stream
        if all(map(is_cached, (integral_image, match_projections, solve_factored))):
            return
        only_if_cold()
    wall = _make_texture(seed=0)
    pictures = [_render_wall(wall, place)[0] for place in (0.0, 0.1, 0.2)]
    lost = _render_wall(_make_texture(seed=1), 0.0)[0]
    with tempfile.TemporaryDirectory() as folder:
        map_file = Path(folder) / "wall.topo"

        def features() -> None:
            first, second = (extract_features(picture, FeatureConfig()) for picture in pictures[:2])
            matches = match_features(first.descriptors, second.descriptors, MatchingConfig())
            largest_similarities(first.descriptors, [second.descriptors])  # of an unclear image
            nowhere = np.zeros((len(second), 5), np.float32)  # maps of SURF alone need this kernel
            count_consistent_displacements(first, matches, nowhere, _CAMERA, within_px=1.0)

        def localize_image(image: UInt8[np.ndarray, "h w"], camera: Camera | None) -> None:
            Localizer(TopoMetricMap.load(map_file)).localize(image, camera)

        def estimate_virtual_pose() -> None:
            points = TopoMetricMap.load(map_file).nodes[0].points_cam.astype(np.float64)
            estimate_upright_pose(points[:, :2] / points[:, 2:], points)

        def track_stream() -> None:
            tracker = Tracker(Localizer(TopoMetricMap.load(map_file)))
            for number in range(4):
                tracker.process(_render_wall(wall, 0.02 * number)[0], _CAMERA, 100_000_000 * number)

        steps: tuple[Callable[[], object], ...] = (
            features,
            lambda: build_map(_record_wall(wall)).save(map_file),
            lambda: localize_image(pictures[1], _CAMERA),
            lambda: localize_image(pictures[1], None),
            lambda: localize_image(lost, _CAMERA),
            estimate_virtual_pose,
            track_stream,
        )
        for number, step in enumerate(steps):
            if progress:
                progress(STAGE, number, len(steps))
            step()
        if progress:
            progress(STAGE, len(steps), len(steps))


def _record_wall(wall: Float32[np.ndarray, "h w"]) -> MemorySequence:
    """Return an RGB-D recording of two frames along the wall."""
    frames = list[StereoFrame]()
    for t_ns, place in ((0, 0.0), (100_000_000, 0.2)):
        image, depth = _render_wall(wall, place)
        registered = DepthImage(depth, _CAMERA, Rigid3.identity())
        pose = Rigid3(np.eye(3), np.array([place, 0.0, 0.0]))
        frames.append(
            StereoFrame(f"{t_ns}", t_ns, image, _CAMERA, depth=registered, world_from_cam=pose)
        )
    return MemorySequence(frames, "wall")


def _make_texture(seed: int) -> Float32[np.ndarray, "h w"]:
    """Return noise at several scales, in which no two places look alike."""
    rng, total = np.random.default_rng(seed), np.zeros((480, 640), np.float32)
    for sigma in (1.5, 3.0, 6.0, 12.0):
        noise = cv2.GaussianBlur(rng.standard_normal(total.shape).astype(np.float32), (0, 0), sigma)
        total += noise / noise.std()
    return np.clip(127.5 + 20.0 * total, 0.0, 255.0)


def _render_wall(
    wall: Float32[np.ndarray, "h w"], place: float
) -> tuple[UInt8[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return the image and depth (metres) of the wall from `place` metres along x."""
    camera = _CAMERA
    wall_from_texel = (
        np.array([[1.0, 0.0, -320.0], [0.0, 1.0, -240.0], [0.0, 0.0, _TEXELS_PER_METRE]])
        / _TEXELS_PER_METRE
    )
    cam_from_wall = np.array([[1.0, 0.0, -place], [0.0, 1.0, 0.0], [_WALL_SLOPE, 0.0, _WALL_Z]])
    image = cv2.warpPerspective(
        wall, camera.matrix() @ cam_from_wall @ wall_from_texel, (camera.width, camera.height)
    )
    rays_x = (np.arange(camera.width) - camera.cx) / camera.fx
    depth = (_WALL_Z + _WALL_SLOPE * place) / (1.0 - _WALL_SLOPE * rays_x)
    return np.rint(image).astype(np.uint8), np.tile(depth.astype(np.float32), (camera.height, 1))
