"""Open a recording of any known format by looking at its folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from topoloc.errors import RecordingError, UnknownFormatError
from topoloc.sequences import colmap, euroc, folder, kitti, nerfstudio, record3d, seven_scenes, tum, video
from topoloc.sequences.calibration import CalibrationOfSize, calibration_of, recalibrated
from topoloc.sequences.frame import StereoSequence
from topoloc.sequences.recording import parse_selection, sequence_subset


@dataclass(frozen=True)
class SequenceFormat:
    """How one format is told from the others, and opened."""

    looks_for: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path], StereoSequence]
    open_with: Callable[[Path, CalibrationOfSize], StereoSequence] | None = None
    """Of formats that may bring no calibration; the others' is replaced once they are open."""
    open_images: Callable[[Path, Path], StereoSequence] | None = None
    """Of formats whose pictures may lie elsewhere."""


# In the order in which they are asked; the plain folder takes what is left.
FORMATS = {
    "euroc": SequenceFormat(euroc.LOOKS_FOR, euroc.recognises, euroc.open_euroc),
    "tum": SequenceFormat(tum.LOOKS_FOR, tum.recognises, tum.open_tum, tum.open_tum),
    "seven_scenes": SequenceFormat(seven_scenes.LOOKS_FOR, seven_scenes.recognises, seven_scenes.open_seven_scenes),
    "nerfstudio": SequenceFormat(nerfstudio.LOOKS_FOR, nerfstudio.recognises, nerfstudio.open_nerfstudio),
    "record3d": SequenceFormat(record3d.LOOKS_FOR, record3d.recognises, record3d.open_record3d),
    "colmap": SequenceFormat(colmap.LOOKS_FOR, colmap.recognises, colmap.open_colmap, open_images=colmap.open_colmap),
    "kitti": SequenceFormat(kitti.LOOKS_FOR, kitti.recognises, kitti.open_kitti),
    "video": SequenceFormat(video.LOOKS_FOR, video.recognises, video.open_video),
    "folder": SequenceFormat(folder.LOOKS_FOR, folder.recognises, folder.open_folder, folder.open_folder),
}


def open_sequence(
    path: str | Path, format: str | None = None, camera: str | Path | None = None, images: str | Path | None = None
) -> StereoSequence:
    """Open a recording, or some frames of it. Pictures are read frame by frame, when asked for.

    Args:
        path: a folder, a video, or one picture file. A part is chosen by a suffix: ``PATH@START:STOP:STEP`` as Python slices,
            several of them by commas (``@0:10,50:60``); ``PATH@0-59/100`` are the frames whose number modulo 100 is 0 to 59.
        format: one of `FORMATS`; recognised where None.
        camera: the calibration instead of the recording's: a camera.json, YAML of OpenCV or Kalibr, or ``"fx,fy,cx,cy"`` in pixels.
        images: the folder of the pictures that a model of COLMAP names, where it is not `images` beside the model.

    Raises:
        UnknownFormatError: `format` is none of these, or no format recognises the folder.
        RecordingError: nothing is there, nothing is chosen, or the recording is broken; CalibrationError is one of these.
        TrajectoryError: the recording's truth is malformed or fits no frame.
    """
    folder, selection = _split_selection(str(path))
    sequence = _open_whole(folder, FORMATS[find_format(path, format)], camera, images)
    if selection is None:
        return sequence
    indices = parse_selection(selection, len(sequence))
    if not indices:
        raise RecordingError(f"{path}: none of the {len(sequence)} frames is chosen")
    return sequence_subset(sequence, indices)


def _open_whole(folder: Path, of: SequenceFormat, camera: str | Path | None, images: str | Path | None) -> StereoSequence:
    if images is not None and of.open_images is None:
        raise RecordingError(f"{folder}: a folder of images goes with a model of COLMAP, and this is none")
    calibration = None if camera is None else calibration_of(camera)
    if calibration is not None and of.open_with is not None:
        return of.open_with(folder, calibration)
    sequence = of.open_images(folder, Path(images)) if images is not None and of.open_images is not None else of.open(folder)
    return sequence if calibration is None else recalibrated(sequence, calibration)


def find_format(path: str | Path, format: str | None = None) -> str:
    """The name of a recording's format, which `open_sequence` opens it by; `format` where it is named.

    Raises:
        UnknownFormatError: `format` is none of `FORMATS`, or no format recognises the folder.
        RecordingError: nothing is there.
    """
    if format is not None and format not in FORMATS:
        raise UnknownFormatError(f"format {format!r} is not known; there are {', '.join(FORMATS)}")
    folder, _ = _split_selection(str(path))
    if not folder.exists():
        raise RecordingError(f"{folder}: no such file or folder")
    return format or _recognise(folder)


def _split_selection(path: str) -> tuple[Path, str | None]:
    folder, at, selection = path.rpartition("@")
    if not at or Path(path).exists():
        return Path(path), None
    return Path(folder), selection


def _recognise(path: Path) -> str:
    for name, candidate in FORMATS.items():
        if candidate.recognises(path):
            return name
    looked_for = "; ".join(f"{name}: {candidate.looks_for}" for name, candidate in FORMATS.items())
    raise UnknownFormatError(f"{path}: no known recording. Looked for {looked_for}")
