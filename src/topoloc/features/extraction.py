"""Extract the features of an image with a feature type and a normalisation, both chosen by name.

A map and its queries must use the same `FeatureConfig`. Each map stores its own.

Virtual views show the walls along a camera's path, as if the camera faced them. On the way back
along a corridor, a camera sees the walls under the opposite slant. No local feature survives this
change. A camera that only rotates sees the same rays. So its image follows from the original one
without depth, by a homography or by the mapping of a distorted lens. Turned by 90 degrees to the
left and to the right, the camera faces walls, facades and shelves along the path. It sees them
without slant, and alike from both directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from topoloc.bounds import Above, AtLeast, Between
from topoloc.compiled import kernel, parallel_for_rows
from topoloc.features.feature_types import FeatureConfig, find_feature_type
from topoloc.features.features import Features
from topoloc.geometry.camera import Camera, UncalibratedCamera, nominal_camera
from topoloc.geometry.rigid import Rigid3


@kernel()
def _sliding_sum(values, width, out):
    """Compute out[x] = sum of values[x : x + width]."""
    total = np.int32(0)
    for x in range(width - 1):
        total += values[x]
    for x in range(out.shape[0]):
        total = np.int32(total + values[x + width - 1])
        out[x] = total
        total = np.int32(total - values[x])


@kernel(error_model="numpy")
def _normalize_row(centre, sums, sums_sq, weight, floor, gain, out):
    """Compute 128 + gain (I - mean) / (sigma + epsilon). Numerator and denominator are multiplied
    by the window's weight."""
    for x in range(out.shape[0]):
        total = np.float64(sums[x])
        spread = np.sqrt(np.float32(weight * np.float64(sums_sq[x]) - total * total))
        above_mean = np.float32(weight * (np.float64(centre[x]) - 128.0) - total)
        denominator = spread + floor
        value = np.float32(128.5) + (
            gain * above_mean / denominator if denominator > 0 else np.float32(0.0)
        )
        out[x] = np.uint8(min(max(value, np.float32(0.0)), np.float32(255.0)))


@kernel(error_model="numpy")
def normalize_band(padded, out, first_row, last_row, first_box, second_box, epsilon, gain):
    """Write rows [first_row, last_row) of `out`. The image is padded on each side by (first_box +
    second_box) / 2 - 1 pixels.

    The window is a box of `first_box` pixels a side, smoothed by a box of `second_box` pixels (1:
    no smoothing). All sums are integers, so the result does not depend on the start of a band. Grey
    levels are taken relative to 128 to keep the sums within 32 bits.
    """
    padded_width = padded.shape[1]
    inner_width = padded_width - first_box + 1
    height_of_window = first_box + second_box - 1
    width = out.shape[1]
    columns, columns_sq = np.zeros(padded_width, np.int32), np.zeros(padded_width, np.int32)
    ring = np.zeros((second_box, inner_width), np.int32)
    ring_sq = np.zeros((second_box, inner_width), np.int32)
    rows, rows_sq = np.zeros(inner_width, np.int32), np.zeros(inner_width, np.int32)
    sums, sums_sq = np.zeros(width, np.int32), np.zeros(width, np.int32)
    weight = float((first_box * second_box) ** 2)
    radius = height_of_window // 2
    for step in range(last_row - first_row + height_of_window - 1):
        entering = padded[first_row + step]
        if step < first_box:
            for x in range(padded_width):
                value = np.int32(entering[x]) - np.int32(128)
                columns[x] += np.int32(value)
                columns_sq[x] += np.int32(value * value)
        else:
            leaving = padded[first_row + step - first_box]
            for x in range(padded_width):
                value = np.int32(np.int32(entering[x]) - np.int32(128))
                old = np.int32(np.int32(leaving[x]) - np.int32(128))
                columns[x] += np.int32(value - old)
                columns_sq[x] += np.int32(np.int32(value * value) - np.int32(old * old))
        if step < first_box - 1:
            continue
        slot = (step - first_box + 1) % second_box
        for x in range(inner_width):
            rows[x] -= ring[slot, x]
            rows_sq[x] -= ring_sq[slot, x]
        _sliding_sum(columns, first_box, ring[slot])
        _sliding_sum(columns_sq, first_box, ring_sq[slot])
        for x in range(inner_width):
            rows[x] += ring[slot, x]
            rows_sq[x] += ring_sq[slot, x]
        if step < height_of_window - 1:
            continue
        _sliding_sum(rows, second_box, sums)
        _sliding_sum(rows_sq, second_box, sums_sq)
        y = first_row + step - height_of_window + 1
        centre = padded[y + radius, radius : radius + width]
        _normalize_row(
            centre, sums, sums_sq, weight, np.float32(weight * epsilon), np.float32(gain), out[y]
        )


@dataclass(frozen=True)
class PatchNormalizationConfig:
    """Hold the settings of patch normalisation. `PatchNormalizationConfig.paper` is the paper's
    form."""

    window_px: Annotated[int, Between(3, 127)] = 17
    """Side of the window, odd."""
    epsilon: Annotated[float, AtLeast(0)] = 1e-3
    """Grey levels added to sigma. A tiny value, as in the paper, only prevents a division by zero.
    A few grey levels also prevent that sensor noise of plain surfaces is amplified."""
    shape: Literal["square", "round"] = "square"
    """`square` weighs all pixels of the window equally. `round` applies a box of half the width
    twice: a bell of the same support, without axis-parallel ringing."""
    gain: Annotated[float, Above(0)] = 40.0
    """Grey levels of the result per unit of N, which is mapped to 128 + gain N and clipped."""

    def __post_init__(self) -> None:
        largest = 127 if self.shape == "square" else 37  # sums of squares stay within 32 bits
        if not 3 <= self.window_px <= largest or self.window_px % 2 == 0:
            raise ValueError(
                f"window_px must be odd and within 3 .. {largest}, not {self.window_px}"
            )
        if not self.epsilon >= 0.0 or not self.gain > 0.0:
            raise ValueError(
                f"epsilon must not be negative and gain be positive, not {self.epsilon} and"
                f" {self.gain}"
            )

    @staticmethod
    def paper() -> PatchNormalizationConfig:
        """Return the paper's form: square 17x17 windows, with epsilon only against a division by
        zero."""
        return PatchNormalizationConfig(window_px=17, epsilon=1e-3, shape="square")

    def box_sizes(self) -> tuple[int, int]:
        """Return the sides of the two boxes applied one after the other. Together they cover
        `window_px`."""
        if self.shape == "square":
            return self.window_px, 1
        second = (self.window_px + 1) // 2
        return self.window_px + 1 - second, second


def patch_normalize(
    image: UInt8[np.ndarray, "h w"],
    config: PatchNormalizationConfig,
    num_threads: int | None = None,
) -> UInt8[np.ndarray, "h w"]:
    """Return the normalised image N as 8 bit: 128 + gain N, rounded and clipped to 0 .. 255.

    The paper, section III-C: ``N(p) = (I(p) - mu_P) / (sigma_P + epsilon)`` in 17x17 windows,
    before key points are detected. Features then survive changes of lighting (Zhang and Kleeman,
    2009).
    The image is reflected at its borders without repeating the border row. If sigma + epsilon is 0,
    N is 0. The result is byte-identical for any `num_threads`.
    """
    radius = config.window_px // 2
    padded = cv2.copyMakeBorder(image, radius, radius, radius, radius, cv2.BORDER_REFLECT_101)
    normalized = np.empty_like(image, order="C")

    def run(first_row: int, last_row: int) -> None:
        numbers = *config.box_sizes(), config.epsilon, config.gain
        normalize_band(padded, normalized, first_row, last_row, *numbers)

    parallel_for_rows(run, len(image), num_threads)
    return normalized


NORMALIZATIONS: dict[str, PatchNormalizationConfig | None] = {
    "none": None,
    "paper": PatchNormalizationConfig.paper(),
    # The window is wider than most key points, so that it keeps their shape. The noise floor keeps
    # textureless walls plain.
    "wide": PatchNormalizationConfig(window_px=65, epsilon=24.0),
}


def extract_features(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> Features:
    """Return the features of a grey image, strongest first. They are the same for any
    `num_threads`.

    Dense descriptors are dropped: they would fill the memory if features of many images are held.

    Raises:
        FeatureTypeError: the feature type is unknown.
    """
    normalized = normalize_image(image, config, num_threads)
    return replace(extract_from_normalized(normalized, config, num_threads), dense=None)


def drop_masked(features: Features, camera: Camera | UncalibratedCamera) -> Features:
    """Return the features that the mask of the image's camera does not leave out, and all dense
    descriptors."""
    if camera.mask is None:
        return features
    used = nominal_camera(camera).is_in_image(features.points_img)
    return replace(features.select(used), dense=features.dense)


def normalize_image(
    image: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> UInt8[np.ndarray, "h w"]:
    """Return the normalised image in which key points are detected. This is the first step of
    `extract_features`."""
    name = config.normalization or find_feature_type(config.kind).normalization
    normalization = NORMALIZATIONS[name]
    return image if normalization is None else patch_normalize(image, normalization, num_threads)


def extract_from_normalized(
    normalized: UInt8[np.ndarray, "h w"], config: FeatureConfig, num_threads: int | None = None
) -> Features:
    """Return the features of an image from `normalize_image`, with dense descriptors if the feature
    type has them. This is the second step of `extract_features`."""
    return find_feature_type(config.kind).extract(normalized, config, num_threads)


@dataclass(frozen=True, eq=False)
class VirtualView:
    """Hold a pinhole camera at the same place, turned to the side, and the image pixel of each of
    its pixels.

    `points_img` are the pixels of the image for the pixels of the virtual camera, NaN outside the
    camera's field. `inside` is True at pixels well within the image, where features are kept.
    """

    name: str
    camera: Camera
    cam_from_virtual: Rigid3
    points_img: Float32[np.ndarray, "a b 2"]
    inside: Bool[np.ndarray, "a b"]

    def virtual_from_world(self, cam_from_world: Rigid3) -> Rigid3:
        """Return the pose of the virtual camera (virtual_from_world) from that of the image's
        camera."""
        return self.cam_from_virtual.inverse() @ cam_from_world

    def picture(self, grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "a b"]:
        """Return the image of the virtual camera. Beyond the original image its border is repeated,
        which adds no edges."""
        # The stubs reject None although it is right: OpenCV 5 takes an empty array for a map.
        remap: Any = cv2.remap
        points_img, border = self.points_img, cv2.BORDER_REPLICATE
        return remap(grey, points_img, None, cv2.INTER_LINEAR, borderMode=border)

    def columns_within(self, max_tangent: float) -> slice:
        """Return the columns whose tangent ahead, off the virtual camera's axis, is at most this.
        They show the nearest part of the wall."""
        last = round(max_tangent * self.camera.fx)
        is_left = self.cam_from_virtual.rotation[0, 2] < 0.0
        middle = round(self.camera.cx)
        return slice(0, max(middle + last, 1)) if is_left else slice(max(middle - last, 0), None)

    def select_inside(self, features: Features) -> Features:
        """Return the features inside the rendered area. All dense descriptors are kept."""
        columns, rows = np.rint(features.points_img).astype(int).T
        return replace(features.select(self.inside[rows, columns]), dense=features.dense)

    def to_image_pixels(self, features: Features, camera: Camera) -> Features:
        """Return the same features at the pixels of the original image, taken by `camera`."""
        rays_virtual = self.camera.rays_from_img(features.points_img.astype(np.float64))
        rays = rays_virtual @ self.cam_from_virtual.rotation.T
        return replace(features, points_img=camera.img_from_cam(rays).astype(np.float32))


@lru_cache(maxsize=8)
def make_virtual_views(camera: Camera, max_nearest: float = 1.5) -> tuple[VirtualView, ...]:
    """Return the virtual views to the left and to the right, without those for which the field of
    view is too narrow: it begins beyond `max_nearest`, a tangent off the virtual camera's axis."""
    sides = (("left", -1.0), ("right", 1.0))
    views = (_make_virtual_view(camera, name, sign, max_nearest) for name, sign in sides)
    return tuple(view for view in views if view is not None)


def _make_virtual_view(
    camera: Camera, name: str, sign: float, max_nearest: float
) -> VirtualView | None:
    """Return one virtual view, or None. `sign` is that of x in the camera's frame. The virtual
    camera's x axis points ahead on the left and back on the right."""
    farthest = 3.0  # largest tangent ahead. Walls farther ahead are too slanted to be seen well
    half_height = 0.9  # largest tangent up and down
    max_side_px = 700  # maximum length of the longer side of a virtual view
    margin_px = 8  # features nearer than this to the border of the rendered area are dropped
    cam_from_virtual = Rigid3(
        np.array([[0.0, 0.0, sign], [0.0, 1.0, 0.0], [-sign, 0.0, 0.0]]), np.zeros(3)
    )
    # The largest tangent to the side in the field of view. Rays behind the camera, at the ends of
    # its rows, have no tangent and are ignored.
    row = np.column_stack([np.arange(camera.width), np.full(camera.width, camera.cy)])
    tangent = float(np.nanmax(sign * camera.normalized_from_img(row)[:, 0]))
    if tangent * max_nearest < 1.0:
        return None
    nearest, focal = 1.0 / tangent, camera.fx
    extent = np.array([farthest - nearest, 2.0 * half_height])
    focal *= min(1.0, max_side_px / (focal * extent.max()))
    width, height = np.maximum(np.rint(focal * extent), 1).astype(int)
    # x points ahead on the left and back on the right, so the image lies on one side of the axis or
    # on the other
    cx = -focal * nearest if sign < 0 else focal * farthest
    virtual = Camera.pinhole(int(width), int(height), focal, focal, cx, focal * half_height)
    shape = virtual.height, virtual.width
    rays = virtual.rays_from_img(np.indices(shape, np.float64)[::-1].reshape(2, -1).T)
    # the rotation permutes the axes; a product of matrices would wait for BLAS's threads
    rays_cam = np.column_stack([sign * rays[:, 2], rays[:, 1], -sign * rays[:, 0]])
    points_img = camera.img_from_cam(rays_cam).reshape(*shape, 2)
    reach = np.isfinite(points_img).all(axis=2) & (points_img >= 0).all(axis=2)
    reach &= (points_img <= [camera.width - 1, camera.height - 1]).all(axis=2)
    kernel = np.ones((2 * margin_px + 1,) * 2, np.uint8)
    padded = np.pad(reach.astype(np.uint8), 1)  # by default, pixels beyond the border do not count
    inside = cv2.erode(padded, kernel)[1:-1, 1:-1].astype(bool)
    return VirtualView(name, virtual, cam_from_virtual, points_img.astype(np.float32), inside)
