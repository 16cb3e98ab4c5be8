"""Estimate one camera from several of its images, while they are localized.

Each image without calibration is localized alone first, and its inliers show something of focal
length, principal point and distortion (`geometry/joint_camera/joint_fit.py`). Images of several
places together fix them: their information is added, with Cauchy's weights against images that
disagree. As soon as the camera is known well enough, images are localized by it, in the time of a
calibrated image. An image that contradicts it, such as a crop or a zoom, is localized alone again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from hashlib import blake2b

import numpy as np

from topoloc.geometry.absolute_pose_focal import camera_prior, parameters_of, with_parameters
from topoloc.geometry.calibration_check import MIN_IMAGES, MIN_PLACES
from topoloc.geometry.camera import Camera, UncalibratedCamera
from topoloc.geometry.joint_camera.camera_hypotheses import (
    CameraHypothesis,
    CameraLikelihood,
    CameraPrior,
    Matrix,
)
from topoloc.geometry.joint_camera.joint_fit import (
    CameraObservations,
    JointFit,
    fit_camera,
    linearized_fit,
)
from topoloc.geometry.pose_matches import CAUCHY_SCALE
from topoloc.geometry.rigid import Rigid3, inverse_covariance
from topoloc.localization.localizer import Localizer
from topoloc.localization.pose_fit import PointObservations
from topoloc.localization.query import Deadline, QueryImage, unknown_camera
from topoloc.localization.result import Localization, NotLocalized, with_time
from topoloc.retrieval.coarse import Image


@dataclass(frozen=True, eq=False)
class SharedCamera:
    """Hold a camera that images share, and the standard deviations (pixels) of its focal length and
    principal point. `covariance` is that of the parameters of `joint_fit.py`."""

    camera: Camera
    covariance: Matrix
    num_images: int

    def __str__(self) -> str:
        focal, x, y = self.camera.fx * np.sqrt(np.diag(self.covariance)[:3])
        lens = ""
        if self.camera.is_distorted:
            k1, k2 = self.camera.distortion()[:2]
            sigma_1, sigma_2 = np.sqrt(np.diag(self.covariance)[[3, 7]])
            lens = f", k1 = {k1:.3f} +- {sigma_1:.3f}, k2 = {k2:.3f} +- {sigma_2:.3f}"
        return (
            f"f = {self.camera.fx:.1f} +- {focal:.1f} px, principal point ({self.camera.cx:.1f} +-"
            f" {x:.1f}, {self.camera.cy:.1f} +- {y:.1f}){lens}, from {self.num_images} images"
        )


class SharedCameras:
    """Localize images without calibration, and estimate their cameras from them.

    Images of one size and one range of focal lengths, such as that of their EXIF data, have one
    camera. `known` holds the cameras that the images fix by now.
    """

    def __init__(self, localizer: Localizer) -> None:
        self.localizer = localizer
        self._estimates: dict[UncalibratedCamera, _CameraEstimate] = {}

    @property
    def known(self) -> dict[UncalibratedCamera, SharedCamera]:
        """Return the cameras that the images fix."""
        return {
            camera: each.shared
            for camera, each in self._estimates.items()
            if each.shared is not None
        }

    def localize(
        self,
        image: Image,
        camera: UncalibratedCamera | None = None,
        t_ns: int | None = None,
        max_ms: float | Deadline | None = None,
    ) -> Localization | NotLocalized:
        """Localize an image by the camera that it shares with others, or alone. See
        `Localizer.localize`."""
        camera = camera or unknown_camera(image)
        if camera not in self._estimates:
            self._estimates[camera] = _CameraEstimate(self.localizer, camera)
        result = self._estimates[camera].localize(image, max_ms)
        return result if t_ns is None else with_time(result, t_ns)


class _CameraEstimate:
    """Hold what images show of one camera. `shared` is None until they fix it."""

    def __init__(self, localizer: Localizer, uncalibrated: UncalibratedCamera) -> None:
        self.localizer, self.uncalibrated = localizer, uncalibrated
        side = float(max(uncalibrated.width, uncalibrated.height))
        self._reference = uncalibrated.with_focal(side)
        self._prior = camera_prior(uncalibrated, side)
        self._seen: list[CameraLikelihood] = []
        self._digests = set[bytes]()
        self._places = set[str]()
        self._viewpoints: list[Rigid3] = []
        self.shared: SharedCamera | None = None

    def localize(
        self, image: Image, max_ms: float | Deadline | None
    ) -> Localization | NotLocalized:
        """Localize an image by the shared camera, or alone."""
        result = None if self.shared is None else self._localize_by(self.shared, image, max_ms)
        if result is None:
            query = QueryImage(image, self.uncalibrated)
            result, named = self.localizer.localize_query(query, max_ms=max_ms)
            self._learn(image, result, named)
        return result

    def _localize_by(
        self, shared: SharedCamera, image: Image, max_ms: float | Deadline | None
    ) -> Localization | None:
        """Return the pose by the shared camera, None if there is none or the image contradicts
        it. The camera's uncertainty is added to the covariance."""
        result, named = self.localizer.localize_query(
            QueryImage(image, shared.camera), max_ms=max_ms
        )
        if not isinstance(result, Localization) or result.calibration_doubt is not None:
            return None
        self._learn(image, result, named)
        cam_from_world, of_pose = result.world_from_cam.inverse(), np.zeros((6, 6))
        seen = self._observations(named[0][1])
        fit = linearized_fit(seen, cam_from_world, parameters_of(shared.camera, self._reference))
        if fit is not None:
            of_pose = fit.pose_by_camera @ shared.covariance @ fit.pose_by_camera.T
        covariance = result.covariance + inverse_covariance(cam_from_world, of_pose)
        return replace(result, covariance=covariance, focal_length_px=shared.camera.fx)

    def _learn(
        self,
        image: Image,
        result: Localization | NotLocalized,
        named: list[tuple[Localization, PointObservations]],
    ) -> None:
        """Add what an image shows of the camera, unless it was added before, and estimate the
        camera again."""
        max_images, min_probability = 20, 0.9  # more images change little, and cost time
        max_share, max_angle = 0.2, math.radians(15.0)
        is_clear = isinstance(result, Localization) and result.probability >= min_probability
        if not is_clear or len(self._seen) >= max_images:
            return
        digest = blake2b(np.ascontiguousarray(image).data).digest()
        best, inliers = named[0]
        fit = None if digest in self._digests else self._fit(best, inliers)
        pose = best.world_from_cam
        if fit is None:
            return
        self._digests.add(digest)
        self._seen.append(fit.likelihood)
        self._places.add(f"{best.provenance.tile}/{best.node_id}")
        depth = float(np.median(pose.inverse().apply(inliers.points_world)[:, 2]))
        # a viewpoint near a known one shows the same points alike
        if not any(
            pose.is_same(viewpoint, max_share * depth, max_angle) for viewpoint in self._viewpoints
        ):
            self._viewpoints.append(pose)
        if len(self._seen) >= MIN_IMAGES and len(self._places) >= MIN_PLACES:
            self.shared = self._estimate()

    def _fit(self, result: Localization, inliers: PointObservations) -> JointFit | None:
        found = result.provenance.camera
        if found is None:
            return None
        return fit_camera(
            self._observations(inliers),
            result.world_from_cam.inverse(),
            parameters_of(found, self._reference),
            self._prior,
        )

    def _observations(self, inliers: PointObservations) -> CameraObservations:
        return CameraObservations.from_pixels(
            inliers.points_img,
            inliers.points_world,
            inliers.covariances,
            self._reference,
            self.localizer.config.pose.key_point_sigma_px,
            max_points=256,
        )

    def _estimate(self) -> SharedCamera | None:
        """Return the likeliest camera, None if none of the hypotheses explains the images or the
        focal length remains uncertain."""
        max_focal_sigma = 0.01  # more moves a pose by several of its sigmas
        together = combine_likelihoods(self._seen, self._prior, len(self._viewpoints))
        weighed = self._prior.weigh(together)
        chosen = max(weighed, key=lambda hypothesis: weighed[hypothesis][0])
        _, mean, covariance = weighed[chosen]
        if chosen.lens == "other" or math.sqrt(covariance[0, 0]) > max_focal_sigma:
            return None
        # as cameras are modelled
        mean[3:7] = mean[3:7].mean() if chosen.lens == "radial" else 0.0
        return SharedCamera(with_parameters(self._reference, mean), covariance, len(self._seen))


def combine_likelihoods(
    seen: list[CameraLikelihood], prior: CameraPrior, num_viewpoints: int
) -> CameraLikelihood:
    """Return what images show together. Images that disagree have smaller weights (Cauchy). Images
    of one viewpoint share the errors of its points, so the information is scaled to the number of
    viewpoints, and to the scatter of the images beyond their noise."""
    median_chi_square = 7.344  # of eight
    mean, covariance = prior.moments(CameraHypothesis(False, "xy", "other"))
    each = [likelihood.posteriors(mean[None], covariance[None]) for likelihood in seen]
    estimates, inverse = (
        np.stack([posterior[1][0] for posterior in each]),
        np.linalg.inv(np.stack([posterior[2][0] for posterior in each])),
    )
    centre, squares = np.median(estimates, axis=0), np.zeros(len(seen))
    weights = np.ones(len(seen))
    for _ in range(10):
        residuals = estimates - centre
        squares = np.einsum("ni,nij,nj->n", residuals, inverse, residuals)
        scatter = max(1.0, float(np.median(squares)) / median_chi_square)
        weights = 1.0 / (1.0 + squares / scatter / (CAUCHY_SCALE**2 * 4.0))
        weighted = weights[:, None, None] * inverse
        centre = np.linalg.solve(weighted.sum(axis=0), np.einsum("nij,nj->i", weighted, estimates))
    scatter = max(1.0, float(np.median(squares)) / median_chi_square) * len(seen) / num_viewpoints
    return CameraLikelihood(
        np.einsum(
            "n,nij->ij",
            weights / scatter,
            np.stack([likelihood.information for likelihood in seen]),
        ),
        np.einsum("n,ni->i", weights / scatter, np.stack([likelihood.pull for likelihood in seen])),
    )
