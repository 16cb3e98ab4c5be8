"""Cameras: pinhole with distortion, under COLMAP's model names.

Pixels are (x, y) with the centre of the top-left pixel at (0, 0); COLMAP's own origin, half a pixel up and left,
appears only where its files are read or written.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from topoloc.errors import CalibrationError

# Parameter names of each model, in COLMAP's order.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}


@dataclass(frozen=True)
class Camera:
    """One camera: COLMAP model name, image size in pixels, parameters in the model's order.

    Raises:
        CalibrationError: unknown model, wrong number of parameters, values not finite, focal length not positive.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise CalibrationError(f"unknown camera model {self.model!r}; known: {', '.join(MODELS)}")
        names = MODELS[self.model]
        if len(self.params) != len(names):
            raise CalibrationError(f"camera {self.model} takes {len(names)} parameters ({', '.join(names)}), not {len(self.params)}")
        if not np.all(np.isfinite(self.params)):
            raise CalibrationError(f"camera parameters are not finite: {self.params}")
        if self.width < 1 or self.height < 1 or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(f"camera needs a positive size and focal length, not {self.width}x{self.height}, f = {self.fx:g}")

    @staticmethod
    def pinhole(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Camera:
        return Camera("PINHOLE", width, height, (float(fx), float(fy), float(cx), float(cy)))

    def _param(self, name: str) -> float:
        names = MODELS[self.model]
        return self.params[names.index(name)] if name in names else 0.0

    @property
    def fx(self) -> float:
        return self._param("f" if "f" in MODELS[self.model] else "fx")

    @property
    def fy(self) -> float:
        return self._param("f" if "f" in MODELS[self.model] else "fy")

    @property
    def cx(self) -> float:
        return self._param("cx")

    @property
    def cy(self) -> float:
        return self._param("cy")

    @property
    def is_distorted(self) -> bool:
        return any(value != 0.0 for name, value in zip(MODELS[self.model], self.params, strict=True) if name[0] in "kp")

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K: pixels from the normalised plane."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def distortion(self) -> Float[np.ndarray, " d"]:
        """Coefficients in OpenCV's order: (k1, k2, p1, p2, k3 .. k6), or (k1 .. k4) for fisheye."""
        names = ("k1", "k2", "k3", "k4") if self.model == "OPENCV_FISHEYE" else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        return np.array([self._param(name) for name in names])

    def img_from_cam(self, points_cam: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of points in the camera frame (metres). Points at or behind the camera give NaN."""
        points = np.ascontiguousarray(points_cam, dtype=np.float64)
        if len(points) == 0:
            return np.zeros((0, 2))
        in_front = points[:, 2] > 1e-9
        safe = np.where(in_front[:, None], points, [0.0, 0.0, 1.0])
        if not self.is_distorted and self.model != "OPENCV_FISHEYE":
            pixels = safe[:, :2] / safe[:, 2:] * [self.fx, self.fy] + [self.cx, self.cy]
        elif self.model == "OPENCV_FISHEYE":
            pixels = cv2.fisheye.projectPoints(safe[:, None], np.zeros(3), np.zeros(3), self.matrix(), self.distortion())[0][:, 0]
        else:
            pixels = cv2.projectPoints(safe[:, None], np.zeros(3), np.zeros(3), self.matrix(), self.distortion())[0][:, 0]
        return np.where(in_front[:, None], pixels, np.nan)

    def normalized_from_img(self, points_img: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Undistorted coordinates (x / z, y / z) on the plane z = 1 of pixels."""
        points = np.ascontiguousarray(points_img, dtype=np.float64)
        if len(points) == 0:
            return np.zeros((0, 2))
        if self.model == "OPENCV_FISHEYE":
            return cv2.fisheye.undistortPoints(points[:, None], self.matrix(), self.distortion())[:, 0]
        if self.is_distorted:
            # OpenCV's default five iterations leave whole pixels at the corners of wide lenses.
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
            return cv2.undistortPointsIter(points[:, None], self.matrix(), self.distortion(), np.eye(3), np.eye(3), criteria)[:, 0]
        return (points - [self.cx, self.cy]) / [self.fx, self.fy]

    def rays_from_img(self, points_img: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit direction in the camera frame of each pixel."""
        normalized = self.normalized_from_img(points_img)
        rays = np.concatenate([normalized, np.ones((len(normalized), 1))], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def undistorted(self) -> Camera:
        """The pinhole camera with the same matrix and size."""
        return Camera.pinhole(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def rescaled(self, width: int, height: int) -> Camera:
        """The same camera for its image resized to width x height; pixel centres stay pixel centres."""
        scale_x, scale_y = width / self.width, height / self.height
        scaled = dict(zip(MODELS[self.model], self.params, strict=True))
        for name in scaled:
            if name in ("f", "fx"):
                scaled[name] *= scale_x
            elif name == "fy":
                scaled[name] *= scale_y
            elif name in ("cx", "cy"):
                scale = scale_x if name == "cx" else scale_y
                scaled[name] = (scaled[name] + 0.5) * scale - 0.5
        return replace(self, width=width, height=height, params=tuple(scaled.values()))

    def to_json(self) -> dict[str, object]:
        """As in ``camera.json``: model, width, height and the parameters by name."""
        return {"model": self.model, "width": self.width, "height": self.height} | dict(zip(MODELS[self.model], self.params, strict=True))

    @staticmethod
    def from_json(data: dict[str, object]) -> Camera:
        """Read the form of `to_json`; other keys (baseline, depth_factor) are left to the caller.

        Raises:
            CalibrationError: a key is missing or not a number, or the camera is not usable.
        """
        try:
            model = str(data.get("model", "PINHOLE"))
            params = tuple(float(data[name]) for name in MODELS.get(model, ()))  # type: ignore[arg-type]
            return Camera(model, int(data["width"]), int(data["height"]), params)  # type: ignore[call-overload]
        except KeyError as error:
            raise CalibrationError(f"camera: {error.args[0]!r} is missing") from None
        except (TypeError, ValueError) as error:
            raise CalibrationError(f"camera: {error}") from None
