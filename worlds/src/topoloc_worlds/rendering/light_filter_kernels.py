"""One pass of the light filter, compiled. Pictures lie plane by plane, so that the inner loops run
along a row with SIMD."""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, fastmath=True, nogil=True)
def _add_neighbours(planes, sigma, kernel, y, v, shift, sums):
    """Add to each pixel's sums in row y the contribution of the pixel of row v that is `shift` to
    the right.

    planes: light to mirror, as for `spread_light`. sums, (w,) each: of the shares, of the shares
    times weight, of the variance with the square of that product, and of red, green and blue with
    the product.
    """
    light, brightness, weight, variance, doubt, normal, position, reach, mirror = planes
    share, total, total_variance, red, green, blue = sums
    width = weight.shape[1]
    for x in range(max(0, -shift), min(width, width - shift)):
        u = x + shift
        nx, ny, nz = normal[0, y, x], normal[1, y, x], normal[2, y, x]
        alike = max(
            np.float32(0.0), nx * normal[0, v, u] + ny * normal[1, v, u] + nz * normal[2, v, u]
        )
        alike *= alike
        alike *= alike
        alike *= alike
        off = (
            nx * (position[0, v, u] - position[0, y, x])
            + ny * (position[1, v, u] - position[1, y, x])
            + nz * (position[2, v, u] - position[2, y, x])
        ) / reach[y, x]
        flat = max(np.float32(0.0), np.float32(1.0) - off * off)
        brighter = brightness[v, u] - brightness[y, x]
        spread = sigma * doubt[y, x] + np.float32(1e-12)
        near = max(
            np.float32(0.0), np.float32(1.0) - np.float32(0.125) * brighter * brighter / spread
        )
        near *= near
        near *= near
        near *= near
        geometric = kernel * alike * flat * near * (np.float32(1.0) - mirror[y, x])
        w = geometric * weight[v, u]
        share[x] += geometric
        total[x] += w
        total_variance[x] += w * w * variance[v, u]
        red[x] += w * light[0, v, u]
        green[x] += w * light[1, v, u]
        blue[x] += w * light[2, v, u]


@nb.njit(cache=True, fastmath=True, nogil=True)
def spread_light(
    light,
    brightness,
    weight,
    variance,
    doubt,
    normal,
    position,
    reach,
    mirror,
    step,
    sigma,
    light_out,
    weight_out,
    variance_out,
):
    """Average every pixel with its eight neighbours `step` pixels away, if they are on the same
    plane and have similar brightness.

    light, normal, position: (3, h, w). All others (h, w): brightness to compare, weight (confidence
    in a pixel's light), variance (of its light), doubt (variance of the brightness, for the
    comparison), reach (metres off its plane that still belong to it), mirror (1 for pixels that
    stay unchanged).
    """
    height, width = weight.shape
    planes = (light, brightness, weight, variance, doubt, normal, position, reach, mirror)
    share, total, total_variance = (
        np.empty(width, np.float32),
        np.empty(width, np.float32),
        np.empty(width, np.float32),
    )
    red, green, blue = (
        np.empty(width, np.float32),
        np.empty(width, np.float32),
        np.empty(width, np.float32),
    )
    sums = (share, total, total_variance, red, green, blue)
    for y in range(height):
        for x in range(width):
            own = np.float32(0.25) * weight[y, x]
            share[x] = np.float32(0.25)
            total[x] = own
            total_variance[x] = own * own * variance[y, x]
            red[x] = own * light[0, y, x]
            green[x] = own * light[1, y, x]
            blue[x] = own * light[2, y, x]
        for dy in range(-1, 2):
            v = y + dy * step
            if v < 0 or v >= height:
                continue
            for dx in range(-1, 2):
                if dx == 0 and dy == 0:
                    continue
                kernel = np.float32(0.125) if dx == 0 or dy == 0 else np.float32(0.0625)
                _add_neighbours(planes, sigma, kernel, y, v, dx * step, sums)
        for x in range(width):
            norm = np.float32(1.0) / total[x]
            light_out[0, y, x] = red[x] * norm
            light_out[1, y, x] = green[x] * norm
            light_out[2, y, x] = blue[x] * norm
            weight_out[y, x] = total[x] / share[x]
            variance_out[y, x] = total_variance[x] * norm * norm
