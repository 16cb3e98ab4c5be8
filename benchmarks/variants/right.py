"""Right variants of recordings, which nothing may accuse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from variants.walks import Walk
from variants.wrong import DEPTH, STEREO, Change, Variant, changed_times, scale_times


def take(rows: slice) -> Change:
    return lambda walk: walk.select(rows)


def as_single(walk: Walk) -> Walk:
    """The left images alone, with poses."""
    return replace(walk, others=[], baseline=None, depth_factor=None)


def stand_still(walk: Walk) -> Walk:
    """The camera stands still for a second before it moves."""
    num, step = 10, float(np.median(np.diff(walk.times)))
    still = walk.select([0] * num + list(range(len(walk.lefts))))
    times = [walk.times[0] + step * k for k in range(num)]
    times += [t + num * step for t in walk.times]
    return replace(still, times=times, pose_times=times)


def to_12_bits(walk: Walk) -> Walk:
    """Images of 12 bits in 16."""
    edit = lambda image: 16 * image.astype(np.uint16)  # noqa: E731
    grey = lambda image: edit(image if image.ndim == 2 else image[:, :, 1])  # noqa: E731
    return replace(walk, edit_left=grey, edit_other=grey if walk.baseline else None)


def forget_poses(walk: Walk) -> Walk:
    return replace(walk, poses=None)


def right_variants() -> Iterator[Variant]:
    """Yield all right variants."""
    for base in (*STEREO, *DEPTH):
        yield Variant("whole", base, lambda w: w)
        yield Variant("every second frame", base, take(slice(None, None, 2)))
        yield Variant("first half", base, take(slice(0, 25)))
        yield Variant("second half", base, take(slice(25, None)))
        yield Variant("single images", base, as_single)
        yield Variant("still at the start", base, stand_still)
        yield Variant("slam", base, forget_poses)
        yield Variant("every third frame, backwards in time", base, _backwards)
    for base in ("zed1", "kitchen"):
        for name, factor in {"ms": 1e3, "us": 1e6, "ns": 1e9}.items():
            yield Variant(f"pose times in {name}", base, scale_times(1.0, factor))
    yield from changed_times("zed1")
    for base in ("zed1", "lab"):
        yield Variant("12 bits in 16", base, to_12_bits)
    yield Variant("not rectified, with its calibration, slam", "euroc", forget_poses)
    halves = take(slice(None, None, 2)), take(slice(1, None, 2))
    for base in ("zed1", "kitchen", "lab", "street1"):
        yield Variant("two recordings of one world", base, halves[0], (base, halves[1]))


def _backwards(walk: Walk) -> Walk:
    turned = walk.select(list(range(len(walk.lefts)))[::-3])
    first = walk.times[0] + walk.times[-1]
    times = [first - t for t in turned.times]
    return replace(turned, times=times, pose_times=times)
