"""Numba kernel of `png`: the filters of PNG's rows undone (Portable Network Graphics, 2nd edition, 9.2)."""

from __future__ import annotations

import numpy as np

from topoloc.compiled import kernel

SUB, UP, AVERAGE, PAETH = 1, 2, 3, 4


@kernel(inline="always")
def _predicted(kind, left, above, corner):
    """What the filter takes off a byte: by the bytes to its left, above it, and above that to its left."""
    if kind == SUB:
        return left
    if kind == AVERAGE:
        return (left + above) >> 1
    by_left, by_above, by_corner = abs(above - corner), abs(left - corner), abs(left + above - 2 * corner)
    if by_left <= by_above and by_left <= by_corner:
        return left
    return above if by_above <= by_corner else corner


@kernel()
def _undo(kind, source, above, step, out):
    """A row of Sub, Average or Paeth; each of the `step` bytes of a pixel by that of the pixel before. Three are done at once: three chains
    of sums that do not wait for each other."""
    if step == 3:
        a, b, c = np.int32(0), np.int32(0), np.int32(0)
        up_a, up_b, up_c = np.int32(0), np.int32(0), np.int32(0)
        for x in range(0, out.shape[0] - 2, 3):
            over_a, over_b, over_c = np.int32(above[x]), np.int32(above[x + 1]), np.int32(above[x + 2])
            a = np.int32((source[x] + _predicted(kind, a, over_a, up_a)) & 255)
            b = np.int32((source[x + 1] + _predicted(kind, b, over_b, up_b)) & 255)
            c = np.int32((source[x + 2] + _predicted(kind, c, over_c, up_c)) & 255)
            out[x], out[x + 1], out[x + 2] = a, b, c
            up_a, up_b, up_c = over_a, over_b, over_c
        return
    for channel in range(step):
        left, corner = np.int32(0), np.int32(0)
        for x in range(channel, out.shape[0], step):
            over = np.int32(above[x])
            left = np.int32((source[x] + _predicted(kind, left, over, corner)) & 255)
            out[x] = left
            corner = over


@kernel()
def unfilter(filtered, step, out):
    """Fill the rows of `out` (h, n), uint8, from `filtered` (h, 1 + n), whose rows begin with the kind of their filter; a pixel has `step`
    bytes. Returns whether all kinds are known."""
    nothing = np.zeros(out.shape[1], np.uint8)
    for y in range(out.shape[0]):
        kind, source, target = filtered[y, 0], filtered[y, 1:], out[y]
        above = out[y - 1] if y > 0 else nothing
        if kind == 0:
            target[:] = source
        elif kind == SUB:
            _undo(SUB, source, above, step, target)
        elif kind == UP:
            for x in range(target.shape[0]):
                target[x] = np.uint8(source[x] + above[x])
        elif kind == AVERAGE:
            _undo(AVERAGE, source, above, step, target)
        elif kind == PAETH:
            _undo(PAETH, source, above, step, target)
        else:
            return False
    return True
