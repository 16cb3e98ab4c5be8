"""Decide from the pixels whether a driver labels the wrong order of their bytes.

Numbers of 16 bits and of floats are smooth in their true order alone. Of YUV 4:2:2, brightness
changes from pixel to pixel more than colour does. Reversing the bytes of each pixel mends both.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Num, UInt8

from topoloc import RecordingError, UnreadableImageError
from topoloc.apps.formats.bags.bag import Bag, MessageRef, Topic
from topoloc.apps.formats.bags.bag_images import decode_pixels
from topoloc.apps.formats.bags.messages import RAW_IMAGE_TYPES, decode, num_header_bytes

# Parts of the encodings whose pixels have an order of bytes.
_ORDERED_ENCODINGS = (b"16", b"32FC1", b"yuv", b"uyvy", b"yuyv")
_NUM_SAMPLES, _NUM_ROWS, _MIN_PAIRS = 5, 200, 100


def has_reversed_bytes(bag: Bag, topic: Topic, refs: list[MessageRef]) -> bool:
    """Return whether the pixels of a topic have another order of bytes than their label. A note is
    added. Pixels that do not decide keep the label."""
    if topic.type not in RAW_IMAGE_TYPES or not _is_ordered(bag, topic, refs[0]):
        return False
    samples = list(_read_samples(bag, topic, refs))
    if not samples or np.median([evidence for evidence, _ in samples]) <= 1.0:
        return False
    bag.notes.append(
        f"{bag.path}: the bytes of {topic.name} are in another order than {samples[0][1]} says: its"
        " pixels are smooth in that one alone, and are read in it"
    )
    return True


def _is_ordered(bag: Bag, topic: Topic, ref: MessageRef) -> bool:
    """Return whether an image may be of such an encoding. Its pixels are not read."""
    with suppress(RecordingError):
        begin = bag.read(ref, num_header_bytes(topic) and 512)
        return any(encoding in begin for encoding in _ORDERED_ENCODINGS)
    return False


def _read_samples(bag: Bag, topic: Topic, refs: list[MessageRef]) -> Iterator[tuple[float, str]]:
    """Yield the evidence of images that decide, and their label."""
    for ref in refs[:: -(-len(refs) // _NUM_SAMPLES)]:
        with suppress(RecordingError, UnreadableImageError):
            message = decode(topic, bag.read(ref))
            if hasattr(message, "encoding"):
                evidence, encoding = compare_orders(message), str(message.encoding)
                is_yuv = not encoding.endswith(("16", "C1"))
                flag = f"is_bigendian {int(getattr(message, 'is_bigendian', 0))} of {encoding}"
                if not np.isnan(evidence):
                    yield evidence, encoding if is_yuv else flag


def compare_orders(message: Any) -> float:
    """Return the evidence for the other order of bytes: sure above 1, NaN if the image does not
    decide."""
    pixels, to_rgb = decode_pixels(message, "")
    step = max(1, len(pixels) // _NUM_ROWS)
    pixels = pixels[::step]
    if pixels.ndim == 3:
        return _compare_planes(pixels, to_rgb) if pixels.shape[2] == 2 else np.nan
    if pixels.itemsize == 1:
        return np.nan
    other = decode_pixels(message, "", is_reversed=True)[0][::step]
    with np.errstate(invalid="ignore"):
        known = np.isfinite(pixels) & np.isfinite(other) & (pixels > 0) & (other > 0)
    # positive floats are in the order of their bits
    its, others = (values.view(f"u{values.itemsize}") for values in (pixels, other))
    ratio = _divide(_roughness(its, known), _roughness(others, known))
    if pixels.itemsize > 2:
        return ratio / 2.0
    # scaled 8 bits leave a low byte that hardly changes
    high, low = (_mean_step(its >> shift & 255, 1, known) for shift in (8, 0))
    return min(ratio / 1.5, _divide(high, low) / 2.0)


def _compare_planes(pixels: UInt8[np.ndarray, "h w 2"], to_rgb: int | None) -> float:
    """Return the evidence that brightness and colour are exchanged: the one changes less, or
    alternates as U and V do, and the other one changes from pixel to pixel as brightness does."""
    luma_channel = int(to_rgb == cv2.COLOR_YUV2RGB_UYVY)
    luma, chroma = (pixels[..., channel] for channel in (luma_channel, 1 - luma_channel))
    change = _mean_step(chroma, 2)
    if not change:
        return np.nan
    of_luma = _mean_step(luma, 2)
    exchange = max(_divide(change, of_luma) / 2.0, _divide(_mean_step(luma, 1), of_luma) / 1.2)
    return min(exchange, _divide(change, _mean_step(chroma, 1)) * 0.9)


def _roughness(values: Num[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> float:
    """Return the mean difference of neighbours as a share of the spread of all pixels."""
    return _divide(_mean_step(values, 1, known), float(values[known].std()) if known.any() else 0.0)


def _mean_step(
    values: Num[np.ndarray, "h w"], stride: int, known: Bool[np.ndarray, "h w"] | None = None
) -> float:
    """Return the mean difference of pixels `stride` apart in a row, NaN of few pixels."""
    steps = np.abs(values[:, stride:].astype(np.float64) - values[:, :-stride])
    steps = steps.ravel() if known is None else steps[known[:, stride:] & known[:, :-stride]]
    return float(steps.mean()) if len(steps) >= _MIN_PAIRS else np.nan


def _divide(number: float, by: float) -> float:
    """Return the quotient, a large one if only `by` is 0."""
    return number / max(by, 1e-9) if number or by else np.nan
