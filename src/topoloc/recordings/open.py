"""Open a recording of any known format."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from topoloc.errors import RecordingError, UnknownFormatError
from topoloc.recordings.calibration import parse_calibration, with_calibration
from topoloc.recordings.depth_range import leave_out_stuck_depth
from topoloc.recordings.format import RecordingFormat, load_reader
from topoloc.recordings.frame import StereoSequence, sequence_subset
from topoloc.recordings.image_files import find_path
from topoloc.recordings.image_mask import mask_recording, read_mask
from topoloc.recordings.recording import leave_out_damaged, recording_notes

# name -> "module:attribute" of a RecordingFormat, in the order of recognition. The plain folder
# accepts any other folder with images. A format's module is imported when the format is tried.
FORMATS = {
    "euroc": "topoloc.apps.formats.euroc:FORMAT",
    "tum": "topoloc.apps.formats.tum:FORMAT",
    "seven_scenes": "topoloc.apps.formats.seven_scenes:FORMAT",
    "scannet": "topoloc.apps.formats.scannet:FORMAT",
    "arkitscenes": "topoloc.apps.formats.arkitscenes:FORMAT",
    "nerfstudio": "topoloc.apps.formats.nerfstudio:FORMAT",
    "stray_scanner": "topoloc.apps.formats.stray_scanner:FORMAT",
    "record3d": "topoloc.apps.formats.record3d:FORMAT",
    "colmap": "topoloc.apps.formats.colmap:FORMAT",
    "opensfm": "topoloc.apps.formats.opensfm:FORMAT",
    "kapture": "topoloc.apps.formats.kapture:FORMAT",
    "colmap_database": "topoloc.apps.formats.colmap_database:FORMAT",
    "kitti": "topoloc.apps.formats.kitti:FORMAT",
    "rosbag": "topoloc.apps.formats.bags.bag_recording:ROSBAG_FORMAT",
    "mcap": "topoloc.apps.formats.bags.bag_recording:MCAP_FORMAT",
    "zed": "topoloc.apps.formats.zed:FORMAT",
    "video": "topoloc.apps.formats.video:FORMAT",
    "rig": "topoloc.apps.formats.rig:FORMAT",
    "equirectangular": "topoloc.apps.formats.rig:PANORAMAS",
    "folder": "topoloc.recordings.folder:FORMAT",
}


# Numbers have up to 18 digits. Python refuses to parse numbers of thousands of digits.
_SLICE = re.compile(r"(-?\d{1,18})?:(-?\d{1,18})?(?::([1-9]\d{0,17})?)?")
_BLOCK = re.compile(r"(\d{1,18})-(\d{1,18})/([1-9]\d{0,17})")
_INDEX = re.compile(r"-?\d{1,18}")


def load_format(name: str) -> RecordingFormat:
    """Return the format with this name of `FORMATS`."""
    return load_reader(FORMATS[name])


def open_sequence(
    path: str | Path,
    format: str | None = None,
    camera: str | Path | None = None,
    images: str | Path | None = None,
    topics: str | Mapping[str, str] | None = None,
    warn: Callable[[str], None] | None = None,
    whole_only: bool = False,
    mask: str | Path | None = None,
) -> StereoSequence:
    """Open a recording, or a selection of its frames. Images are read when a frame is accessed.

    Args:
        path: a folder, a video, or one image file. A suffix selects frames:
            ``PATH@START:STOP:STEP`` as Python slices, separated by commas (``@0:10,50:60``).
            ``PATH@0-59/100`` selects the frames whose number modulo 100 is 0 to 59.
        format: one of `FORMATS`. None detects it.
        camera: replaces the recording's calibration. A camera.json, YAML of OpenCV or Kalibr,
            Stereolabs' ``SN*.conf``, or ``"fx,fy,cx,cy"`` in pixels.
        images: the image folder of a COLMAP model, if it is not `images` beside the model.
        topics: the topics of a bag: ``left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom``, or a
            dictionary of these.
        warn: called with each note on the recording, such as truncated or guessed data.
        whole_only: leave out the frames with a missing, empty or truncated image file, and depth
            that sticks at the end of the sensor's range. Notes say so.
        mask: an image that is black where the pictures (of a pair the left ones) show what moves
            with the camera, such as the robot's own body, and white elsewhere. It is of their size,
            or scaled with it.

    Raises:
        UnknownFormatError: `format` is unknown, or no format recognises the folder.
        RecordingError: the path does not exist, the format takes no `topics` or `images`, no frame
            is selected, or the recording is broken. CalibrationError is a subclass.
        TrajectoryError: the recording's ground truth is malformed or matches no frame.
    """
    folder, selection = split_selection(str(path))
    name = find_format(path, format, camera)
    options = {"images": images and Path(images), "topics": topics}
    sequence = _open_recording(folder, name, camera, options)
    if warn is not None:
        for note in recording_notes(sequence):
            warn(note)
    sequence = select_frames(sequence, selection)
    if mask is not None:
        sequence = mask_recording(sequence, read_mask(mask))
    if not whole_only:
        return sequence
    return leave_out_stuck_depth(leave_out_damaged(sequence, warn), warn)


def _open_recording(
    folder: Path, name: str, camera: str | Path | None, options: Mapping[str, object]
) -> StereoSequence:
    recording_format = load_format(name)
    given = {key: value for key, value in options.items() if value is not None}
    if unused := [key for key in given if key not in recording_format.open_options]:
        raise RecordingError(f"{folder}: a recording of format {name} takes no {unused[0]}")
    if camera is None:
        return recording_format.open(folder, **given)
    if "calibration_file" in recording_format.open_options:
        return recording_format.open(folder, calibration=camera, **given)
    if "calibration" in recording_format.open_options:
        return recording_format.open(folder, calibration=parse_calibration(camera), **given)
    return with_calibration(recording_format.open(folder, **given), parse_calibration(camera))


def find_format(
    path: str | Path, format: str | None = None, camera: str | Path | None = None
) -> str:
    """Return the name of the format that `open_sequence` uses. A given `format` is returned after
    checks. Stereolabs' calibration as `camera` makes a video a side-by-side one.

    Raises:
        UnknownFormatError: `format` is not in `FORMATS`, or no format recognises the folder.
        RecordingError: the path does not exist.
    """
    if format is not None and format not in FORMATS:
        raise UnknownFormatError(f"format {format!r} is not known; there are {', '.join(FORMATS)}")
    folder, _ = split_selection(str(path))
    if not os.path.exists(folder):  # os.path.exists raises no error if the name is too long
        raise RecordingError(f"{folder}: no such file or folder")
    if format is not None:
        return format
    if str(camera).endswith(".conf") and load_format("video").can_open(folder):
        return "zed"
    if found := _recognise(folder):
        return found
    names = sorted(os.listdir(folder)) if folder.is_dir() else ["a file of another kind"]
    if not names:
        raise UnknownFormatError(f"{folder}: no known recording: the folder is empty")
    if inside := _recordings_below(folder):
        found = ", ".join(f"{path.name} ({name})" for path, name in inside[:10])
        example = folder / inside[0][0].name
        raise UnknownFormatError(
            f"{folder}: no recording, but a folder of {len(inside)}: {found}; name one, such as"
            f" {example}"
        )
    expected = {name: load_format(name).expected_files for name in FORMATS}
    shared = {
        name: sum(name_part in text for name_part in names) for name, text in expected.items()
    }
    nearest = max(reversed(FORMATS), key=lambda name: shared[name])  # the plain folder first
    guess = f"; nearest is {nearest}: {expected[nearest]}" if shared[nearest] else ""
    held = ", ".join(names[:4]) + " ..." * (len(names) > 4)
    raise UnknownFormatError(
        f"{folder}: no known recording: here is {held}{guess}; formats: docs/recordings.md"
    )


def _recordings_below(folder: Path) -> list[tuple[Path, str]]:
    """Return the recordings directly inside a folder, each with its format."""
    max_entries = 200
    paths = sorted(folder.iterdir())[:max_entries] if folder.is_dir() else []
    return [(path, name) for path in paths if (name := _recognise(path))]


def _recognise(path: Path) -> str | None:
    return next((name for name in FORMATS if load_format(name).can_open(path)), None)


def split_selection(path: str) -> tuple[Path, str | None]:
    """Split a path into the recording's folder or file and the selection after an @. The selection
    is None if there is none."""
    folder, at, selection = path.rpartition("@")
    whole = find_path(Path(path))
    return (
        (whole, None) if not at or os.path.exists(whole) else (find_path(Path(folder)), selection)
    )


def select_frames(sequence: StereoSequence, selection: str | None) -> StereoSequence:
    """Return the frames of a selection, None: all. Raises RecordingError: it is malformed, or
    selects no frame."""
    if selection is None:
        return sequence
    if not (indices := parse_selection(selection, len(sequence))):
        raise RecordingError(
            f"{sequence.name}@{selection}: none of the {len(sequence)} frames is chosen"
        )
    return sequence_subset(sequence, indices)


def parse_selection(text: str, num_frames: int) -> list[int]:
    """Return the frame numbers of a selection such as ``0::2``, ``0:10,50:60``, ``-1`` or
    ``0-59/100``.

    The numbers are increasing and unique. A slice is Python's, with a positive step.
    ``FIRST-LAST/PERIOD`` selects the frames whose number modulo PERIOD is in FIRST to LAST, both
    included.

    Raises:
        RecordingError: the text is none of these, or a single number is outside of the recording.
    """
    chosen: set[int] = set()
    for part in text.split(","):
        part = part.strip()
        if bounds := _SLICE.fullmatch(part):
            limits = (int(bound) if bound else None for bound in bounds.groups())
            chosen.update(range(num_frames)[slice(*limits)])
        elif block := _BLOCK.fullmatch(part):
            first, last, period = (int(number) for number in block.groups())
            chosen.update(index for index in range(num_frames) if first <= index % period <= last)
        elif _INDEX.fullmatch(part):
            if not -num_frames <= int(part) < num_frames:
                raise RecordingError(f"frame {part} of a recording of {num_frames}")
            chosen.add(int(part) % num_frames)
        else:
            raise RecordingError(
                f"{part!r} chooses no frames; write START:STOP:STEP, a number, or FIRST-LAST/PERIOD"
            )
    return sorted(chosen)
