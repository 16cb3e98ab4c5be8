"""Model cameras: pinhole with distortion, under COLMAP's model names, and uncalibrated cameras.

Pixels are (x, y) with the centre of the top-left pixel at (0, 0). COLMAP's origin, half a pixel up
and left, is used only when COLMAP's files are read or written.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from msgspec import defstruct
from msgspec.structs import astuple

from topoloc.errors import CalibrationError
from topoloc.geometry.distortion import (
    distort_fisheye,
    distort_rational,
    max_radius,
    undistort_fisheye,
    undistort_rational,
)
from topoloc.json_data import Finite, OneLine, decode_json

# Parameter names of each model, in COLMAP's order.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
# The keys of camera.json by model, without a model only the size.
_JSON = {
    model: defstruct("CameraJson", [(key, Finite) for key in ("width", "height", *names)])
    for model, names in {**MODELS, "": ()}.items()
}
# Times the longer side of the image; real lenses have 0.2 to 100.
_MIN_FOCAL_RATIO, _MAX_FOCAL_RATIO = 1e-3, 1e4
_TWO_FOCAL_MODELS = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}
_TWO_FOCAL_MODELS |= {name: "OPENCV_FISHEYE" for name in MODELS if name.endswith("L_FISHEYE")}
_TWO_FOCAL_MODELS["SIMPLE_FISHEYE"] = "FISHEYE"


@dataclass(frozen=True, repr=False)
class Camera(OneLine):
    """Hold one camera: COLMAP model name, image size in pixels, parameters in the model's order.

    `mask`, of the image in any size, is False where the image moves with the camera, such as the
    robot's own body. Files do not hold it.

    Raises:
        CalibrationError: the model is unknown, the number of parameters is wrong, values are not
            finite, or the focal length is not positive or not realistic.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    mask: Bool[np.ndarray, "mask_h mask_w"] | None = field(
        default=None, compare=False, kw_only=True
    )

    @staticmethod
    def model_names() -> list[str]:
        """Return the names of all camera models."""
        return list(MODELS)

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise CalibrationError(
                f"unknown camera model {self.model!r}; undistort the images, or calibrate as one of"
                f" {', '.join(MODELS)}"
            )
        names = MODELS[self.model]
        if len(self.params) != len(names):
            raise CalibrationError(
                f"camera {self.model} takes {len(names)} parameters ({', '.join(names)}), not"
                f" {len(self.params)}"
            )
        if not np.all(np.isfinite(self.params)):
            raise CalibrationError(f"camera parameters are not finite: {self.params}")
        if self.fx > 0.0 > self.fy:
            raise CalibrationError(
                f"fy = {self.fy:g} is of a camera whose y points up; here it points down: write fy"
                f" = {-self.fy:g}"
            )
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(
                f"camera needs a positive size and focal length, not {self.width}x{self.height}, fx"
                f" = {self.fx:g}, fy = {self.fy:g}"
            )
        side = max(self.width, self.height)
        ratios = self.fx / side, self.fy / side
        if not _MIN_FOCAL_RATIO < min(ratios) <= max(ratios) < _MAX_FOCAL_RATIO:
            raise CalibrationError(
                f"no lens has a focal length of {self.fx:g}, {self.fy:g} pixels with a picture of"
                f" {side} pixels"
            )

    @staticmethod
    def pinhole(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
        """Return a pinhole camera. Lengths are in pixels."""
        return Camera("PINHOLE", width, height, (float(fx), float(fy), float(cx), float(cy)))

    def _param(self, name: str) -> float:
        return dict(zip(MODELS[self.model], self.params, strict=True)).get(name, 0.0)

    @cached_property
    def fx(self) -> float:
        """Return the horizontal focal length, pixels."""
        return self._param("f" if "f" in MODELS[self.model] else "fx")

    @cached_property
    def fy(self) -> float:
        """Return the vertical focal length, pixels."""
        return self._param("f" if "f" in MODELS[self.model] else "fy")

    @cached_property
    def cx(self) -> float:
        """Return the x coordinate of the principal point, pixels."""
        return self._param("cx")

    @cached_property
    def cy(self) -> float:
        """Return the y coordinate of the principal point, pixels."""
        return self._param("cy")

    @cached_property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy), pixels."""
        return self.fx, self.fy, self.cx, self.cy

    @cached_property
    def is_fisheye(self) -> bool:
        """Return whether the model is OpenCV's fisheye, with any number of its coefficients."""
        return self.model.endswith("FISHEYE")

    @cached_property
    def is_distorted(self) -> bool:
        """Return whether the camera is not a plain pinhole. A fisheye camera is always distorted,
        whatever its coefficients."""
        return self.is_fisheye or any(
            value != 0.0
            for name, value in zip(MODELS[self.model], self.params, strict=True)
            if name[0] in "kp"
        )

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """Return K, which maps the plane z = 1 to pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def distortion(self) -> Float[np.ndarray, " d"]:
        """Return the coefficients in OpenCV's order: (k1, k2, p1, p2, k3 .. k6), or (k1 .. k4) for
        fisheye."""
        names = MODELS["OPENCV_FISHEYE" if self.is_fisheye else "FULL_OPENCV"][4:]
        return np.array([self._param(name) for name in names])

    def img_from_cam(self, points_cam: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Return the pixels of points in the camera frame (metres).

        Points at or behind the camera, and points outside the valid field of the distortion model,
        give NaN.
        """
        in_front = points_cam[:, 2] > 1e-9
        normalized = points_cam[:, :2] / np.where(in_front, points_cam[:, 2], np.nan)[:, None]
        if self.is_distorted:
            limit = max_radius(tuple(self.distortion().tolist()), self.is_fisheye)
            in_field = np.linalg.norm(normalized, axis=1) <= limit
            normalized = self._distort(np.where(in_field[:, None], normalized, np.nan))[0]
        return normalized * [self.fx, self.fy] + [self.cx, self.cy]

    def normalized_from_img(self, points_img: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return the undistorted coordinates (x / z, y / z) of pixels on the plane z = 1, NaN for
        pixels without a ray."""
        centred = np.asarray(points_img, dtype=np.float64) - [self.cx, self.cy]
        distorted = centred / [self.fx, self.fy]
        if not self.is_distorted:
            return distorted
        undistort = undistort_fisheye if self.is_fisheye else undistort_rational
        return undistort(self.distortion(), distorted)

    def normalized_jacobian(
        self, normalized: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n 2 2"]:
        """Return the derivative of `normalized_from_img` at the pixels with these undistorted
        coordinates."""
        focal = np.array([self.fx, self.fy])
        if not self.is_distorted:
            return np.broadcast_to(np.diag(1.0 / focal), (len(normalized), 2, 2)).copy()
        (a, b), (c, d) = self._distort(normalized)[1].transpose(1, 2, 0)
        inverse = np.stack([d, -b, -c, a], axis=1) / (a * d - b * c)[:, None]
        return inverse.reshape(-1, 2, 2) / focal

    def _distort(
        self, normalized: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 2"]]:
        distort = distort_fisheye if self.is_fisheye else distort_rational
        return distort(self.distortion(), normalized)

    def rays_from_img(self, points_img: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Return the unit direction of each pixel in the camera frame."""
        normalized = self.normalized_from_img(points_img)
        rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def undistorted(self) -> Camera:
        """Return the pinhole camera with the same matrix and size."""
        return Camera.pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    @cached_property
    def radius_scale(self) -> float:
        """Return the factor of a radius that is meant for images of 640 pixels, at least 0.5."""
        return max(max(self.width, self.height) / 640.0, 0.5)

    def is_in_image(self, points_img: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Return which pixels are in the image and not left out by its mask. NaN is not."""
        size = np.array([self.width, self.height])
        with np.errstate(invalid="ignore"):
            inside = np.all((points_img >= -0.5) & (points_img < size - 0.5), axis=1)
        if self.mask is not None:
            ends = np.array(self.mask.shape[::-1])
            cells = (points_img[inside] + 0.5) * (ends / size)
            columns, rows = np.minimum(cells.astype(int), ends - 1).T
            inside[inside] = self.mask[rows, columns]
        return inside

    def with_focal(self, focal: float) -> Camera:
        """Return the camera with this focal length (pixels) in both directions."""
        named = zip(MODELS[self.model], self.params, strict=True)
        return replace(
            self, params=tuple(focal if name[0] == "f" else value for name, value in named)
        )

    def is_similar(self, other: Camera) -> bool:
        """Return whether two opposite corners have nearly the same rays in both cameras: to 0.02 on
        the plane z = 1."""
        if self == other:
            return True
        corners = np.array([[0.0, 0.0], [self.width - 1.0, self.height - 1.0]])
        apart = self.normalized_from_img(corners) - other.normalized_from_img(corners)
        return bool(np.all(np.abs(apart) < 0.02))

    def rescaled(self, width: int, height: int) -> Camera:
        """Return the camera of the image resized to width x height. Pixel centres stay pixel
        centres.

        If the two scales differ, a model with one focal length becomes its counterpart with two.
        """
        scale_x, scale_y = width / self.width, height / self.height
        model = self.model if scale_x == scale_y else _TWO_FOCAL_MODELS.get(self.model, self.model)
        scaled = {
            "f": self.fx * scale_x,
            "fx": self.fx * scale_x,
            "fy": self.fy * scale_y,
            "cx": (self.cx + 0.5) * scale_x - 0.5,
            "cy": (self.cy + 0.5) * scale_y - 0.5,
        }
        params = (scaled.get(name, self._param(name)) for name in MODELS[model])
        return Camera(model, width, height, tuple(params), mask=self.mask)

    def to_colmap(self) -> tuple[str, int, int, tuple[float, ...]]:
        """Return (model, width, height, params) in COLMAP's convention: the centre of the top-left
        pixel is (0.5, 0.5)."""
        return self.model, self.width, self.height, self._shift_principal_point(0.5)

    @staticmethod
    def from_colmap(model: str, width: int, height: int, params: tuple[float, ...]) -> Camera:
        """Return the camera of one entry of COLMAP's cameras file. Inverse of `to_colmap`. A model
        that is not in `model_names` is replaced by one that gives its pixels to 0.1 px.

        Raises:
            CalibrationError: the model is unknown, none is that near, or the parameters are not
                usable.
        """
        params = tuple(map(float, params))
        if model not in MODELS:
            from topoloc.geometry.fitted_models import fit_known_model  # loads an optimizer

            model, params = fit_known_model(model, width, height, params)
        camera = Camera(model, width, height, params)
        return replace(camera, params=camera._shift_principal_point(-0.5))

    def _shift_principal_point(self, offset_px: float) -> tuple[float, ...]:
        named = zip(MODELS[self.model], self.params, strict=True)
        return tuple(value + offset_px if name in ("cx", "cy") else value for name, value in named)

    def to_json(self) -> dict[str, object]:
        """Return the form of ``camera.json``: model, width, height and the parameters by name."""
        size: dict[str, object] = {"model": self.model, "width": self.width, "height": self.height}
        return size | dict(zip(MODELS[self.model], self.params, strict=True))

    @staticmethod
    def from_json(data: Any, name: str = "camera") -> Camera:
        """Parse the form of `to_json`, from text or an object. Other keys (baseline, depth_factor)
        are ignored. `name` is its name in errors.

        Raises:
            CalibrationError: a key is missing or not a number, or the camera is not usable.
        """
        values = decode_json(data, dict[str, Any], CalibrationError, name)
        model = str(values.get("model", "PINHOLE"))
        kind = _JSON.get(model, _JSON[""])
        width, height, *params = astuple(decode_json(values, kind, CalibrationError, name))
        with CalibrationError.at(name):
            return Camera(model, int(width), int(height), tuple(params))


# As fractions of the longer side: fields of view of 103 to 19 degrees along it, from the wide lens
# of a phone to its telephoto lens.
MIN_FOCAL, MAX_FOCAL = 0.4, 3.0
# Error factor of a focal length in EXIF data: it is rounded, and focusing and stabilisation change
# it.
FOCAL_GUESS_TOLERANCE = 1.15


@dataclass(frozen=True)
class UncalibratedCamera:
    """Hold a pinhole with square pixels, its principal point in the image centre, a focal length
    (pixels) between two bounds, and `Camera.mask`.

    Raises:
        CalibrationError: the size is not positive, or the range is not one of positive lengths.
    """

    width: int
    height: int
    min_focal: float
    max_focal: float
    mask: Bool[np.ndarray, "mask_h mask_w"] | None = field(
        default=None, compare=False, kw_only=True
    )

    def __post_init__(self) -> None:
        is_range = 0.0 < self.min_focal <= self.max_focal < math.inf
        if self.width < 1 or self.height < 1 or not is_range:
            raise CalibrationError(
                "a camera needs a size and a range of focal lengths, not"
                f" {self.width}x{self.height}, f = {self.min_focal:g} to {self.max_focal:g}"
            )

    @staticmethod
    def unknown(width: int, height: int) -> UncalibratedCamera:
        """Return a camera with the range of usual lenses."""
        side = max(width, height)
        return UncalibratedCamera(width, height, MIN_FOCAL * side, MAX_FOCAL * side)

    @staticmethod
    def from_focal_guess(width: int, height: int, focal: float | None) -> UncalibratedCamera:
        """Return a camera with a range around an approximate focal length (pixels), such as that of
        EXIF data. If it is None, return `unknown`."""
        if focal is None:
            return UncalibratedCamera.unknown(width, height)
        return UncalibratedCamera(
            width, height, focal / FOCAL_GUESS_TOLERANCE, focal * FOCAL_GUESS_TOLERANCE
        )

    def with_focal(self, focal: float) -> Camera:
        """Return the pinhole camera of this focal length (pixels)."""
        centre = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera("PINHOLE", self.width, self.height, (focal, focal, *centre), mask=self.mask)

    def rescaled(self, width: int, height: int) -> UncalibratedCamera:
        """Return the camera of the image resized to width x height."""
        scale = math.sqrt(width * height / (self.width * self.height))
        focals = self.min_focal * scale, self.max_focal * scale
        return UncalibratedCamera(width, height, *focals, mask=self.mask)


def nominal_camera(camera: Camera | UncalibratedCamera) -> Camera:
    """Return the camera itself. For an uncalibrated camera, return the one with the focal length in
    the (geometric) middle of its range."""
    return (
        camera.with_focal(math.sqrt(camera.min_focal * camera.max_focal))
        if isinstance(camera, UncalibratedCamera)
        else camera
    )
