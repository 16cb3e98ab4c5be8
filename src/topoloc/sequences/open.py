"""Open a recording of any known format by looking at its folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from topoloc.errors import RecordingError, UnknownFormatError
from topoloc.sequences import (
    colmap,
    colmap_database,
    euroc,
    folder,
    kitti,
    nerfstudio,
    record3d,
    seven_scenes,
    tum,
    video,
    zed,
)
from topoloc.sequences.bags import bag_recording
from topoloc.sequences.calibration import calibration_of, recalibrated
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.recording import parse_selection, sequence_subset


@dataclass(frozen=True)
class SequenceFormat:
    """How one format is told from the others, and opened."""

    looks_for: str
    recognises: Callable[[Path], bool]
    open: Callable[..., StereoSequence]
    takes: tuple[str, ...] = ()
    """Keywords that go to `open`: the `topics` of a bag, the folder of a model's `images`, a
    `calibration` where the format may bring none (where it brings one, that is replaced once the
    recording is open), or the file of one as it is (`calibration_file`)."""


# In the order in which they are asked; the plain folder takes what is left.
FORMATS = {
    "euroc": SequenceFormat(euroc.LOOKS_FOR, euroc.recognises, euroc.open_euroc),
    "tum": SequenceFormat(tum.LOOKS_FOR, tum.recognises, tum.open_tum, ("calibration",)),
    "seven_scenes": SequenceFormat(
        seven_scenes.LOOKS_FOR, seven_scenes.recognises, seven_scenes.open_seven_scenes
    ),
    "nerfstudio": SequenceFormat(
        nerfstudio.LOOKS_FOR, nerfstudio.recognises, nerfstudio.open_nerfstudio
    ),
    "record3d": SequenceFormat(record3d.LOOKS_FOR, record3d.recognises, record3d.open_record3d),
    "colmap": SequenceFormat(colmap.LOOKS_FOR, colmap.recognises, colmap.open_colmap, ("images",)),
    "colmap_database": SequenceFormat(
        colmap_database.LOOKS_FOR,
        colmap_database.recognises,
        colmap_database.open_database,
        ("images",),
    ),
    "kitti": SequenceFormat(kitti.LOOKS_FOR, kitti.recognises, kitti.open_kitti),
    "rosbag": SequenceFormat(
        bag_recording.LOOKS_FOR, bag_recording.recognises, bag_recording.open_bag, ("topics",)
    ),
    "mcap": SequenceFormat(
        bag_recording.LOOKS_FOR_MCAP,
        bag_recording.recognises_mcap,
        bag_recording.open_bag,
        ("topics",),
    ),
    "zed": SequenceFormat(zed.LOOKS_FOR, zed.recognises, zed.open_zed, ("calibration_file",)),
    "video": SequenceFormat(video.LOOKS_FOR, video.recognises, video.open_video),
    "folder": SequenceFormat(
        folder.LOOKS_FOR, folder.recognises, folder.open_folder, ("calibration",)
    ),
}


def open_sequence(
    path: str | Path,
    format: str | None = None,
    camera: str | Path | None = None,
    images: str | Path | None = None,
    topics: str | Mapping[str, str] | None = None,
) -> StereoSequence:
    """Open a recording, or some frames of it. Pictures are read frame by frame, when asked for.

    Args:
        path: a folder, a video, or one picture file. A part is chosen by a suffix:
            ``PATH@START:STOP:STEP`` as Python slices, several of them by commas (``@0:10,50:60``);
            ``PATH@0-59/100`` are the frames whose number modulo 100 is 0 to 59.
        format: one of `FORMATS`; recognised where None.
        camera: the calibration instead of the recording's: a camera.json, YAML of OpenCV or Kalibr,
            Stereolabs' ``SN*.conf``, or ``"fx,fy,cx,cy"`` in pixels.
        images: the folder of the pictures that a model of COLMAP names, where it is not `images`
            beside the model.
        topics: of bags, which topic is what:
            ``left=/cam0/image_raw,right=/cam1/image_raw,pose=/odom``, or a dictionary of these.

    Raises:
        UnknownFormatError: `format` is none of these, or no format recognises the folder.
        RecordingError: nothing is there, the format takes no `topics` or `calibration`, nothing is
            chosen, or the recording is broken; CalibrationError is one of these.
        TrajectoryError: the recording's truth is malformed or fits no frame.
    """
    folder, selection = split_selection(str(path))
    is_side_by_side = format is None and str(camera).endswith(".conf") and video.recognises(folder)
    name = "zed" if is_side_by_side else find_format(path, format)
    sequence = _open_whole(
        folder, name, camera, {"images": images and Path(images), "topics": topics}
    )
    if selection is None:
        return sequence
    indices = parse_selection(selection, len(sequence))
    if not indices:
        raise RecordingError(f"{path}: none of the {len(sequence)} frames is chosen")
    return sequence_subset(sequence, indices)


def _open_whole(
    folder: Path, name: str, camera: str | Path | None, options: Mapping[str, object]
) -> StereoSequence:
    of, given = FORMATS[name], {key: value for key, value in options.items() if value is not None}
    if unused := [key for key in given if key not in of.takes]:
        raise RecordingError(f"{folder}: a recording of format {name} takes no {unused[0]}")
    if camera is None:
        return of.open(folder, **given)
    if "calibration_file" in of.takes:
        return of.open(folder, calibration=camera, **given)
    if "calibration" in of.takes:
        return of.open(folder, calibration=calibration_of(camera), **given)
    return recalibrated(of.open(folder, **given), calibration_of(camera))


def find_format(path: str | Path, format: str | None = None) -> str:
    """The name of a recording's format, which `open_sequence` opens it by; `format` where it is
    named.

    Raises:
        UnknownFormatError: `format` is none of `FORMATS`, or no format recognises the folder.
        RecordingError: nothing is there.
    """
    if format is not None and format not in FORMATS:
        raise UnknownFormatError(f"format {format!r} is not known; there are {', '.join(FORMATS)}")
    folder, _ = split_selection(str(path))
    if not os.path.exists(folder):  # no error of a name that is too long
        raise RecordingError(f"{folder}: no such file or folder")
    return format or _recognise(folder)


def split_selection(path: str) -> tuple[Path, str | None]:
    """The recording's folder or file, and the part of it that is chosen behind an @; None: all of
    it."""
    folder, at, selection = path.rpartition("@")
    if not at or os.path.exists(path):
        return Path(path), None
    return Path(folder), selection


def _recognise(path: Path) -> str:
    for name, candidate in FORMATS.items():
        if candidate.recognises(path):
            return name
    if path.is_dir() and not any(path.iterdir()):
        raise UnknownFormatError(f"{path}: no known recording: the folder is empty")
    looked_for = "; ".join(f"{name}: {candidate.looks_for}" for name, candidate in FORMATS.items())
    raise UnknownFormatError(f"{path}: no known recording. Looked for {looked_for}")
