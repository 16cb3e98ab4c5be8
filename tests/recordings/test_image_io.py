import os
import struct
import subprocess
import sys
import unicodedata
import zlib
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from peak_memory import PEAK_KB
from tiny_recordings import picture, write
from topoloc.errors import UnreadableImageError
from topoloc.recordings.frame import to_grey
from topoloc.recordings.image_io import image_size, read_depth, read_depth_image, read_image
from topoloc.recordings.open import open_sequence

pytestmark = pytest.mark.usefixtures("quiet")


def smooth(channels: int) -> np.ndarray:
    return cv2.GaussianBlur(picture(0, channels, 320, 240), (0, 0), 5)


def png(width: int, height: int, colour_type: int, raw: bytes) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, colour_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(raw))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("suffix", ["png", "bmp", "tiff", "pgm"])
def test_grey_comes_back_as_written(tmp_path: Path, suffix: str):
    path = write(tmp_path / f"a.{suffix}", picture(1))
    np.testing.assert_array_equal(read_image(path), picture(1))
    assert image_size(path) == (32, 24)


@pytest.mark.parametrize("suffix", ["png", "bmp", "tiff", "ppm"])
def test_colour_is_rgb(tmp_path: Path, suffix: str):
    path = write(tmp_path / f"a.{suffix}", picture(1, 3))
    np.testing.assert_array_equal(read_image(path), picture(1, 3)[:, :, ::-1])


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_lossy_colour_is_rgb(tmp_path: Path, suffix: str):
    bgr = np.full((24, 32, 3), (200, 60, 20), np.uint8)
    path = write(tmp_path / f"a.{suffix}", bgr)
    np.testing.assert_allclose(read_image(path).astype(int), bgr[:, :, ::-1], atol=4)
    assert image_size(path) == (32, 24)


def test_alpha_is_dropped(tmp_path: Path):
    path = write(tmp_path / "a.png", picture(1, 4))
    np.testing.assert_array_equal(read_image(path), picture(1, 4)[:, :, 2::-1])


def test_sixteen_bits_become_eight(tmp_path: Path):
    levels = np.arange(0, 65536, 257, dtype=np.uint16).reshape(16, 16)
    np.testing.assert_array_equal(
        read_image(write(tmp_path / "a.png", levels)), np.arange(256).reshape(16, 16)
    )


def test_grey_of_colour_and_of_grey():
    rgb = np.zeros((2, 2, 3), np.uint8)
    rgb[..., 0] = 200
    assert np.all(to_grey(rgb) == round(0.299 * 200))
    grey = picture(1)
    assert to_grey(grey) is grey


def test_exif_orientation_is_obeyed(tmp_path: Path):
    jpeg = cv2.imencode(".jpg", smooth(3))[1].tobytes()
    tiff = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)
    exif = b"\xff\xe1" + struct.pack(">H", 2 + 6 + len(tiff)) + b"Exif\0\0" + tiff
    path = tmp_path / "turned.jpg"
    path.write_bytes(jpeg[:2] + exif + jpeg[2:])
    assert image_size(path) == (240, 320)
    upright = cv2.cvtColor(
        cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB
    )
    np.testing.assert_allclose(
        read_image(path).astype(int), np.rot90(upright, -1).astype(int), atol=2
    )


@pytest.mark.parametrize(
    ("pixels", "says"),
    [
        (
            np.array([[[0.1, 0.5, 1.0]]], np.float32),
            "pixels of 32-bit floats; a picture needs integers",
        ),
        (np.array([[0.1, 0.5]], np.float64), "pixels of 64-bit floats"),
        (np.array([[0.1, 0.5]], np.float32), "pixels of 32-bit floats"),
        (np.array([[[1, 2, 3]]], np.int32), "pixels of 32-bit signed integers"),
    ],
)
def test_pixels_of_a_whole_tiff_that_are_not_read_are_named(
    pixels: np.ndarray, says: str, tmp_path: Path
):
    path = write(tmp_path / "a.tiff", pixels)
    with pytest.raises(UnreadableImageError, match=says):
        read_image(path)


def test_a_tiff_that_ends_early_is_damaged(tmp_path: Path):
    path = write(tmp_path / "a.tiff", smooth(3))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(UnreadableImageError, match="damaged"):
        read_image(path)


@pytest.mark.parametrize(("stored", "listed"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_names_in_another_form_of_unicode_are_found(
    stored: Literal["NFC", "NFD"], listed: Literal["NFC", "NFD"], tmp_path: Path
):
    """Also of folders in between, and of depth. A missing file keeps its name."""
    names = [unicodedata.normalize(form, "Küche/é_1") for form in (stored, listed)]
    (path, other) = (tmp_path / f"{name}.png" for name in names)
    write(path, picture(1))
    np.save(path.with_suffix(".npy"), np.full((2, 2), 1500.0))
    np.testing.assert_array_equal(read_image(other), read_image(path))
    np.testing.assert_array_equal(read_depth_image(other.with_suffix(".npy"), 1000.0), 1.5)
    assert open_sequence(f"{other}@0").names == [path.name]
    with pytest.raises(UnreadableImageError, match=r"é_2\.png: no such picture"):
        read_image(tmp_path / "é_2.png")


def test_heic_is_read_with_its_decoder(tmp_path: Path):
    pytest.importorskip("pi_heif", reason="the extra heic is not installed")
    y, x = np.mgrid[:48, :64]
    path = Path(__file__).parent / "pictures" / "ramp.heic"
    np.testing.assert_allclose(
        read_image(path), np.stack([4 * x, 5 * y, np.full_like(x, 90)], axis=2), atol=12
    )
    assert image_size(path) == (64, 48)
    (tmp_path / "cut.heic").write_bytes(path.read_bytes()[:300])
    with pytest.raises(UnreadableImageError, match=r"cut\.heic"):
        read_image(tmp_path / "cut.heic")


def test_heic_without_its_decoder_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypmif1" + b"x" * 100)
    (tmp_path / "a.heic").rename(tmp_path / "a.jpg")
    with pytest.raises(UnreadableImageError, match=r"a\.jpg.*topoloc\[heic\]"):
        read_image(tmp_path / "a.jpg")


def test_depth_in_floats(tmp_path: Path):
    metres = np.array([[0.5, 0.0, np.nan], [65535.0, np.inf, 2.25]], np.float32)
    Pillow.fromarray(metres).save(tmp_path / "depth.tiff")
    expected = [[0.5, np.nan, np.nan], [65535.0, np.nan, 2.25]]
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.tiff", 1.0), expected)


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tiff", "webp", "ppm"])
@pytest.mark.parametrize("kept", [0.05, 0.5, 0.98])
def test_truncated_is_refused(tmp_path: Path, suffix: str, kept: float):
    whole = cv2.imencode(f".{suffix}", smooth(3))[1].tobytes()
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(UnreadableImageError, match=f"cut.{suffix}") as error:
        read_image(path)
    assert "\n" not in str(error.value)


def test_truncated_jpeg_with_a_thumbnail_is_refused(tmp_path: Path):
    jpeg = cv2.imencode(".jpg", smooth(3))[1].tobytes()
    thumbnail = cv2.imencode(".jpg", picture(0, 3))[1].tobytes()
    with_thumbnail = (
        jpeg[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(thumbnail)) + thumbnail + jpeg[2:]
    )
    path = tmp_path / "cut.jpg"
    path.write_bytes(with_thumbnail)
    assert read_image(path).shape == (240, 320, 3)
    path.write_bytes(with_thumbnail[:-100])
    with pytest.raises(UnreadableImageError, match="truncated"):
        read_image(path)


def test_bytes_after_the_end_of_a_jpeg_do_no_harm(tmp_path: Path):
    path = tmp_path / "a.jpg"
    path.write_bytes(cv2.imencode(".jpg", smooth(3))[1].tobytes() + bytes(1000))
    assert read_image(path).shape == (240, 320, 3)


def test_one_wrong_byte_in_a_png_is_found(tmp_path: Path):
    data = bytearray(cv2.imencode(".png", smooth(1))[1].tobytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(UnreadableImageError, match="checksum"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize(
    "data",
    [
        b"hello world" * 50,
        b"\x89PNG\r\n\x1a\n" + b"x" * 99,
        b"\xff\xd8\xff",
        b"BM" + b"x" * 99,
        b"II*\0" + b"q" * 99,
    ],
)
def test_invalid_images_are_refused(tmp_path: Path, data: bytes):
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(UnreadableImageError, match=r"a\.png"):
        read_image(tmp_path / "a.png")


def test_missing_empty_and_folder(tmp_path: Path):
    with pytest.raises(UnreadableImageError, match=r"gone\.png.*no such"):
        read_image(tmp_path / "gone.png")
    (tmp_path / "a.png").touch()
    with pytest.raises(UnreadableImageError, match=r"a\.png.*empty"):
        read_image(tmp_path / "a.png")
    with pytest.raises(UnreadableImageError, match="directory"):
        read_image(tmp_path)


def test_too_large_is_refused_before_it_is_decoded(tmp_path: Path):
    (tmp_path / "bomb.png").write_bytes(png(20_000, 20_000, 0, b""))
    with pytest.raises(UnreadableImageError, match=r"bomb\.png.*100 megapixels"):
        read_image(tmp_path / "bomb.png")
    with pytest.raises(UnreadableImageError, match="megapixels"):
        image_size(tmp_path / "bomb.png")


def test_depth_in_metres_unknown_is_nan(tmp_path: Path):
    path = write(tmp_path / "d.png", np.array([[0, 65535, 5000], [2500, 1, 65534]], np.uint16))
    depth = read_depth(path, 5000.0)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[np.nan, np.nan, 1.0], [0.5, 0.0002, 13.1068]], rtol=1e-6)


@pytest.mark.parametrize("suffix", [".tiff", ".npy"])
@pytest.mark.parametrize("dtype", [np.int32, np.uint32])
def test_depth_of_32_bits_does_not_wrap(tmp_path: Path, suffix: str, dtype: type):
    units = np.array([[0, 65535, 70000], [20000, 2**32 - 1, 131072]], np.int64).astype(dtype)
    path = tmp_path / f"depth{suffix}"
    if suffix == ".npy":
        np.save(path, units)
    else:
        Pillow.fromarray(units.view(np.int32)).save(path)
    depth = read_depth_image(path, 10_000.0)
    np.testing.assert_allclose(depth, [[np.nan, 6.5535, 7.0], [2.0, np.nan, 13.1072]], rtol=1e-6)


def test_the_unknown_depth_of_16_bits_in_an_array_of_more(tmp_path: Path):
    for dtype in (np.uint16, np.int32):
        np.save(tmp_path / "depth.npy", np.array([[1500, 65535]], dtype))
        depth = read_depth_image(tmp_path / "depth.npy", 1000.0)
        np.testing.assert_allclose(depth, [[1.5, np.nan]])


def test_depth_of_eight_bits_is_refused(tmp_path: Path):
    with pytest.raises(UnreadableImageError, match="16 bits"):
        read_depth(write(tmp_path / "d.png", picture(0)), 1000.0)


def test_a_pipe_and_odd_names_are_refused(tmp_path: Path):
    os.mkfifo(tmp_path / "a.png")
    with pytest.raises(UnreadableImageError, match="not a file"):
        read_image(tmp_path / "a.png")
    with pytest.raises(UnreadableImageError, match="not the name"):
        read_image(tmp_path / "a\0b.png")


@pytest.mark.parametrize(
    "header",
    [b"P5" + b" " * 41, b"P5\n" + b"9" * 5000 + b" 1 255\n", b"P5 0 0 255\n", b"P6 9 9 70000\n"],
)
def test_odd_pnm_headers_are_refused_at_once(tmp_path: Path, header: bytes):
    (tmp_path / "a.pgm").write_bytes(header)
    with pytest.raises(UnreadableImageError, match=r"a\.pgm"):
        read_image(tmp_path / "a.pgm")


@pytest.mark.parametrize("suffix", ["tiff", "webp", "png"])
def test_size_is_known_before_decoding(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / f"large.{suffix}"
    path.write_bytes(cv2.imencode(f".{suffix}", smooth(3))[1].tobytes())
    monkeypatch.setattr("topoloc.recordings.image_io.MAX_PIXELS", 1000)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda self: pytest.fail("decoded"))
    with pytest.raises(UnreadableImageError, match="320x240"):
        read_image(path)


def test_sixteen_bits_of_colour_become_eight(tmp_path: Path):
    levels = np.linspace(0, 65535, 24 * 32 * 3).astype(np.uint16).reshape(24, 32, 3)
    np.testing.assert_allclose(
        read_image(write(tmp_path / "a.png", levels)), levels[:, :, ::-1] / 257.0, atol=1.0
    )


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
def test_large_images_are_reduced(tmp_path: Path, suffix: str):
    path = write(tmp_path / f"large.{suffix}", cv2.resize(smooth(3), (323, 241)))
    whole = read_image(path)
    for max_pixels, size in ((323 * 241, (323, 241)), (77_000, (161, 120)), (5_000, (81, 60))):
        reduced = read_image(path, max_pixels=max_pixels)
        assert np.abs(np.subtract(reduced.shape[1::-1], size)).max() <= 1
        expected = cv2.resize(whole, reduced.shape[1::-1], interpolation=cv2.INTER_AREA)
        assert np.abs(reduced.astype(int) - expected).max() < 8
    assert image_size(path) == (323, 241)


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_a_webp_image_of_50_megapixels_takes_little_memory(tmp_path: Path):
    """Pillow needs 770 MB for it."""
    Pillow.new("RGB", (7070, 7070)).save(tmp_path / "black.webp")
    code = PEAK_KB + (
        "from pathlib import Path; from topoloc import read_image;"
        f" path = Path({str(tmp_path)!r}) / 'black.webp'; before = peak_kb();"
        " assert read_image(path, max_pixels=12_500_000).shape == (3535, 3535, 3);"
        " print(peak_kb() - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 250_000  # kB


def test_a_side_has_a_limit(tmp_path: Path):
    Pillow.new("L", (30_001, 1)).save(tmp_path / "long.png")
    with pytest.raises(UnreadableImageError, match="30001x1 is more than"):
        read_image(tmp_path / "long.png")
