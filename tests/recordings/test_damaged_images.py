"""Test recordings of all formats with missing, empty and truncated images: the other
frames are mapped."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tiny_recordings import picture, write
from topoloc.apps.cli import main
from topoloc.errors import RecordingError
from topoloc.localization.map_facts.map_building import build_map
from topoloc.mapping.topomap import TopoMetricMap
from topoloc.recordings.open import open_sequence


@pytest.fixture
def recording(tiny_recording: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_recording, tmp_path / "walk"))


def test_frames_with_damaged_images_are_left_out_and_counted(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    num = len(open_sequence(recording))
    names = sorted(path.name for path in (recording / "image_0").iterdir())
    (recording / "image_1" / names[3]).write_bytes(b"")
    (recording / "image_0" / names[5]).write_bytes(b"")
    cut = recording / "image_0" / names[6]
    cut.write_bytes(cut.read_bytes()[:-300])
    warned: list[str] = []
    sequence = open_sequence(recording, warn=warned.append, whole_only=True)
    assert len(sequence) == num - 3
    assert f"3 of {num} frames left out: image missing or damaged" in warned[-1]
    assert str(recording / "image_1" / names[3]) in warned[-1]
    for index in range(len(sequence)):
        assert sequence[index].right is not None
    assert main(["build", str(recording), str(tmp_path / "room.topo"), "--features", "surf"]) == 0
    assert f"3 of {num} frames" in capsys.readouterr().err
    assert len(TopoMetricMap.load(tmp_path / "room.topo").nodes) >= 2


def test_build_map_leaves_damaged_frames_out_and_warns(recording: Path):
    (recording / "image_0" / "000005.png").write_bytes(b"")
    warned: list[object] = []
    sources = recording, open_sequence(recording)  # a path and a recording
    for source in sources:
        assert len(build_map(source, warn=warned.append).nodes) >= 2
    assert len(warned) == len(sources)
    assert all("1 of 14 frames left out" in str(one) for one in warned)
    with pytest.warns(UserWarning, match="1 of 14 frames left out"):
        build_map(recording)


def test_a_selection_counts_its_own_frames(recording: Path):
    names = sorted(path.name for path in (recording / "image_0").iterdir())
    (recording / "image_0" / names[0]).write_bytes(b"")
    warned: list[str] = []
    assert len(open_sequence(f"{recording}@2:6", warn=warned.append, whole_only=True)) == 4
    assert not [line for line in warned if "damaged" in line]


def test_a_recording_that_is_mostly_damaged_is_refused(
    recording: Path, tmp_path: Path, complaint: Callable[..., str]
):
    names = sorted(path.name for path in (recording / "image_0").iterdir())
    for name in names[: len(names) // 2 + 1]:
        path = recording / "image_0" / name
        path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(RecordingError, match="damaged"):
        open_sequence(recording, whole_only=True)
    said = complaint("build", recording, tmp_path / "room.topo")
    assert names[0] in said


DAMAGES: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
}
CASES = {  # the recording and its folders of images
    "depth_coarser_than_colour": ("rgb", "depth"),
    "transforms_backslashes": ("images",),
    "nerfcapture_depth_path": ("images",),
    "stray_scanner": ("depth",),
    "ros_left_right_yaml": ("left", "right"),
    "euroc_times_differ": ("mav0/cam0/data", "mav0/cam1/data"),
    "tum_names_with_spaces": ("rgb", "depth"),
    "colmap_exif_orientation": ("images",),
}


def images_of(folder: Path) -> list[Path]:
    return sorted(
        path for path in folder.iterdir() if path.suffix in (".png", ".jpg") and path.is_file()
    )


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", CASES)
def test_every_format_leaves_damaged_frames_out(
    shared: Path, tmp_path: Path, name: str, damage: str
):
    case = shared / "cases" / "turn3" / name
    if not case.is_dir():
        pytest.skip(f"no recording at {case}")
    folder = Path(shutil.copytree(case, tmp_path / name))
    before = open_sequence(folder)
    lost = [
        DAMAGES[damage](images_of(folder / below)[1 + 2 * number])
        for number, below in enumerate(CASES[name])
    ]
    warned: list[str] = []
    sequence = open_sequence(folder, warn=warned.append, whole_only=True)
    assert len(sequence) == len(before) - len(lost)
    assert f"{len(lost)} of {len(before)} frames left out" in warned[-1]
    of_before = dict(zip(before.names, zip(before.t_ns, before.poses, strict=True), strict=True))
    for index, frame_name in enumerate(sequence.names):
        frame = sequence[index]
        t_ns, pose = of_before[frame_name]
        assert (frame.t_ns, frame.world_from_cam) == (t_ns, pose) or (
            pose is not None
            and frame.world_from_cam is not None
            and np.array_equal(frame.world_from_cam.matrix(), pose.matrix())
        )


def test_the_end_of_a_thumbnail_is_not_that_of_the_image(recording: Path):
    path = recording / "image_0" / "000003.png"
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    whole, thumbnail = (
        cv2.imencode(".jpg", pixels)[1].tobytes() for pixels in (image, image[::8, ::8])
    )
    exif = b"Exif\0\0II*\0\x08\0\0\0" + bytes(6) + thumbnail
    with_thumbnail = whole[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + whole[2:]
    num = len(open_sequence(recording))
    for data, num_whole in ((with_thumbnail, num), (with_thumbnail[: len(exif) + 500], num - 1)):
        path.write_bytes(data)
        assert len(open_sequence(recording, whole_only=True)) == num_whole


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("suffixes", [("color.png",), ("depth.png",), ("color.png", "depth.png")])
def test_7_scenes_leaves_damaged_frames_out(tmp_path: Path, suffixes: tuple[str, ...], damage: str):
    for number in range(5):
        stem = f"frame-{number:06d}"
        write(tmp_path / f"{stem}.color.png", picture(number, 3, 640, 480))
        write(tmp_path / f"{stem}.depth.png", np.full((480, 640), 1500, np.uint16))
        np.savetxt(tmp_path / f"{stem}.pose.txt", np.eye(4))
    for number, suffix in enumerate(suffixes):
        DAMAGES[damage](tmp_path / f"frame-{1 + number:06d}.{suffix}")
    sequence = open_sequence(tmp_path, whole_only=True)
    kept = [0, *range(1 + len(suffixes), 5)]
    assert sequence.names == [f"frame-{number:06d}.color.png" for number in kept]
    assert sequence.t_ns == [number * 1_000_000_000 // 30 for number in kept]


def test_a_frame_without_both_images_keeps_the_times_of_others(recording: Path):
    """Only times.txt shows that the frame existed."""
    before = open_sequence(recording)
    names = sorted(path.name for path in (recording / "image_0").iterdir())
    for folder in ("image_0", "image_1"):
        (recording / folder / names[4]).unlink()
        (recording / folder / names[-1]).unlink()
    sequence = open_sequence(recording, whole_only=True)
    kept = [k for k in range(len(before)) if k not in (4, len(before) - 1)]
    assert sequence.names == [before.names[k] for k in kept]
    assert sequence.t_ns == [before.t_ns[k] for k in kept]
    assert [pose and pose.translation.tolist() for pose in sequence.poses] == [
        pose and pose.translation.tolist() for pose in (before.poses[k] for k in kept)
    ]


def test_missing_images_at_the_ends_are_ambiguous(recording: Path):
    """If names begin at 1, the first or the last image may be missing."""
    for folder in ("image_0", "image_1"):
        (recording / folder / "000000.png").unlink()
    with pytest.raises(RecordingError, match=r"times\.txt: 14 times for 13 pictures"):
        open_sequence(recording, whole_only=True)


@pytest.mark.parametrize(("kind", "bits"), [(np.float32, 32), (np.float64, 64)])
def test_whole_images_of_floats_are_not_called_damaged(tmp_path: Path, kind: type, bits: int):
    for number in range(3):
        write(tmp_path / f"{number}.tiff", (picture(number, 3) / 255.0).astype(kind))
    with pytest.raises(
        RecordingError, match=rf"0\.tiff: pixels of {bits}-bit floats; a pict"
    ) as at:
        open_sequence(tmp_path, whole_only=True)
    assert "copy" not in str(at.value)


@pytest.mark.parametrize("command", [("evaluate",), ("certify", "--walk")])
def test_measuring_commands_leave_damaged_frames_out(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
):
    out = str(tmp_path / "room.topo")
    assert main(["build", str(recording), out, "--features", "surf"]) == 0
    num = len(open_sequence(recording))
    (recording / "image_0" / "000003.png").write_bytes(b"")
    name, *options = command
    capsys.readouterr()
    assert main([name, out, *options, str(recording)]) == 0
    printed = capsys.readouterr()
    assert f"1 of {num} frames left out: image missing or damaged" in printed.err
    assert re.search(rf"\b{num - 1}\b", printed.out)
