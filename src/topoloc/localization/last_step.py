"""Refine a reported pose with all that the map knows around it.

The verdict needs few nodes and one feature type. Once the place is certain, points of more nodes
and of all feature types are matched near their predicted pixels. This is safe only for a pose that
is accurate to a few pixels: within a small radius few matches are right by chance.

Each match is then aligned by correlation (least-squares matching in its simplest form). The node's
image around the point is warped as a plane that faces the node, and moved over the query image. A
key point lies one to three pixels off the described point, an aligned patch a third of a pixel.
Matches that do not correlate are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from topoloc.geometry.absolute_pose import AbsolutePose, refine_absolute_pose
from topoloc.geometry.camera import Camera
from topoloc.geometry.clustered_errors import compute_variance_inflation
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.geometry.uncalibrated_camera import UncalibratedCamera
from topoloc.localization.fitted_weights import LastStepWeights, load_last_step_weights
from topoloc.localization.guided import match_guided
from topoloc.localization.last_step_kernels import align_patches
from topoloc.localization.open_map import NodeTemplate
from topoloc.localization.pose_fit import LocalMap, PointObservations
from topoloc.localization.result import Localization
from topoloc.localization.result_decision import ResultWithInliers
from topoloc.localization.search import Search
from topoloc.node_ids import NodeId


@dataclass(frozen=True, eq=False)
class PreciseMatches(PointObservations):
    """Hold matches of all feature types. `sigmas_px` is the standard deviation of each pixel."""

    node_ids: Int[np.ndarray, " n"]
    similarities: Float[np.ndarray, " n"]
    sigmas_px: Float[np.ndarray, " n"]

    def select(self, rows: np.ndarray) -> PreciseMatches:
        """Return the given rows."""
        return PreciseMatches(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class PreciseFit:
    """Hold the refined pose and the matches that it was fitted to, in the reduced image."""

    pose: AbsolutePose
    matches: PreciseMatches


def refine_result(searches: Sequence[Search], outcome: ResultWithInliers) -> ResultWithInliers:
    """Return the outcome with its pose refined, or unchanged if too few points agree.

    A pose is not refined if the surroundings do not allow it: nodes near a pose from virtual views
    show something else, and a focal length that is unknown or in doubt would have to follow. In a
    map with strongly correlated errors, such as those of a wrong calibration, the nearest nodes of
    the verdict are better than many, because the errors of an image from nearly the same place
    cancel out.

    Args:
        searches: the searches of the query, one for each feature type.
    """
    result, first = outcome[0], searches[0]
    weights = load_last_step_weights()
    if (
        not isinstance(result, Localization)
        or first.config.exactness == "fast"
        or first.config.guided.num_nodes == 0
        or first.correlated_error_share > weights.max_correlated_error_share
        or result.is_from_virtual_views
        or result.calibration_doubt is not None
        or isinstance(first.query.input_camera, UncalibratedCamera)
        or first.query.is_past_deadline
    ):
        return outcome
    # the feature type that found the pose comes first
    ordered = sorted(searches, key=lambda one: one.map.kind.name != result.provenance.features)
    with first.query.clock.stage("last_step"):
        fit = refine_precisely(ordered, result.world_from_cam.inverse(), weights)
        if fit is None:
            return outcome
        seen = fit.matches.select(np.flatnonzero(fit.pose.inliers))
        noise = _compute_noise_covariance(fit, seen, first.query.camera)
    cam_from_world = fit.pose.cam_from_world
    before = inverse_covariance(result.world_from_cam, result.covariance)
    shared = weights.shared_error_factor * (1.0 - result.noise_share) * before
    precise = replace(
        result,
        world_from_cam=cam_from_world.inverse(),
        covariance=inverse_covariance(cam_from_world, noise + shared),
        noise_share=float(np.trace(noise[:3, :3]) / np.trace((noise + shared)[:3, :3])),
        times_ms=first.query.clock.times_ms(),
    )
    return precise, [(precise, seen.to_image_scale(first.query.scale))]


def refine_precisely(
    searches: Sequence[Search], cam_from_world: Rigid3, weights: LastStepWeights
) -> PreciseFit | None:
    """Refine a pose that is accurate to some pixels. None if too few points agree."""
    camera = searches[0].query.camera
    rows = searches[0].map.nearest(cam_from_world.inverse(), weights.num_nodes)
    maps = [search.map.local_map(rows) for search in searches]
    rough = _match_and_fit(searches[:1], maps[:1], cam_from_world, 0, weights)
    if rough is None:
        return None
    fit = _match_and_fit(searches, maps, rough.pose.cam_from_world, 1, weights)
    if fit is None:
        return None
    chosen = _spread(fit, camera, weights.max_aligned)
    max_error_px = weights.max_aligned_error_px * _image_scale(camera)
    aligned_fit = fit
    for reach_px in weights.reaches_px:
        aligned = _align(searches[0], chosen, aligned_fit.pose.cam_from_world, reach_px, weights)
        better = _fit(aligned, camera, aligned_fit.pose.cam_from_world, max_error_px)
        if better is None or np.count_nonzero(better.pose.inliers) < weights.min_aligned:
            return fit
        aligned_fit = better
    return aligned_fit


def _image_scale(camera: Camera) -> float:
    """Return the pixels of this image for one of an image whose longer side is 640."""
    return max(max(camera.width, camera.height) / 640.0, 0.5)


def _match_and_fit(
    searches: Sequence[Search],
    maps: Sequence[LocalMap],
    cam_from_world: Rigid3,
    number: int,
    weights: LastStepWeights,
) -> PreciseFit | None:
    """Run a round of matching: the number 0 or 1."""
    camera = searches[0].query.camera
    matches = _match(searches, maps, cam_from_world, weights.radii_px[number], weights)
    max_error_px = weights.max_errors_px[number] * _image_scale(camera)
    return _fit(matches, camera, cam_from_world, max_error_px)


def _match(
    searches: Sequence[Search],
    maps: Sequence[LocalMap],
    cam_from_world: Rigid3,
    radius_px: float,
    weights: LastStepWeights,
) -> PreciseMatches:
    """Match the key points of all feature types within a radius of the predicted pixels."""
    parts = list[PreciseMatches]()
    for search, points in zip(searches, maps, strict=True):
        features = search.query.features
        config = replace(search.config.guided, radius_px=radius_px)
        matches = match_guided(features, points, cam_from_world, search.query.camera, config)
        rows = matches.train_idx
        similarities = 1.0 - np.square(matches.distances.astype(np.float64)) / 2.0
        parts.append(
            PreciseMatches(
                features.points_img[matches.query_idx],
                points.points_world[rows],
                points.covariances[rows],
                points.node_ids[rows],
                similarities,
                np.full(len(rows), weights.key_point_sigma_px),
            )
        )
    columns = ([getattr(part, field.name) for part in parts] for field in fields(PreciseMatches))
    return PreciseMatches(*(np.concatenate(column) for column in columns))


def _fit(
    matches: PreciseMatches, camera: Camera, start: Rigid3, max_error_px: float
) -> PreciseFit | None:
    min_inliers = 12
    pose = refine_absolute_pose(
        matches.points_img.astype(np.float64),
        matches.points_world,
        matches.covariances,
        matches.sigmas_px,
        camera,
        start,
        max_error_px,
    )
    if pose is None or np.count_nonzero(pose.inliers) < min_inliers:
        return None
    return PreciseFit(pose, matches)


def _spread(fit: PreciseFit, camera: Camera, max_number: int) -> PreciseMatches:
    """Return at most `max_number` inliers: in turn the most similar one of each image cell."""
    matches = fit.matches.select(np.flatnonzero(fit.pose.inliers))
    if len(matches) <= max_number:
        return matches
    num_columns = 16
    cell_px = camera.width / num_columns
    columns, rows = (matches.points_img / np.float32(cell_px)).astype(np.int64).T
    cells = rows * num_columns + columns
    order = np.lexsort((-matches.similarities, cells))
    starts = np.searchsorted(cells[order], cells[order])
    rank = np.arange(len(order)) - starts
    return matches.select(np.sort(order[np.argsort(rank, kind="stable")[:max_number]]))


def _align(
    search: Search,
    matches: PreciseMatches,
    cam_from_world: Rigid3,
    reach_px: int,
    weights: LastStepWeights,
) -> PreciseMatches:
    """Align matches by correlation with the node's images. Matches that do not correlate are
    dropped."""
    camera = search.query.camera
    node_ids, node_of_match = np.unique(matches.node_ids, return_inverse=True)
    templates = [search.map.template(search.map.topomap.row_of(NodeId(int(k)))) for k in node_ids]
    size = np.array([template.image.shape for template in templates]).reshape(-1, 2)
    images = np.zeros((len(templates), *size.max(axis=0, initial=1)), np.uint8)
    for k, template in enumerate(templates):
        images[k, : size[k, 0], : size[k, 1]] = template.image
    predicted, centres, warps = _compute_warps(
        matches, cam_from_world, camera, templates, node_of_match
    )
    pixels, correlations = align_patches(
        search.query.grey, images, size, node_of_match, predicted, centres, warps, reach_px
    )
    rows = np.flatnonzero(correlations > weights.correlations[0])
    sigmas = np.interp(correlations[rows], weights.correlations, weights.aligned_sigmas_px)
    return replace(
        matches.select(rows), points_img=pixels[rows].astype(np.float32), sigmas_px=sigmas
    )


def _compute_warps(
    matches: PreciseMatches,
    cam_from_world: Rigid3,
    camera: Camera,
    templates: Sequence[NodeTemplate],
    node_of_match: Int[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
    """Return the pixel of each point in the query and in the node's image, and the derivative of
    the second by the first on a plane that faces the node."""
    rotations = np.array([one.world_from_cam.rotation for one in templates])[node_of_match]
    origins = np.array([one.world_from_cam.translation for one in templates])[node_of_match]
    in_query = cam_from_world.apply(matches.points_world)
    in_node = np.einsum("nji,nj->ni", rotations, matches.points_world - origins)
    step = 0.01 * in_node[:, 2:]  # short enough for the derivative of any lens
    axes = np.einsum("ij,njk->kni", cam_from_world.rotation, rotations)[:2]
    predicted = camera.img_from_cam(in_query)
    by_query = [camera.img_from_cam(in_query + step * axis) - predicted for axis in axes]
    centres, by_node = np.empty_like(predicted), np.empty((2, *predicted.shape))
    cameras = [template.camera for template in templates]
    for node_camera in set(cameras):
        rows = np.flatnonzero(np.array([one == node_camera for one in cameras])[node_of_match])
        centres[rows] = node_camera.img_from_cam(in_node[rows])
        for k in range(2):
            moved = in_node[rows] + step[rows] * np.eye(3)[k]
            by_node[k, rows] = node_camera.img_from_cam(moved) - centres[rows]
    (a, c), (b, d) = (one.T for one in by_query)
    with np.errstate(divide="ignore", invalid="ignore"):  # a plane seen from its edge
        inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    return predicted, centres, np.einsum("jni,jkn->nik", by_node, inverse)


def _compute_noise_covariance(
    fit: PreciseFit, seen: PreciseMatches, camera: Camera
) -> Float[np.ndarray, "6 6"]:
    """Return the covariance without the errors that all matches share."""
    inflation = compute_variance_inflation(
        seen.points_img.astype(np.float64),
        seen.points_world,
        seen.covariances,
        camera,
        fit.pose.cam_from_world,
        seen.sigmas_px,
    )
    return inflation**2 * fit.pose.covariance
