"""Record3D's export of an iPhone's or iPad's recording as EXR and JPG: ``rgb/0.jpg``,
``depth/0.exr``, ``metadata.json``.

`poses` has rows qx qy qz qw tx ty tz, world_from_cam with ARKit's axes (y up, z back), metres. `K`
is a 3x3 matrix by columns, `perFrameIntrinsicCoeffs` has rows fx fy cx cy, both for images of `w` x
`h`. For images of another size, such as those with LiDAR, the calibration is scaled. Depth is in
metres with the view of the image, at a lower resolution.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from topoloc import (
    CalibrationError,
    Camera,
    PoseConventions,
    RecordingError,
    Rigid3,
    TrajectoryError,
)
from topoloc.plugin import (
    DepthImages,
    Finite,
    Recording,
    RecordingFormat,
    decode_json,
    image_size,
    list_images,
    read_text,
    times_from_rate,
)

FILE_NAME = "metadata.json"
EXPECTED_FILES = "rgb/ and metadata.json of Record3D's EXR + JPG export"
_FOLDER = "EXR_RGBD"
_RATE_HZ = 60


def can_open(path: Path) -> bool:
    """Return whether this is such a folder, or has one."""
    return _find_root(path) is not None


def open_record3d(path: Path) -> Recording:
    """Open an export. Without depth, it has single images with poses. Raises RecordingError:
    metadata.json is malformed, or the numbers of poses, times, images and depth images differ;
    CalibrationError: the intrinsics are missing or invalid; TrajectoryError: a row of the poses is
    no pose."""
    root = _find_root(path)
    if root is None:
        raise RecordingError(f"{path}: not an export of Record3D, which has {EXPECTED_FILES}")
    file = root / FILE_NAME
    data = decode_json(read_text(file, RecordingError), _Metadata, RecordingError, str(file))
    images, count = list_images(root / "rgb"), len(data.poses)
    if len(images) < count and all(_is_number(image.stem, count) for image in images):
        images = [images[0].with_stem(str(number)) for number in range(count)]
    if len(data.poses) != len(images):
        raise RecordingError(f"{file}: {len(data.poses)} poses for {len(images)} images")
    poses: list[Rigid3 | None] = [
        _pose(row, f"{file}, pose {k}") for k, row in enumerate(data.poses)
    ]
    names = [one.relative_to(root).as_posix() for one in images]
    t_ns = _times(data, len(images), file)
    frames = (names, t_ns, poses, _cameras(data, images, file))
    return Recording.with_cameras(path.resolve().name, root, *frames, depth=_depth(root, images))


def _is_number(stem: str, count: int) -> bool:
    return stem.isascii() and stem.isdigit() and int(stem) < count and str(int(stem)) == stem


def _find_root(path: Path) -> Path | None:
    candidates = (path, path / _FOLDER, path / "EXR")
    found = (one for one in candidates if (one / "rgb").is_dir() and (one / FILE_NAME).is_file())
    return next(found, None)


_Four = tuple[Finite, Finite, Finite, Finite]


class _Metadata(Struct, frozen=True):
    w: Finite
    h: Finite
    poses: list[tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]]
    perFrameIntrinsicCoeffs: list[_Four] | None = None
    K: Annotated[list[Finite], Meta(min_length=9, max_length=9)] | None = None
    frameTimestamps: list[Annotated[float, Meta(ge=-9e9, le=9e9)]] | None = None
    fps: Finite = _RATE_HZ


def _pose(row: tuple[float, ...], where: str) -> Rigid3:
    numbers = np.array(row)
    length = float(np.linalg.norm(numbers[:4]))
    if not 0.99 < length < 1.01:
        raise TrajectoryError(f"{where}: qx qy qz qw is no rotation")
    x, y, z, w = numbers[:4] / length
    world_from_gl = Rigid3.from_quat_wxyz(np.array([w, x, y, z]), numbers[4:])
    return PoseConventions(("opengl",)).undo_conventions(world_from_gl)


def _cameras(data: _Metadata, images: list[Path], file: Path) -> list[Camera]:
    """Return the camera of each image, at the size of the images."""
    w, h = int(data.w), int(data.h)
    whole = (one for one in images if one.is_file() and one.stat().st_size)
    width, height = image_size(next(whole, images[0]))
    if abs(width * h - height * w) > max(w, h, width, height):
        raise CalibrationError(f"{file}: of {w}x{h}, but {images[0].name} is {width}x{height}")
    numbers = data.perFrameIntrinsicCoeffs
    if not numbers:
        if data.K is None:
            raise CalibrationError(f"{file}: neither K nor perFrameIntrinsicCoeffs")
        numbers = [(data.K[0], data.K[4], data.K[6], data.K[7])] * len(images)
    if len(numbers) != len(images):
        raise CalibrationError(
            f"{file}: {len(numbers)} perFrameIntrinsicCoeffs for {len(images)} images"
        )
    with CalibrationError.at(file):
        return [Camera.pinhole(w, h, *row).rescaled(width, height) for row in numbers]


def _times(data: _Metadata, count: int, file: Path) -> list[int]:
    """Return nanoseconds, from the frame rate if the export has no times."""
    seconds = data.frameTimestamps
    if not seconds:
        return times_from_rate(count, round(data.fps) if data.fps >= 1.0 else _RATE_HZ)
    if len(seconds) != count:
        raise RecordingError(f"{file}: {len(seconds)} frameTimestamps for {count} images")
    if np.any(np.diff(seconds) <= 0.0):
        raise RecordingError(f"{file}: frameTimestamps do not increase from frame to frame")
    return [round(second * 1e9) for second in seconds]


def _depth(root: Path, images: list[Path]) -> DepthImages | None:
    folder = root / "depth"
    if not folder.is_dir():
        return None
    paths = [folder / f"{image.stem}.exr" for image in images]
    num = sum(path.is_file() for path in paths)
    if num < len(images) / 2:
        raise RecordingError(f"{folder}: EXR files of only {num} of {len(images)} images in rgb/")
    return DepthImages(paths, 1.0, None, Rigid3.identity())


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_record3d)
