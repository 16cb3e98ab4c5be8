"""Fit a model that `Camera` has to a camera of another model of COLMAP: FOV, division, EUCM and
those with thin prisms.

Formulas are those of COLMAP's models.h, on coordinates (x / z, y / z).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from topoloc.errors import CalibrationError
from topoloc.geometry.distortion import distort_fisheye, distort_rational, max_radius

Points = Float[np.ndarray, "n 2"]
_MAX_ERROR_PX = 0.1
_MAX_ANGLE = np.deg2rad(86.0)


def _fov(k: list[float], points: Points, r: Float[np.ndarray, "n 1"]) -> Points:
    (omega,) = k
    if abs(omega) < 1e-4:
        return points
    return points * np.arctan(2.0 * r * np.tan(0.5 * omega)) / (r * omega)


def _division(k: list[float], points: Points, r: Float[np.ndarray, "n 1"]) -> Points:
    return 2.0 * points / (1.0 + np.sqrt(1.0 - 4.0 * k[0] * r * r))


def _eucm(k: list[float], points: Points, r: Float[np.ndarray, "n 1"]) -> Points:
    alpha, beta = k
    return points / (alpha * np.sqrt(beta * r * r + 1.0) + 1.0 - alpha)


def _thin_prism_fisheye(k: list[float], points: Points, r: Float[np.ndarray, "n 1"]) -> Points:
    k1, k2, p1, p2, k3, k4, *prisms = k
    bent = points * np.arctan(r) / r
    return _bend(bent, [k1, k2, k3, k4]) + _decentre(bent, [p2, p1], [*prisms, 0.0, 0.0])


def _rad_tan_thin_prism_fisheye(
    k: list[float], points: Points, r: Float[np.ndarray, "n 1"]
) -> Points:
    bent = _bend(points * np.arctan(r) / r, k[:6])
    p1, p2, sx1, sx2, sy1, sy2 = k[6:]
    return bent + _decentre(bent, [p1, p2], [sx1, sy1, sx2, sy2])


def _bend(points: Points, radial: list[float]) -> Points:
    square = np.sum(points * points, axis=1, keepdims=True)
    return points * np.polyval([*reversed(radial), 1.0], square)


def _decentre(points: Points, tangential: list[float], prisms: list[float]) -> Points:
    """Return the shift by tangential distortion and thin prisms (of r^2 in x and y, and r^4)."""
    square = np.sum(points * points, axis=1, keepdims=True)
    p = np.array(tangential)
    along = 2.0 * points * (points @ p)[:, None] + square * p
    return along + square * prisms[:2] + square * square * prisms[2:]


# model -> its number of parameters, that of focal lengths, and the distortion on the plane z = 1
_OTHERS: dict[str, tuple[int, int, Callable[..., Points]]] = {
    "FOV": (5, 2, _fov),
    "SIMPLE_DIVISION": (4, 1, _division),
    "DIVISION": (5, 2, _division),
    "EUCM": (6, 2, _eucm),
    "THIN_PRISM_FISHEYE": (12, 2, _thin_prism_fisheye),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, 2, _rad_tan_thin_prism_fisheye),
}
# model -> its number of coefficients, and the distortion
_TARGETS = {"OPENCV_FISHEYE": (4, distort_fisheye), "FULL_OPENCV": (8, distort_rational)}


def fit_known_model(
    model: str, width: int, height: int, params: tuple[float, ...]
) -> tuple[str, tuple[float, ...]]:
    """Return the model and parameters that give the pixels of another model of COLMAP, to 0.1 px
    in the whole image, in the same frame of pixels. A known model is returned as it is.

    Raises:
        CalibrationError: no model is that near, or the number of parameters is wrong.
    """
    if model not in _OTHERS:
        return model, params
    if len(params) != _OTHERS[model][0] or not np.isfinite(params).all():
        raise CalibrationError(
            f"camera {model} takes {_OTHERS[model][0]} finite numbers, not {len(params)}"
        )
    errors = {}
    for target in _TARGETS:
        error, fitted = _fit(target, model, width, height, params)
        if error < _MAX_ERROR_PX:
            return target, fitted
        errors[target] = error
    raise CalibrationError(
        f"camera model {model} with these parameters is {min(errors.values()):.2g} pixels off the"
        " nearest model known here; undistort the images (colmap image_undistorter), or calibrate"
        " as OPENCV_FISHEYE or FULL_OPENCV"
    )


@lru_cache(maxsize=64)
def _fit(
    target: str, model: str, width: int, height: int, params: tuple[float, ...]
) -> tuple[float, tuple[float, ...]]:
    """Return the largest error (pixels) of the target model in the image, and its parameters."""
    points, pixels = _sample(model, width, height, params)
    (num, distort), num_focal = _TARGETS[target], _OTHERS[model][1]
    start = [params[0], params[num_focal - 1], *params[num_focal : num_focal + 2], *[0.0] * num]
    max_points = 500
    some = slice(None, None, len(points) // max_points + 1)

    def errors(values: np.ndarray, part: slice) -> np.ndarray:
        bent = distort(values[4:], points[part])[0] * values[:2] + values[2:4]
        return np.nan_to_num(bent - pixels[part], nan=1e3, posinf=1e3, neginf=-1e3)

    if len(points) == 0:
        return np.inf, ()
    found = _minimize(lambda values: errors(values, some).ravel(), np.array(start))
    limit = max_radius(tuple(found[4:].tolist()), target == "OPENCV_FISHEYE")
    if limit < np.linalg.norm(points, axis=1).max():
        return np.inf, ()
    error = np.linalg.norm(errors(found, slice(None)), axis=1).max()
    return float(error), tuple(found.tolist())


def _minimize(
    errors: Callable[[np.ndarray], np.ndarray], values: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Return the values of the least sum of squared errors near `values` (Levenberg-Marquardt,
    derivatives by differences)."""
    step, damping, found = 1e-6, 1e-3, errors(values)
    for _ in range(60):
        shifts = step * np.maximum(np.abs(values), 1.0)
        columns = [errors(values + one) - found for one in np.diag(shifts)]
        jacobian = np.stack(columns, axis=1) / shifts
        scales = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-9)
        damped = np.vstack([jacobian, np.diag(np.sqrt(damping) * scales)])
        change = np.linalg.lstsq(damped, np.append(-found, np.zeros(len(values))), rcond=None)[0]
        tried = errors(values + change)
        if tried @ tried < found @ found:
            values, found, damping = values + change, tried, 0.1 * damping
        else:
            damping *= 10.0
    return values


def _sample(
    model: str, width: int, height: int, params: tuple[float, ...]
) -> tuple[Points, Points]:
    """Return points of rays over the image, and their pixels. A ray is left out if one nearer to
    the axis lies farther from the centre: there the distortion folds back."""
    _, num_focal, distort = _OTHERS[model]
    focal, centre = params[:num_focal], params[num_focal : num_focal + 2]
    angles, turns = np.linspace(0.002, _MAX_ANGLE, 150), np.linspace(0.0, 2.0 * np.pi, 180, False)
    unit = np.column_stack([np.cos(turns), np.sin(turns)])
    points = (np.tan(angles)[:, None, None] * unit).reshape(-1, 2)
    with np.errstate(all="ignore"):
        bent = distort(
            list(params[num_focal + 2 :]), points, np.linalg.norm(points, axis=1, keepdims=True)
        )
    radii = np.nan_to_num(np.linalg.norm(bent, axis=1), nan=-1.0).reshape(len(angles), -1)
    is_first = np.logical_and.accumulate(np.diff(radii, axis=0, prepend=0.0) > 0.0).ravel()
    pixels = bent * focal + centre
    is_seen = is_first & np.all((pixels >= 0.0) & (pixels <= [width, height]), axis=1)
    return points[is_seen], pixels[is_seen]
