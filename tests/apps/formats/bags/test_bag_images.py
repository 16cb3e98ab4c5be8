"""Test the decoding of images and depth in messages, by encoding."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bag_writing import image

from topoloc.apps.formats.bags.bag_images import decode_depth, decode_image
from topoloc.errors import UnreadableImageError

RED_TO_BLUE = np.array([[[200, 10, 20], [10, 190, 30]], [[20, 30, 180], [90, 100, 110]]], np.uint8)


def message(pixels: np.ndarray, as_encoding: str, **fields: object) -> SimpleNamespace:
    return SimpleNamespace(**(image(pixels, 0, as_encoding) | fields))


@pytest.mark.parametrize(
    ("encoding", "channels"),
    [
        ("rgb8", [0, 1, 2]),
        ("bgr8", [2, 1, 0]),
        ("8UC3", [2, 1, 0]),
        ("rgba8", [0, 1, 2, 0]),
        ("bgra8", [2, 1, 0, 0]),
    ],
)
def test_colours_come_as_rgb(encoding: str, channels: list[int]):
    np.testing.assert_array_equal(
        decode_image(message(RED_TO_BLUE[..., channels], encoding), "a"), RED_TO_BLUE
    )


def test_grey_of_8_and_16_bits_of_either_order():
    grey = RED_TO_BLUE[..., 0]
    np.testing.assert_array_equal(decode_image(message(grey, "mono8"), "a"), grey)
    np.testing.assert_array_equal(
        decode_image(message(grey.astype(np.uint16) * 257, "mono16"), "a"), grey
    )
    np.testing.assert_array_equal(
        decode_image(
            message((grey.astype(">u2") * 257).astype(">u2"), "mono16", is_bigendian=1), "a"
        ),
        grey,
    )


@pytest.mark.parametrize(
    ("pattern", "first_row", "second_row"),
    [("rggb", "rg", "gb"), ("bggr", "bg", "gr"), ("gbrg", "gb", "rg"), ("grbg", "gr", "bg")],
)
def test_bayer_patterns(pattern: str, first_row: str, second_row: str):
    colour = {"r": 220, "g": 120, "b": 20}
    mosaic = np.tile(
        np.array([[colour[letter] for letter in row] for row in (first_row, second_row)], np.uint8),
        (8, 8),
    )
    np.testing.assert_array_equal(
        decode_image(message(mosaic, f"bayer_{pattern}8"), "a")[8, 8], [220, 120, 20]
    )


def test_yuv_of_a_grey_surface():
    pixels = np.tile(np.array([128, 140], np.uint8), (4, 4)).reshape(4, 4, 2)
    assert np.ptp(decode_image(message(pixels, "yuv422"), "a")) == 0
    np.testing.assert_array_equal(
        decode_image(message(pixels, "yuv422"), "a"),
        decode_image(message(pixels[..., ::-1], "yuv422_yuy2"), "a"),
    )


def test_depth_in_millimetres_and_metres():
    units = np.array([[0, 1500], [65535, 2]], np.uint16)
    np.testing.assert_array_equal(
        decode_depth(message(units, "16UC1"), "a"),
        np.array([[np.nan, 1.5], [np.nan, 0.002]], np.float32),
    )
    metres = np.array([[np.inf, 1.5], [-1.0, np.nan]], np.float32)
    np.testing.assert_array_equal(
        decode_depth(message(metres, "32FC1"), "a"),
        np.array([[np.nan, 1.5], [np.nan, np.nan]], np.float32),
    )


def test_compressed_depth_of_both_formats():
    units = np.array([[0, 1500], [3000, 2]], np.uint16)
    png = cv2.imencode(".png", units)[1].tobytes()
    packed = SimpleNamespace(
        format="16UC1; compressedDepth png", data=struct.pack("<iff", 0, 0.0, 0.0) + png
    )
    np.testing.assert_array_equal(
        decode_depth(packed, "a"), np.array([[np.nan, 1.5], [3.0, 0.002]], np.float32)
    )
    # Of floats the inverse is quantised: depth = A / (value - B).
    packed = SimpleNamespace(
        format="32FC1; compressedDepth", data=struct.pack("<iff", 0, 3000.0, 1000.0) + png
    )
    np.testing.assert_allclose(decode_depth(packed, "a"), [[np.nan, 6.0], [1.5, np.nan]])
    np.testing.assert_array_equal(
        decode_depth(SimpleNamespace(format="png", data=png), "a")[0, 1], np.float32(1.5)
    )


def encode_rvl(pixels: np.ndarray) -> bytes:
    """Encode depth as in the RVL paper: runs of zeros and non-zeros, zigzag differences, 3
    bits per nibble."""
    nibbles: list[int] = []

    def add(number: int) -> None:
        while number > 7:
            nibbles.append(number & 7 | 8)
            number >>= 3
        nibbles.append(number)

    flat, at, before = pixels.ravel().astype(int).tolist(), 0, 0
    while at < len(flat):
        zeros = next((k for k, one in enumerate(flat[at:]) if one), len(flat) - at)
        at += zeros
        others = next((k for k, one in enumerate(flat[at:]) if not one), len(flat) - at)
        add(zeros)
        add(others)
        for one in flat[at : at + others]:
            add(2 * (one - before) if one >= before else 2 * (before - one) - 1)
            before = one
        at += others
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        sum(nibble << 28 - 4 * place for place, nibble in enumerate(nibbles[at : at + 8]))
        for at in range(0, len(nibbles), 8)
    ]
    return struct.pack(f"<II{len(words)}I", pixels.shape[1], pixels.shape[0], *words)


def test_depth_compressed_by_rvl():
    units = np.random.default_rng(1).integers(0, 65535, (7, 9)).astype(np.uint16)
    units[units % 3 == 0] = 0
    units[0, 0], units[3, 4], units[6, 8] = 0, 65535, 0
    header = struct.pack("<iff", 0, 3000.0, 1000.0)
    packed = SimpleNamespace(format="16UC1; compressedDepth rvl", data=header + encode_rvl(units))
    expected = np.where((units == 0) | (units == 65535), np.nan, units / np.float32(1000))
    np.testing.assert_allclose(decode_depth(packed, "a"), expected, rtol=1e-6)
    packed.format = "32FC1; compressedDepth rvl"
    found = decode_depth(packed, "a")
    is_known = (units > 1000) & (units < 65535)
    np.testing.assert_allclose(found[is_known], 3000.0 / (units[is_known] - 1000.0), rtol=1e-6)
    assert np.isnan(found[~is_known]).all()
    for data in (packed.data[:-12], packed.data[:14], header + b"\xff" * 50):
        with pytest.raises(UnreadableImageError, match=r"a: depth .*RVL"):
            decode_depth(SimpleNamespace(format=packed.format, data=data), "a")


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"encoding": "weird8"}, "pixels of encoding 'weird8'"),
        ({"height": 3}, "are no 2x3 pixels"),
        ({"width": 10**6, "height": 10**6}, "are no 1000000x1000000 pixels"),
        ({"step": 3}, "are no 2x2 pixels"),
        ({"width": 0}, "are no 0x2 pixels"),
        ({"encoding": "32FC1", "width": 1, "step": 4, "height": 2}, "are depth, not a picture"),
    ],
)
def test_invalid_images_are_refused(fields: dict[str, object], said: str):
    with pytest.raises(UnreadableImageError, match=said):
        decode_image(message(RED_TO_BLUE, "rgb8", **fields), "walk, /left at 3")


def test_an_invalid_compressed_image_is_refused():
    with pytest.raises(UnreadableImageError, match="walk, /left at 3: not a picture"):
        decode_image(SimpleNamespace(format="jpeg", data=b"nothing"), "walk, /left at 3")
    with pytest.raises(UnreadableImageError, match="depth must be 16UC1"):
        decode_depth(message(RED_TO_BLUE, "rgb8"), "a")
