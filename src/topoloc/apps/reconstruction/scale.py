"""Find the metres in a unit of a reconstruction: by distances between images that were measured, by
printed tags of a known size, and by depth images.

Each source has a standard deviation. They are weighed by it and compared: a contradiction is an
error, because one of them is wrong and nothing says which.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from topoloc import Camera, RecordingError, Rigid3
from topoloc.apps.core_names import prepare_frame, read_left_frame, sample_evenly, to_grey
from topoloc.apps.formats.colmap import estimate_metric_scale
from topoloc.apps.reconstruction.gnss import fit_places, read_exif_places
from topoloc.apps.reconstruction.photos import PosedView, Reconstruction

NO_SCALE = "none"  # stated instead of a source
UNIT_DEPTH = 2.0  # units, as in a room
# of any length in a reconstruction, relative: with calibrations, and with a fitted camera
_SHAPE_SIGMAS = 0.003, 0.01
_BEND_SIGMA = 0.01  # of one distance in a reconstruction against all of it, relative
_TAPE_SIGMA = 0.01  # of a measured distance between two lenses, metres
_DEPTH_SIGMA = 0.01  # of the scale of a depth sensor, relative
_MAX_CONTRADICTION = 3.0  # standard deviations
_TAG_FAMILIES = ("APRILTAG_36h11", "4X4_50", "5X5_100", "6X6_250", "ARUCO_ORIGINAL")
_MAX_SIDE = 1600  # pixels: larger images are reduced before tags are detected
_MIN_TAG_VIEWS, _MAX_TAG_ERROR_PX = 3, 3.0
_MIN_CORNER_SIGMA_PX = 0.3
_MAX_DEPTH_FRAMES, _MIN_DEPTHS = 40, 20


@dataclass(frozen=True)
class ScaleSource:
    """Hold the metres in a unit by one source, and their relative standard deviation."""

    name: str
    metres: float
    sigma: float


def find_scale(
    found: Reconstruction,
    distances: Sequence[str],
    tag: float | None,
    tell: Callable[[str], object] | None,
    warn: Callable[[str], object] = lambda text: None,
    known: Sequence[ScaleSource] = (),
) -> ScaleSource:
    """Return the metres in a unit by all sources together.

    Args:
        distances: of two images' cameras, as `estimate_metric_scale` has them.
        tag: length of a side of all tags' black squares, metres.
        tell: called with the result and its sources.
        warn: called if places of EXIF contradict what is measured, and are left out.
        known: further sources.

    Raises:
        RecordingError: there is no source, no usable tag is seen, or sources contradict each other.
        TrajectoryError: a distance is malformed, or its images have no pose.
    """
    name = found.sequences[0].name
    sources = [*known, *(_measure_distance(text, found) for text in distances)]
    sources += [] if tag is None else _measure_tags(found, tag)
    sources += _measure_depth(found)
    shape_sigma = _SHAPE_SIGMAS[found.is_fitted]
    sources += _measure_gnss(found, sources, shape_sigma, warn)
    if not sources:
        raise RecordingError(
            f"{name}: images of one camera have no scale; measure one: --scale IMAGE_A,IMAGE_B="
            "METRES between the lenses at two images, or --tag METRES, the side of a printed"
            " AprilTag or ArUco marker in at least three of them (what was computed is kept); or"
            " --scale none for a map without scale, which `topoloc scale` sets later; or give the"
            " poses in metres, --trajectory FILE"
        )
    scale = combine_sources(name, sources, shape_sigma)
    if tell is not None:
        named = ", ".join(f"{one.name} {one.metres / scale.metres:.3f}" for one in sources)
        tell(f"{name}: scale known to {100 * scale.sigma:.1f} % (relative to it: {named})")
    return scale


def normalize_unit(found: Reconstruction) -> float:
    """Return the factor to the unit of a map without scale, in which the median depth of its points
    is `UNIT_DEPTH`: limits of the core in metres are then relative to that depth."""
    return UNIT_DEPTH / float(np.median(np.concatenate([one.depths for one in found.seen])))


def combine_sources(name: str, sources: Sequence[ScaleSource], shape_sigma: float) -> ScaleSource:
    """Return the weighted mean of sources. Its sigma grows if they scatter more than theirs say.
    Raises RecordingError: one is further from the mean than its standard deviation allows.

    Args:
        shape_sigma: relative standard deviation of one length in the reconstruction.
    """
    logs = np.log([one.metres for one in sources])
    sigmas = np.array([math.hypot(one.sigma, shape_sigma) for one in sources])
    weights = sigmas**-2 / np.sum(sigmas**-2)
    mean, sigma = float(weights @ logs), float(np.sum(sigmas**-2) ** -0.5)
    residuals = np.abs(logs - mean) / np.sqrt(np.maximum(sigmas**2 - sigma**2, 1e-12))
    if len(sources) > 1 and residuals.max() > _MAX_CONTRADICTION:
        listed = ", ".join(f"{one.name}: {one.metres:.4g} m" for one in sources)
        raise RecordingError(
            f"{name}: the sources of the scale contradict each other; metres in a unit are by"
            f" {listed}; check the wrong one, or leave it out"
        )
    scatter = weights @ (logs - mean) ** 2 / sigma**2 / max(len(sources) - 1, 1)
    return ScaleSource("all", math.exp(mean), sigma * math.sqrt(max(1.0, scatter)))


def _measure_distance(text: str, found: Reconstruction) -> ScaleSource:
    """Return the scale by one distance, in the first recording that has both images."""
    metres_text = text.rpartition("=")[2].strip().removesuffix("m")
    named = text.rpartition("=")[0].split(",")
    owners = [
        one for one in found.sequences if all(_has_image(one, name.strip()) for name in named)
    ]
    per_unit = estimate_metric_scale([text], (owners or found.sequences)[0])
    sigma = math.hypot(_TAPE_SIGMA / float(metres_text), _BEND_SIGMA)
    return ScaleSource(f"distance {text}", per_unit, sigma)


def _has_image(sequence: PosedView, name: str) -> bool:
    return any(name in (other, other.rpartition("/")[2]) for other in sequence.names)


def _measure_gnss(
    found: Reconstruction,
    others: Sequence[ScaleSource],
    shape_sigma: float,
    warn: Callable[[str], object],
) -> list[ScaleSource]:
    """Return the scale by places of EXIF, if they determine it and agree with what was measured."""
    positions, places = read_exif_places(found)
    if (fit := fit_places(positions, places)) is None:
        return []
    gnss = ScaleSource(f"GNSS in EXIF of {len(places)} images", *fit)
    try:
        combine_sources(found.sequences[0].name, [*others, gnss], shape_sigma)
    except RecordingError as error:
        warn(f"{error}; GNSS is left out")
        return []
    return [gnss]


def _measure_depth(found: Reconstruction) -> list[ScaleSource]:
    """Return the scale by depth images, if there are any."""
    rows = [(one, row) for one in found.sequences for row in range(len(one))]
    posed = [
        (one, row, seen)
        for (one, row), seen in zip(rows, found.seen, strict=True)
        if len(seen.depths) >= _MIN_DEPTHS
    ]
    if not posed or posed[0][0][posed[0][1]].depth is None:
        return []
    depths, ratios = list[np.ndarray](), list[np.ndarray]()
    for sequence, row, seen in sample_evenly(posed, _MAX_DEPTH_FRAMES):
        frame = sequence[row]
        if frame.depth is None or frame.camera is None:
            continue
        view = prepare_frame(replace(frame, right=None, rig=None))
        if view.depth is None:
            continue
        normalized = frame.camera.normalized_from_img(seen.points_img)
        pixels = view.camera.img_from_cam(np.insert(normalized, 2, 1.0, axis=1)).round()
        inside = view.camera.is_in_image(pixels)
        coarser = np.array(view.depth.shape[::-1]) / view.grey.shape[::-1]
        columns, lines = (pixels[inside] * coarser).astype(int).T
        metres = view.depth[lines, columns]
        is_known = np.isfinite(metres)
        depths.append(metres[is_known])
        ratios.append(metres[is_known] / seen.depths[inside][is_known])
    metres, logs = np.concatenate([[], *depths]), np.log(np.concatenate([[], *ratios]))
    if len(logs) < _MIN_DEPTHS:
        return []
    is_near = metres <= np.median(metres)  # depth sensors and calibrations are worse far away
    near, far = float(np.median(logs[is_near])), float(np.median(logs[~is_near]))
    sigma = math.hypot(_DEPTH_SIGMA, far - near)
    return [ScaleSource(f"depth of {len(ratios)} frames", math.exp(near), sigma)]


_Corners = tuple[Rigid3, Camera, Float[np.ndarray, "4 2"]]  # world_from_cam, camera, pixels


def _measure_tags(found: Reconstruction, side: float) -> list[ScaleSource]:
    """Return the scale by each tag. Raises RecordingError: none is seen by enough images."""
    views = defaultdict[str, list[_Corners]](list)
    for sequence in found.sequences:
        for row, (pose, camera) in enumerate(zip(sequence.poses, sequence.cameras, strict=True)):
            if pose is not None and camera is not None:
                grey = to_grey(read_left_frame(sequence, row).image)
                of_size = camera.rescaled(grey.shape[1], grey.shape[0])
                for tag, corners in _detect_tags(grey):
                    views[tag].append((pose, of_size, corners))
    many = {tag: one for tag, one in views.items() if len(one) >= _MIN_TAG_VIEWS}
    sources = [one for tag in sorted(many) if (one := _fit_tag(tag, many[tag], side)) is not None]
    if not sources:
        seen = ", ".join(f"{tag} in {len(one)} images" for tag, one in sorted(views.items())[:4])
        raise RecordingError(
            f"{found.sequences[0].name}: no tag gives the scale (seen: {seen or 'none'}); it must"
            f" lie still, and {_MIN_TAG_VIEWS} images must show it from different sides;"
            f" known families: {', '.join(_TAG_FAMILIES)}"
        )
    return sources


def _detect_tags(grey: np.ndarray) -> Iterator[tuple[str, Float[np.ndarray, "4 2"]]]:
    """Yield family and number of each tag, and its corners (pixels)."""
    factor = min(1.0, _MAX_SIDE / max(grey.shape))
    if factor < 1.0:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    quick, exact = cv2.aruco.DetectorParameters(), cv2.aruco.DetectorParameters()
    # lines fitted to the edges; SUBPIX makes tags of 60 px 0.5 % too small, of 20 px 2 %
    exact.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    for family in _TAG_FAMILIES:
        known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
        if cv2.aruco.ArucoDetector(known, quick).detectMarkers(grey)[1] is None:
            continue
        corners, numbers, _ = cv2.aruco.ArucoDetector(known, exact).detectMarkers(grey)
        for points, number in zip(corners, () if numbers is None else numbers.ravel(), strict=True):
            # AprilTag's lines have the centre of the first pixel at (0.5, 0.5)
            pixels = points.reshape(4, 2).astype(np.float64) / factor - 0.5
            yield f"tag {number} of {family}", pixels


def _fit_tag(tag: str, views: Sequence[_Corners], side: float) -> ScaleSource | None:
    """Fit pose and side of one square to its corners in several images. None if they show no still
    square of that shape."""
    flat = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2.0
    corners = np.array([_intersect_rays(views, corner) for corner in range(4)])
    x = corners[1] + corners[2] - corners[0] - corners[3]
    z = np.cross(x, corners[0] + corners[1] - corners[2] - corners[3])
    y = np.cross(z, x)
    axes = np.column_stack([one / np.linalg.norm(one) for one in (x, y, z)])
    if not np.isfinite(axes).all():
        return None
    world_from_tag, units = Rigid3(axes, corners.mean(axis=0)), float(np.linalg.norm(x) / 2.0)

    def errors(change: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " n"]:
        """Return the errors of all corners (pixels) after a change of pose and log side."""
        moved = world_from_tag @ Rigid3.exp(change[:6] * np.repeat([units, 1.0], 3))
        points = moved.apply(flat * units * math.exp(change[6]))
        return np.concatenate(
            [
                (camera.img_from_cam(pose.inverse().apply(points)) - pixels).ravel()
                for pose, camera, pixels in views
            ]
        )

    normal = np.eye(7)
    for _ in range(10):
        now, step = errors(np.zeros(7)), 1e-6
        jacobian = np.column_stack([(errors(step * one) - now) / step for one in np.eye(7)])
        normal = jacobian.T @ jacobian
        change = np.linalg.lstsq(jacobian, -now, rcond=None)[0]
        world_from_tag @= Rigid3.exp(change[:6] * np.repeat([units, 1.0], 3))
        units *= math.exp(np.clip(change[6], -1.0, 1.0))
    rms = float(np.sqrt(np.mean(errors(np.zeros(7)) ** 2)))
    if not rms < _MAX_TAG_ERROR_PX or np.linalg.matrix_rank(normal) < 7:
        return None
    noise = max(rms, _MIN_CORNER_SIGMA_PX)
    sigma = noise * math.sqrt(np.linalg.inv(normal)[6, 6])
    return ScaleSource(f"{tag} in {len(views)} images", side / units, sigma)


def _intersect_rays(views: Sequence[_Corners], corner: int) -> Float[np.ndarray, " 3"]:
    """Return the point nearest to the rays of one corner. NaN if they are parallel."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for pose, camera, pixels in views:
        ray = pose.rotation @ camera.rays_from_img(pixels[corner : corner + 1])[0]
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        left, right = left + across, right + across @ pose.translation
    if np.linalg.cond(left) > 1e9:
        return np.full(3, np.nan)
    return np.linalg.solve(left, right)
