"""A COLMAP model, text or binary, as a recording of single images with poses.

pycolmap (the extra `colmap`) reads all versions of the files. Images are in the order of their
names. If the names are numbers, they are times in seconds (nanoseconds above 1e12), so that a
trajectory fits by time. Otherwise images are 1 s apart. A model from images only has no metric
scale (`Recording.has_scale`). It is given by a number, or by measured distances of two cameras.
"""

from __future__ import annotations

import importlib
import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from topoloc import (
    CalibrationError,
    Camera,
    MissingExtraError,
    RecordingError,
    Rigid3,
    StereoSequence,
    TrajectoryError,
)
from topoloc.plugin import Recording, RecordingFormat, natural_key, parse_relative_path

EXPECTED_FILES = "cameras and images (.bin or .txt) of COLMAP"
_FILES = ("cameras", "images", "points3D")
_MAX_SECONDS = 10**12
_DISTANCE = re.compile(r"(?P<one>[^,=]+),(?P<other>[^,=]+)=\s*(?P<metres>[0-9.eE+-]+)\s*m?")
_SCALE_TOLERANCE = 0.05  # of the scale; larger than errors of a measuring tape
_MIN_DISTANCE = 1e-9


def can_open(path: Path) -> bool:
    """Return whether this folder is a model, or has one in a subfolder of COLMAP."""
    return _find_model(path) is not None


def open_colmap(path: Path, images: Path | None = None) -> Recording:
    """Open a model. Raises RecordingError: there is no model, it is damaged or has no pose, or the
    images are missing; CalibrationError: a camera model is unknown; MissingExtraError: pycolmap is
    not installed.

    Args:
        images: folder of the images. Default: `images` beside the model or above it.
    """
    model = _find_model(path)
    if model is None:
        raise RecordingError(f"{path}: not a model of COLMAP, which has {EXPECTED_FILES}")
    root = images or next(
        (folder for folder in _image_folders(path, model) if folder.is_dir()), None
    )
    if root is None or not root.is_dir():
        raise RecordingError(f"{path}: the images of this model are missing; use --images FOLDER")
    read = _read_model(model)
    posed = sorted(
        (image for image in read.images.values() if image.has_pose),
        key=lambda image: natural_key(image.name),
    )
    if not posed:
        raise RecordingError(f"{model}: no image of this model has a pose")
    names = [parse_relative_path(image.name, str(model), RecordingError) for image in posed]
    used = {image.camera_id for image in posed}
    cameras = {number: _camera(read.cameras[number], model) for number in used}
    of_images = [cameras[image.camera_id] for image in posed]
    poses: list[Rigid3 | None] = [_world_from_cam(image, model) for image in posed]
    name, t_ns = path.resolve().name, times_from_names(names)
    frames = (names, t_ns, poses, of_images)
    recording = Recording.with_cameras(name, root, *frames, has_scale=False, as_stored=True)
    others = [one.name for one in _models(model.parent) if model not in (one, path)]
    note = f"{path}: model {model.name} is the largest; not used: {', '.join(others)}"
    return replace(recording, notes=(note,)) if others else recording


def _find_model(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    models = [*_models(path), *_models(path / "sparse")]
    return max(models, key=_size, default=None)


def _models(folder: Path) -> list[Path]:
    """Return the folder if it is a model, else the numbered models in it, of which the mapper of
    COLMAP writes one for each connected part of the images."""
    if _model_suffix(folder) is not None:
        return [folder]
    inside = folder.iterdir() if folder.is_dir() else ()
    return sorted(one for one in inside if one.name.isdigit() and _model_suffix(one) is not None)


def _size(model: Path) -> int:
    """Return the bytes of the images of a model."""
    return (model / f"images{_model_suffix(model)}").stat().st_size


def _model_suffix(folder: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in _FILES):
            return suffix
    return None


def _image_folders(path: Path, model: Path) -> list[Path]:
    absolute = model.resolve()
    return [folder / "images" for folder in (path, model, absolute.parent, absolute.parent.parent)]


def _read_model(model: Path) -> Any:
    need = f"{model}: models of COLMAP need the extra colmap"
    with MissingExtraError.on_import(need, "colmap"):
        pycolmap: Any = importlib.import_module("pycolmap")
    if _model_suffix(model) == ".bin":
        _check_counts(model)
    with _silence_log(pycolmap):
        try:
            read = pycolmap.Reconstruction(str(model))
            "".join(image.name for image in read.images.values())  # one that is no text raises here
            return read
        except Exception as error:  # of many classes, for damaged files
            reason = " ".join(str(error).split())[:120]
            raise RecordingError(f"{model}: damaged, or no model of COLMAP ({reason})") from None


@contextmanager
def _silence_log(pycolmap: Any) -> Iterator[None]:
    """Silence its log on stderr, which repeats the error."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _check_counts(model: Path) -> None:
    """Check that binary files are long enough for their counts. pycolmap would read on forever."""
    for name, length_of in _RECORD_LENGTHS.items():
        file = model / f"{name}.bin"
        if not file.is_file():
            continue
        data, at = file.read_bytes(), 8
        with suppress(struct.error, ValueError):
            (count,) = struct.unpack_from("<Q", data)
            for _ in range(min(count, len(data))):
                at = min(at + length_of(data, at), len(data) + 1)
            if count <= len(data) and at <= len(data):
                continue
        raise RecordingError(
            f"{file}: damaged, or no model of COLMAP (it is too short for its counts)"
        )


def _image_length(data: bytes, at: int) -> int:
    end = data.index(b"\0", at + 64)  # the name follows number, rotation, position and camera
    return end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0] - at


def _point_length(data: bytes, at: int) -> int:
    # number, position, colour and error, then the track
    return 51 + 8 * struct.unpack_from("<Q", data, at + 43)[0]


def _frame_length(data: bytes, at: int) -> int:
    # two numbers and a pose, then the data ids
    return 68 + 16 * struct.unpack_from("<I", data, at + 64)[0]


def _rig_length(data: bytes, at: int) -> int:
    (count,) = struct.unpack_from("<I", data, at + 4)
    if count > len(data):
        raise ValueError("more sensors than bytes")
    end = at + (16 if count else 8)
    for _ in range(max(count, 1) - 1):  # all sensors but the first may have a pose
        end += 65 if struct.unpack_from("<B", data, end + 8)[0] else 9
    return end - at


_RECORD_LENGTHS = {
    "images": _image_length,
    "points3D": _point_length,
    "frames": _frame_length,
    "rigs": _rig_length,
}


def _camera(camera: Any, model: Path) -> Camera:
    size, params = (int(camera.width), int(camera.height)), tuple(map(float, camera.params))
    with CalibrationError.at(model):
        return Camera.from_colmap(str(camera.model_name), *size, params)


def _world_from_cam(image: Any, model: Path) -> Rigid3:
    matrix = np.asarray(image.cam_from_world().matrix(), dtype=np.float64)
    with TrajectoryError.at(f"{model}, {image.name}"):
        return Rigid3.from_matrix(matrix).inverse()


def times_from_names(names: list[str]) -> list[int]:
    """Return nanoseconds: the names if they are increasing numbers, else positions as seconds."""
    stems = [PurePath(name).stem for name in names]
    if all(re.fullmatch(r"(?=.{1,24}$)([0-9]*\.?[0-9]+|[0-9]+\.)", stem) for stem in stems):
        whole = [stem.partition(".") for stem in stems]
        is_ns = max(int(seconds or 0) for seconds, _, _ in whole) > _MAX_SECONDS
        t_ns = [
            int(seconds or 0) if is_ns else int(seconds or 0) * 1_000_000_000 + int(f"{part:0<9.9}")
            for seconds, _, part in whole
        ]
        if all(after > before for before, after in pairwise(t_ns)):
            return t_ns
    return [number * 1_000_000_000 for number in range(len(names))]


def estimate_metric_scale(texts: Sequence[str], sequence: StereoSequence) -> float:
    """Return the metres in a unit of the recording's poses. Raises TrajectoryError: a text is
    malformed, an image is missing or has no pose, or the distances do not agree.

    Args:
        texts: one number, or distances between the cameras of two images:
            ``IMG_0001.jpg,IMG_0042.jpg=3.2m``.
    """
    if len(texts) == 1 and "=" not in texts[0]:
        return _positive_number(
            texts[0], f"a scale is a positive number, or IMAGE_A,IMAGE_B=3.2m, not {texts[0][:80]}"
        )
    units, metres = np.array([_units_and_metres(text, sequence) for text in texts]).T
    scales, scale = metres / units, float(units @ metres / (units @ units))
    worst = int(np.abs(np.log(scales / scale)).argmax())
    if scales.max() > (1.0 + _SCALE_TOLERANCE) * scales.min():
        details = ", ".join(
            f"{text} makes a unit {one:.4g} m" for text, one in zip(texts, scales, strict=True)
        )
        raise TrajectoryError(
            f"{sequence.name}: the distances do not agree: {details}; the worst is {texts[worst]}"
        )
    return scale


def _units_and_metres(text: str, sequence: StereoSequence) -> tuple[float, float]:
    match = _DISTANCE.fullmatch(text.strip())
    if match is None:
        raise TrajectoryError(
            f"{text[:80]!r} is no distance between two images, such as IMAGE_A,IMAGE_B=3.2m"
        )
    metres = _positive_number(match["metres"], f"{text[:80]!r}: the distance must be above 0 m")
    one, other = (_find_pose(match[name].strip(), sequence) for name in ("one", "other"))
    units = float(np.linalg.norm(one.translation - other.translation))
    if units < _MIN_DISTANCE:
        raise TrajectoryError(f"{text[:80]!r}: both images have the same position")
    return units, metres


def _find_pose(name: str, sequence: StereoSequence) -> Rigid3:
    """Find an image by its name, else by its file name with or without suffix."""
    names = sequence.names
    rows = [row for row, other in enumerate(names) if other == name] or [
        row for row, other in enumerate(map(PurePath, names)) if name in (other.name, other.stem)
    ]
    if len(rows) != 1:
        those = ", ".join([names[row] for row in rows] or names)[:120]
        hint = "give its folder, too" if rows else "take one of these"
        raise TrajectoryError(
            f"{sequence.name}: {len(rows)} images are named {name[:80]}; {hint}: {those}"
        )
    pose = sequence.poses[rows[0]]
    if pose is None:
        raise TrajectoryError(f"{sequence.name}: {name[:80]} has no pose")
    return pose


def _positive_number(text: str, message: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise TrajectoryError(message)
    return number


FORMAT = RecordingFormat(EXPECTED_FILES, can_open, open_colmap, ("images",))
