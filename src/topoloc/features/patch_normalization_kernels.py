"""Implement the Numba kernel of `patch_normalization`: one band of rows by sliding sums."""

import numpy as np

from topoloc.compiled import kernel


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
