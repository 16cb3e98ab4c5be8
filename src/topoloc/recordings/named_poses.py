"""Read poses that name their images, and match poses to images by names or numbers.

Rows of a name and a pose are ``name tx ty tz qx qy qz qw`` (world_from_cam), ``name qw qx qy qz tx
ty tz`` (cam_from_world, as of visual localization benchmarks) or ``name`` and 3x4 numbers. A folder
holds one matrix per image.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float

from topoloc.errors import TrajectoryError
from topoloc.geometry.pose_conventions import pose_from_quaternion, poses_from_matrices
from topoloc.geometry.rigid import Rigid3
from topoloc.recordings.text_files import (
    NANOSECONDS_PER_SECOND,
    Rows,
    check_rows,
    parse_numbers,
    read_text,
)

ROTATION_TOLERANCE = 1e-2


def read_pose_matrix(path: Path) -> Rigid3 | None:
    """Read the matrix (4x4 or 3x4) of one pose (metres). None if it is lost, with infinite numbers.
    Raises TrajectoryError: the file holds other numbers, or no pose."""
    try:
        numbers = np.array(read_text(path, TrajectoryError).split(), dtype=np.float64)
        if len(numbers) == 12:
            numbers = np.append(numbers, [0.0, 0.0, 0.0, 1.0])
        matrix = numbers.reshape(4, 4)
    except ValueError:
        raise TrajectoryError(f"{path}: not a matrix of 4x4 numbers") from None
    with TrajectoryError.at(path):
        return None if np.isinf(matrix).any() else Rigid3.from_matrix(matrix)


def has_pose_matrices(folder: Path) -> bool:
    """Return whether this is a folder with text files, as of matrices."""
    return folder.is_dir() and any(folder.glob("*.txt"))


def read_pose_folder(folder: Path) -> dict[str, Rigid3 | None]:
    """Return the pose of each text file of a folder by the file's stem. Raises TrajectoryError."""
    files = sorted(folder.glob("*.txt"))
    if not files:
        raise TrajectoryError(f"{folder}: no text files with a matrix of 4x4 numbers")
    return {file.stem: read_pose_matrix(file) for file in files}


def poses_of_named_rows(path: Path, rows: Rows) -> dict[str, Rigid3 | None] | None:
    """Return the poses of rows that begin with names, or None if they begin with a number. Raises
    TrajectoryError."""
    names = [tokens[0] for _, tokens in rows]
    num = len(rows[0][1]) - 1
    if _is_number(names[0]) or num not in (7, 12) or any(len(row) != num + 1 for _, row in rows):
        return None
    repeated = next((name for name, count in Counter(names).items() if count > 1), None)
    if repeated is not None:
        raise TrajectoryError(f"{path}: {repeated!r} has several poses; leave one")
    numbers = parse_numbers(path, rows, range(1, num + 1))
    if num == 12:
        poses, is_rotation = poses_from_matrices(numbers, ROTATION_TOLERANCE)
        check_rows(is_rotation, "not a rotation", path, rows)
        return dict(zip(names, poses, strict=True))
    is_last, is_first = is_unit_quaternion(numbers[:, 3:]), is_unit_quaternion(numbers[:, :4])
    if is_last.all() and is_first.all():
        raise TrajectoryError(
            f"{path}: the first four numbers and the last four may both be the quaternion; write"
            " the name and the 3x4 numbers of world_from_cam in each row"
        )
    if is_first.all():  # w x y z, then the translation of cam_from_world
        numbers = numbers[:, [4, 5, 6, 1, 2, 3, 0]]
        return {
            k: pose_from_quaternion(row).inverse() for k, row in zip(names, numbers, strict=True)
        }
    check_rows(is_last, "not a rotation", path, rows)
    return {name: pose_from_quaternion(row) for name, row in zip(names, numbers, strict=True)}


def match_names(
    named: dict[str, Rigid3 | None], names: Sequence[str], path: Path
) -> list[Rigid3 | None]:
    """Return the pose of each image by its path, else by its file name, else by that without
    suffix. Raises TrajectoryError: no image is named."""
    forms: list[Callable[[str], str]] = [
        str,
        lambda name: PurePosixPath(name).name,
        lambda name: PurePosixPath(name).stem,
    ]
    for form in forms:
        known = {form(name): pose for name, pose in named.items()}
        wanted = [form(name) for name in names]
        if len(known) == len(named) and any(name in known for name in wanted):
            return [known.get(name) for name in wanted]
    raise TrajectoryError(
        f"{path}: it names no image of the recording: its first is {next(iter(named))!r}, that of"
        f" the recording {names[0] if names else None!r}"
    )


def match_numbers(
    poses: Sequence[Rigid3], t_ns: Sequence[int], names: Sequence[str]
) -> list[Rigid3 | None] | None:
    """Return the pose of each image by number, if the stamps of poses (nanoseconds) are no times,
    but count frames or are the numbers in the names. Else None."""
    if len(names) < 3 or any(stamp % NANOSECONDS_PER_SECOND for stamp in t_ns):
        return None
    of_number = dict(zip((stamp // NANOSECONDS_PER_SECOND for stamp in t_ns), poses, strict=True))
    found = [re.findall(r"\d+", PurePosixPath(name).stem) for name in names]
    numbers = [int(digits[-1]) if digits else -1 for digits in found]
    if len(set(numbers)) == len(numbers) and of_number.keys() <= set(numbers):
        return [of_number.get(number) for number in numbers]
    is_counted = t_ns[-1] - t_ns[0] == (len(t_ns) - 1) * NANOSECONDS_PER_SECOND
    return list(poses) if is_counted and len(poses) == len(names) else None


def _is_number(token: str) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    return True


def is_unit_quaternion(quaternions: Float[np.ndarray, "n 4"]) -> Bool[np.ndarray, " n"]:
    """Return which quaternions have length 1 up to rounding."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt(np.einsum("ni,ni->n", quaternions, quaternions))
        return np.abs(lengths - 1.0) <= ROTATION_TOLERANCE
